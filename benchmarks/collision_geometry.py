"""Collision geometries of real arms compared: agreement with the triangles, start-up and speed.

    python benchmarks/collision_geometry.py [--only panda,ur5] [--steps 4000] [--blocks 7]
                                            [--out results/collision-geometry.json] [--report]

Compares the forms of an arm in ``GEOMETRIES``, with a fixed base and without a tool, for every real
arm with collision meshes. ``hull`` is the arm with its meshes, which MuJoCo and PyBullet replace by
convex hulls. Rows are kept in ``--out``, and only forms without a row are measured: an interrupted
run goes on, and a new geometry needs no new rows of the others. ``--report`` only prints.

Agreement: share of 1,000 random configurations in which the form collides with itself if and only
if the triangles of the meshes do. Pairs of links that the form or
the arm with meshes ignores are not tested; the column "hull, same pairs" is the agreement of the
hulls without these pairs.

Start-up: time in which MuJoCo compiles its model and PyBullet loads the URDF, the shortest of
``LOADS``, relative to the hulls. Converting the meshes comes before: `morphgen compose` does it.

Speed: physics steps per second relative to the hulls in the same run. Position targets lead from
home through random configurations without self-collision, one per second, the same for all forms.
Steps have 5 ms; gravity and visuals are off. All forms of a run ignore the same pairs of links:
those that any of them ignores. There are two scenes: the arm alone, and the arm above a table just
below its home configuration, on which every second configuration presses. Steps per second are the
median over the blocks, each starting at home, after one pass that counts the steps with a contact;
the forms alternate. PyBullet also replaces cylinders by hulls unless URDF_USE_IMPLICIT_CYLINDER is
set, as it is here. Without PyBullet its values are missing. Means of speeds are geometric, without
simulations that diverged.
"""

from __future__ import annotations

import argparse
import json
import math
import statistics
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from importlib.util import find_spec
from itertools import combinations
from pathlib import Path
from typing import cast

import fcl
import mujoco
import numpy as np
import trimesh
from numpy.typing import NDArray
from tabulate import tabulate
from tqdm import tqdm

import morphgen
from morphgen.checks.rules import triangle_collider
from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.errors import MorphgenError
from morphgen.fitting.replace_collision import as_convex, as_primitives, with_primitives
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.files import write_file
from morphgen.formats.fits import are_primitives
from morphgen.formats.mjcf.write import to_spec
from morphgen.grammar.library import Library, default_library
from morphgen.model.geometry import Shape
from morphgen.model.inertia import bounding_box, link_frame_mesh
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Pair, Robot, sorted_pair
from morphgen.typing import Array
from worlds import Make, MujocoWorld, PybulletWorld, World

OUT = Path("results/collision-geometry.json")
DEFAULTS = (4000, 7, 0)  # steps of a block, blocks and seed of the stored rows
CONFIGURATIONS = 1000
"""Number of random configurations of the agreement."""
LOADS = 5
"""Number of times that a simulator loads each form."""
LEG = 200
"""Steps from one random configuration to the next."""
HOLD = 10
"""Steps for which each target on the path is held."""
TRIES = 32
"""Configurations drawn for each one that is needed."""
PRESS = 0.05
"""Depth of the lowest joint below the table where the arm presses on it [m]."""
CLEARANCE = 0.005
"""Height of the arm at home above the table [m]."""
HULL = "hull"
SCENES = ("alone", "above a table")


def _one_primitive(robot: Robot, folders: Sequence[Path]) -> Robot:
    shapes = token_shapes(robot, folders)
    return with_primitives(robot, {link: (shape,) for link, shape in shapes.items()})


GEOMETRIES: dict[str, Callable[[Robot, Sequence[Path]], Robot]] = {
    HULL: lambda robot, folders: robot,
    "primitives": as_primitives,
    "one primitive": _one_primitive,
    "convex pieces": as_convex,
}
"""The geometries, each with the function that gives an arm its collision shapes."""


@dataclass(frozen=True)
class Speed:
    """Speed of one form in one simulator and scene."""

    steps: float
    """Steps per second."""
    ratio: float
    """Steps per second relative to the hulls."""
    contacts: float
    """Share of the steps with a contact."""
    stable: bool
    """Whether this form and the hulls stayed finite."""


@dataclass(frozen=True)
class Row:
    """Measurements of one form of one arm."""

    arm: str
    geometry: str
    shapes: int
    """Number of collision shapes."""
    vertices: int
    """Number of vertices of the meshes' hulls in MuJoCo."""
    agree: float
    precision: float
    recall: float
    hull_agree: float
    """Agreement of the hulls without the pairs that this form ignores."""
    load: dict[str, float] = field(default_factory=dict)
    """Time to load the form, by simulator [s]."""
    load_ratio: dict[str, float] = field(default_factory=dict)
    """The same relative to the hulls."""
    speed: dict[str, dict[str, Speed]] = field(default_factory=dict)
    """Speeds by simulator and scene."""


def main() -> int:
    """Measure the forms that have no row yet, and print the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", help="names of arms, separated by commas")
    parser.add_argument("--steps", type=int, default=DEFAULTS[0], help="steps of a block")
    parser.add_argument("--blocks", type=int, default=DEFAULTS[1])
    parser.add_argument("--seed", type=int, default=DEFAULTS[2])
    parser.add_argument("--out", type=Path, default=OUT)
    parser.add_argument("--report", action="store_true", help="print the rows, measure nothing")
    args = parser.parse_args()
    library = default_library()
    names = _names(library, args.only)
    rows = _read_rows(args.out)
    if args.out == OUT and (args.steps, args.blocks, args.seed) != DEFAULTS:
        parser.error(f"{OUT} is of other --steps, --blocks and --seed; name another --out")
    left_out = []
    for name in () if args.report else tqdm(names, unit="arm", file=sys.stderr):
        missing = [key for key in GEOMETRIES if (name, key) not in rows]
        if not missing:
            continue
        robot = morphgen.compose(f"arm={name}")
        if all(are_primitives(link.collisions) for link in robot.links):
            left_out.append(f"{name} (no collision meshes)")
            continue
        try:
            measured = _measure(robot, name, missing, library, args)
        except MorphgenError as error:
            left_out.append(f"{name} ({error})")
            continue
        rows |= {(row.arm, row.geometry): row for row in measured}
        entries = ",\n".join(json.dumps(asdict(row)) for row in rows.values())
        write_file(args.out, f"[\n{entries}\n]\n")
    shown = [row for row in rows.values() if row.arm in names]
    print(_report(shown))
    if left_out:
        print(f"left out: {', '.join(left_out)}")
    return 0


def _names(library: Library, only: str | None) -> list[str]:
    if only:
        return [library.manifest(name, "arm").name for name in only.split(",")]
    return [m.name for m in library.manifests("arm") if not m.is_template and not m.scaling]


def _read_rows(path: Path) -> dict[tuple[str, str], Row]:
    rows = {}
    for entry in json.loads(path.read_text("utf-8")) if path.is_file() else ():
        speed = {
            simulator: {scene: Speed(**values) for scene, values in scenes.items()}
            for simulator, scenes in entry.pop("speed").items()
        }
        rows[entry["arm"], entry["geometry"]] = Row(**entry, speed=speed)
    return rows


def _measure(
    robot: Robot, name: str, missing: list[str], library: Library, args: argparse.Namespace
) -> list[Row]:
    """Return rows of the missing forms; the hulls are measured beside them in any case."""
    keys = [HULL, *(key for key in missing if key != HULL)]
    forms = {key: GEOMETRIES[key](robot, library.folders) for key in keys}
    rows = {key: _row(name, key, robot, form) for key, form in forms.items()}
    ignored = tuple(
        sorted({sorted_pair(*pair) for form in forms.values() for pair in form.ignore_pairs})
    )
    bare = {key: _bare(form, ignored) for key, form in forms.items()}
    top = min(map(_lowest, bare.values())) - CLEARANCE
    makers: dict[str, Make] = {"MuJoCo": MujocoWorld}
    if find_spec("pybullet") is not None:
        makers["PyBullet"] = PybulletWorld
    for simulator, make in makers.items():
        loads = _load_times(make, bare)
        for key, row in rows.items():
            row.load[simulator] = round(loads[key], 5)
            row.load_ratio[simulator] = round(loads[key] / loads[HULL], 3)
            row.speed[simulator] = {}
    for scene in SCENES:
        table_top = None if scene == SCENES[0] else top
        targets = _targets(bare, table_top, args)
        for simulator, make in makers.items():
            speeds = _speeds(partial(make, table_top=table_top), bare, targets, args)
            for key, row in rows.items():
                row.speed[simulator][scene] = speeds[key]
    return [rows[key] for key in missing]


@dataclass(frozen=True)
class Agreement:
    """Numbers of configurations in which meshes and a substitute (primitives, hulls) collide."""

    both: int  # both the meshes and the substitute collide
    neither: int  # neither the meshes nor the substitute collide
    only_meshes: int  # the meshes collide, the substitute does not
    only_other: int  # the substitute collides, the meshes do not

    @property
    def precision(self) -> float:
        """Share of the substitute's collisions that are collisions of the meshes."""
        return _share(self.both, self.only_other)

    @property
    def recall(self) -> float:
        """Share of the meshes' collisions that are collisions of the substitute."""
        return _share(self.both, self.only_meshes)

    @property
    def accuracy(self) -> float:
        """Share of configurations in which both collide or neither does."""
        return _share(self.both + self.neither, self.only_meshes + self.only_other)


def agreement(
    meshes: Robot, primitives: Robot, n: int = 1000, seed: int = 0
) -> tuple[Agreement, Agreement]:
    """Return how primitives, and convex hulls, agree with meshes on random self-collisions."""
    ignored = {*untested_pairs(meshes), *primitives.ignore_pairs}
    q = random_configurations(meshes, n, np.random.default_rng(seed))
    mesh_collisions = list(_mesh_collisions(meshes, ignored, q))
    # In the order of the fields of Agreement: do the meshes collide, does the substitute?
    cases = ((True, True), (False, False), (True, False), (False, True))
    agreements = []
    for robot in (primitives, meshes):
        penetrations = SelfCollisionChecker(robot, ignored).penetrations(q)
        counts = Counter(zip(mesh_collisions, map(bool, penetrations), strict=True))
        agreements.append(Agreement(*(counts[case] for case in cases)))
    return agreements[0], agreements[1]


def _mesh_collisions(robot: Robot, ignored: set[Pair], q: NDArray[np.float64]) -> Iterator[bool]:
    """Yield for each configuration if triangles of two links intersect."""
    names = [link.name for link in robot.links if link.collisions]
    pairs = [pair for pair in combinations(names, 2) if sorted_pair(*pair) not in ignored]
    models = {link.name: _model(link.collisions) for link in robot.links if link.collisions}
    for T_root_link in forward_kinematics(robot, q):
        for name, collider in models.items():
            T = T_root_link[robot.link_index[name]]
            collider.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        yield any(
            fcl.collide(models[a], models[b], fcl.CollisionRequest(), fcl.CollisionResult())
            for a, b in pairs
        )


def _model(shapes: tuple[Shape, ...]) -> fcl.CollisionObject:
    """Return the triangles of a link's shapes as one collision object in the link frame."""
    whole = cast(trimesh.Trimesh, trimesh.util.concatenate([*map(link_frame_mesh, shapes)]))
    return triangle_collider(np.asarray(whole.vertices), np.asarray(whole.faces))


def _share(hits: int, misses: int) -> float:
    return hits / (hits + misses) if hits + misses else 1.0


def _row(name: str, key: str, robot: Robot, form: Robot) -> Row:
    """Return the row of a form without its times."""
    of_form, of_hulls = agreement(robot, form, CONFIGURATIONS)
    model = to_spec(_bare(form, form.ignore_pairs)).compile()
    hulls = model.geom_dataid[model.geom_type == mujoco.mjtGeom.mjGEOM_MESH]
    return Row(
        name,
        key,
        shapes=sum(len(link.collisions) for link in form.links),
        vertices=int(model.mesh_vertnum[hulls].sum()),
        agree=round(of_form.accuracy, 4),
        precision=round(of_form.precision, 4),
        recall=round(of_form.recall, 4),
        hull_agree=round(of_hulls.accuracy, 4),
    )


def _bare(robot: Robot, ignored: tuple[Pair, ...]) -> Robot:
    links = tuple(replace(link, visuals=()) for link in robot.links)
    return replace(robot, links=links, ignore_pairs=ignored)


def _lowest(robot: Robot) -> float:
    """Return the height of the lowest point of the links' bounding boxes at home [m]."""
    heights = []
    for T, link in zip(forward_kinematics(robot, robot.home), robot.links, strict=True):
        if link.collisions:
            low, high = bounding_box(link.collisions)
            corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1)
            heights.append(float((T[2, :3] @ corners + T[2, 3]).min()))
    return min(heights)


def _load_times(make: Make, forms: dict[str, Robot]) -> dict[str, float]:
    """Return for each form the shortest time in which the simulator loads it [s]."""
    seconds = dict.fromkeys(forms, math.inf)
    for _ in range(LOADS):
        for key, form in forms.items():
            with closing(make(form, None)) as world:
                seconds[key] = min(seconds[key], world.load_seconds)
    return seconds


def _targets(forms: dict[str, Robot], table_top: float | None, args: argparse.Namespace) -> Array:
    """Return a path from home through random configurations, shape (n, dof).

    Each row is a target that is held for ``HOLD`` steps.

    Raises:
        MorphgenError: If too few configurations are free of self-collision.
    """
    robot = forms[HULL]
    legs = -(-args.steps // LEG)
    free = random_configurations(robot, TRIES * legs, np.random.default_rng(args.seed))
    for form in forms.values():
        free = free[SelfCollisionChecker(form).free(free)]
    if len(free) < legs:
        raise MorphgenError("collides with itself nearly everywhere")
    corners = free[:legs].copy()
    if table_top is not None:
        lowest = forward_kinematics(robot, free)[..., 2, 3].min(axis=-1)
        pressing = np.argsort(np.abs(lowest - (table_top - PRESS)))
        corners[::2] = free[pressing[: -(-legs // 2)]]
    path = np.concatenate([np.reshape(robot.home, (1, -1)), corners])
    moments = np.arange(1, -(-args.steps // HOLD) + 1) * HOLD / LEG
    return np.stack([np.interp(moments, range(legs + 1), joint) for joint in path.T], axis=1)


def _speeds(
    make: Callable[[Robot], World],
    forms: dict[str, Robot],
    targets: Array,
    args: argparse.Namespace,
) -> dict[str, Speed]:
    """Return the speeds of all forms in one simulator and scene."""
    with ExitStack() as stack:
        worlds = {key: stack.enter_context(closing(make(form))) for key, form in forms.items()}
        contacts = {key: _contacts(world, targets, args.steps) for key, world in worlds.items()}
        seconds: dict[str, list[float]] = {key: [] for key in worlds}
        stable = dict.fromkeys(worlds, True)
        for block in range(args.blocks):
            for key in worlds if block % 2 == 0 else reversed(worlds):
                seconds[key].append(_block(worlds[key], targets, args.steps))
                stable[key] &= worlds[key].is_stable()
    steps = {key: args.steps / statistics.median(times) for key, times in seconds.items()}
    return {
        key: Speed(
            round(steps[key]),
            round(steps[key] / steps[HULL], 4),
            round(contacts[key], 4),
            stable[key] and stable[HULL],
        )
        for key in forms
    }


def _block(world: World, targets: Array, steps: int) -> float:
    """Return the duration of the steps of one block [s]."""
    world.reset()
    start = time.perf_counter()
    for i, target in enumerate(targets):
        world.hold(target, min(HOLD, steps - i * HOLD))
    return time.perf_counter() - start


def _contacts(world: World, targets: Array, steps: int) -> float:
    """Return the share of the steps of one block with a contact."""
    world.reset()
    touching = 0
    for step in range(steps):
        world.hold(targets[step // HOLD], 1)
        touching += world.touches()
    return touching / steps


def _report(rows: Sequence[Row]) -> str:
    """Return a table of the means of each geometry, and one of all arms."""
    kept = [key for key in GEOMETRIES if any(row.geometry == key for row in rows)]
    means = [_mean_line(key, [row for row in rows if row.geometry == key]) for key in kept]
    every = [
        _line(row) for row in sorted(rows, key=lambda row: (row.arm, kept.index(row.geometry)))
    ]
    return "\n\n".join(
        tabulate(lines, headers="keys", disable_numparse=True) for lines in (means, every) if lines
    )


def _line(row: Row) -> dict[str, str]:
    speeds = {
        f"{simulator}\n{scene}": f"{speed.ratio:.2f}" if speed.stable else "diverged"
        for simulator, scenes in row.speed.items()
        for scene, speed in scenes.items()
    }
    return {"arm": row.arm, "geometry": row.geometry} | _cells([row]) | speeds


def _mean_line(key: str, rows: Sequence[Row]) -> dict[str, str]:
    speeds = {}
    for simulator in {name: None for row in rows for name in row.speed}:
        for scene in SCENES:
            cells = (row.speed[simulator][scene] for row in rows if simulator in row.speed)
            ratios = [speed.ratio for speed in cells if speed.stable]
            speeds[f"{simulator}\n{scene}"] = _geometric_mean(ratios)
    return {"geometry": key, "arms": str(len(rows))} | _cells(rows) | speeds


def _cells(rows: Sequence[Row]) -> dict[str, str]:
    """Return the means of the columns that are not speeds; start-up is a geometric mean."""

    def mean(column: str, digits: int) -> str:
        return f"{statistics.fmean(getattr(row, column) for row in rows):.{digits}f}"

    simulators = {name: None for row in rows for name in row.load}
    return {
        "shapes": mean("shapes", 0),
        "agree": mean("agree", 3),
        "precision": mean("precision", 3),
        "recall": mean("recall", 3),
        "hull,\nsame pairs": mean("hull_agree", 3),
    } | {
        f"{name}\nload": _geometric_mean(
            row.load_ratio[name] for row in rows if name in row.load_ratio
        )
        for name in simulators
    }


def _geometric_mean(values: Iterable[float]) -> str:
    values = list(values)
    return f"{statistics.geometric_mean(values):.2f}" if values else ""


if __name__ == "__main__":
    sys.exit(main())

"""Speed-up of simulators when a robot's collision meshes are replaced by primitives.

    python benchmarks/primitive_speed.py [--only panda,ur5] [--single] [--steps 4000] [--blocks 7]

Simulates every real arm with collision meshes, with a fixed base and without a tool: once with the
meshes, which both simulators replace by convex hulls, and once with the stored fits of up to four
primitives per link (``--single``: one primitive, fitted now if no fit is stored). Both forms ignore
the same pairs of links: those that either form ignores. Position targets lead from home through
random configurations without self-collision, one per second, the same for both forms. Physics steps
have 5 ms; gravity and visuals are off. There are two scenes: the arm alone, and the arm above a
table just below its home configuration, on which every second configuration presses.

A row is an arm in a scene: links with collision shapes, vertices of their hulls, primitives; and
for each simulator the share of steps with a contact (meshes, primitives), thousands of steps per
second with meshes and with primitives, and the speed-up. The last row is the geometric mean of the
speed-ups without simulations that diverged. Steps per second are the median over the blocks, each
starting at home, after one warm-up block; meshes and primitives alternate. PyBullet also replaces
cylinders by hulls unless URDF_USE_IMPLICIT_CYLINDER is set, as it is here. Without PyBullet its
columns are missing, and the script prints that.
"""

from __future__ import annotations

import argparse
import statistics
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec

import mujoco
import numpy as np
from tabulate import tabulate
from tqdm import tqdm

import morphgen
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.fitting.replace_collision import as_primitives, with_primitives
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.fits import are_primitives
from morphgen.formats.mjcf import to_spec
from morphgen.grammar.library import Library, default_library
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import (
    forward_kinematics,
    random_configurations,
)
from morphgen.model.robot import Robot, sorted_pair
from morphgen.typing import Array
from worlds import Make, MujocoWorld, PybulletWorld, World

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


@dataclass(frozen=True)
class Arm:
    """Two forms of an arm, with meshes and with primitives, that ignore the same pairs."""

    name: str
    meshes: Robot
    primitives: Robot

    @property
    def table_top(self) -> float:
        """Height of the table top [m]."""
        return min(_lowest(self.meshes), _lowest(self.primitives)) - CLEARANCE


@dataclass(frozen=True)
class Speeds:
    """Speeds of one arm in one simulator; pairs hold the values of meshes and primitives."""

    contacts: tuple[float, float]
    """Share of the steps with a contact."""
    steps: tuple[float, float]
    """Steps per second."""
    stable: bool

    @property
    def ratio(self) -> float:
        """Speed of primitives divided by the speed of meshes."""
        return self.steps[1] / self.steps[0]


Table = dict[str, dict[str, Speeds]]
"""Speeds in one scene, by arm and simulator."""


def main() -> int:
    """Measure all arms and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", help="names of arms, separated by commas")
    parser.add_argument("--single", action="store_true", help="one primitive a link, not four")
    parser.add_argument("--steps", type=int, default=4000, help="steps of a block")
    parser.add_argument("--blocks", type=int, default=7)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    library = default_library()
    makers: dict[str, Make] = {"MuJoCo": MujocoWorld}
    if find_spec("pybullet") is not None:
        makers["PyBullet"] = PybulletWorld
    sizes: dict[str, tuple[int, int, int]] = {}
    scenes: dict[str, Table] = {"alone": {}, "above a table": {}}
    left_out = []
    for name in tqdm(_names(library, args.only), unit="arm", file=sys.stderr):
        arm = _arm(name, library, single=args.single)
        if arm is None:
            left_out.append(name)
            continue
        sizes[name] = _sizes(arm)
        for scene, table in scenes.items():
            top = None if scene == "alone" else arm.table_top
            targets = _targets(arm, top, args.steps, args.seed)
            table[name] = {
                simulator: _measure(partial(make, table_top=top), arm, targets, args)
                for simulator, make in makers.items()
            }
    for scene, table in scenes.items():
        print(f"{scene}:\n{_text(table, sizes, list(makers))}\n")
    if left_out:
        print(f"left out, for they have no collision meshes: {', '.join(left_out)}")
    if "PyBullet" not in makers:
        print("PyBullet is not installed: it is not in this run")
    return 0


def _names(library: Library, only: str | None) -> list[str]:
    if only:
        return [library.manifest(name, "arm").name for name in only.split(",")]
    return [m.name for m in library.manifests("arm") if not m.is_template and not m.scaling]


def _arm(name: str, library: Library, *, single: bool) -> Arm | None:
    """Return the two forms of an arm, or None if it has no collision meshes."""
    robot = morphgen.compose(f"arm={name}")
    if all(are_primitives(link.collisions) for link in robot.links):
        return None
    if single:
        shapes = token_shapes(robot, library.folders)
        fitted = with_primitives(robot, {link: (shape,) for link, shape in shapes.items()})
    else:
        fitted = as_primitives(robot, library.folders)
    ignored = tuple(sorted({sorted_pair(*p) for p in (*robot.ignore_pairs, *fitted.ignore_pairs)}))
    return Arm(name, _bare(robot, ignored), _bare(fitted, ignored))


def _bare(robot: Robot, ignored: tuple[tuple[str, str], ...]) -> Robot:
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


def _targets(arm: Arm, table_top: float | None, steps: int, seed: int) -> Array:
    """Return a path from home through random configurations, shape (n, dof).

    Each row is a target that is held for ``HOLD`` steps.

    Raises:
        RuntimeError: If too few configurations are free of self-collision.
    """
    legs = -(-steps // LEG)
    free = random_configurations(arm.meshes, TRIES * legs, np.random.default_rng(seed))
    for robot in (arm.meshes, arm.primitives):
        free = free[[not pairs for pairs in SelfCollisionChecker(robot).penetrations(free)]]
    if len(free) < legs:
        raise RuntimeError(f"{arm.name} collides with itself nearly everywhere")
    corners = free[:legs].copy()
    if table_top is not None:
        lowest = forward_kinematics(arm.meshes, free)[..., 2, 3].min(axis=-1)
        pressing = np.argsort(np.abs(lowest - (table_top - PRESS)))
        corners[::2] = free[pressing[: -(-legs // 2)]]
    path = np.concatenate([np.reshape(arm.meshes.home, (1, -1)), corners])
    moments = np.arange(1, -(-steps // HOLD) + 1) * HOLD / LEG
    return np.stack([np.interp(moments, range(legs + 1), joint) for joint in path.T], axis=1)


def _measure(
    make: Callable[[Robot], World], arm: Arm, targets: Array, args: argparse.Namespace
) -> Speeds:
    with ExitStack() as stack:
        worlds = [stack.enter_context(closing(make(r))) for r in (arm.meshes, arm.primitives)]
        first, second = (_contacts(world, targets, args.steps) for world in worlds)
        seconds: tuple[list[float], list[float]] = ([], [])
        stable = True
        for block in range(args.blocks):
            for i in (0, 1) if block % 2 == 0 else (1, 0):
                seconds[i].append(_block(worlds[i], targets, args.steps))
                stable &= worlds[i].is_stable()
    meshes, primitives = (args.steps / statistics.median(times) for times in seconds)
    return Speeds((first, second), (meshes, primitives), stable)


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


def _sizes(arm: Arm) -> tuple[int, int, int]:
    """Return the numbers of links with collision shapes, hull vertices and primitives."""
    model = to_spec(arm.meshes).compile()
    hulls = model.geom_dataid[model.geom_type == mujoco.mjtGeom.mjGEOM_MESH]
    links = sum(1 for link in arm.meshes.links if link.collisions)
    primitives = sum(len(link.collisions) for link in arm.primitives.links)
    return links, int(model.mesh_vertnum[hulls].sum()), primitives


def _text(table: Table, sizes: dict[str, tuple[int, int, int]], simulators: list[str]) -> str:
    headers = ["arm", "links", "hull\nvertices", "primitives"]
    for simulator in simulators:
        headers += [
            f"{simulator}:\ncontacts",
            "meshes\nk steps/s",
            "primitives\nk steps/s",
            "ratio",
        ]
    rows: list[list[object]] = []
    for name, speeds in table.items():
        cells = (cell for simulator in simulators for cell in _cells(speeds[simulator]))
        rows.append([name, *sizes[name], *cells])
    mean: list[object] = ["geometric mean", "", "", ""]
    for simulator in simulators:
        found = [speeds[simulator].ratio for speeds in table.values() if speeds[simulator].stable]
        mean += ["", "", "", f"{statistics.geometric_mean(found):.2f}" if found else ""]
    align = ("left", *["right"] * (len(headers) - 1))
    return tabulate([*rows, mean], headers, disable_numparse=True, colalign=align)


def _cells(speeds: Speeds) -> tuple[str, ...]:
    contacts = " ".join(f"{share:.0%}" for share in speeds.contacts)
    ratio = f"{speeds.ratio:.2f}" if speeds.stable else "unstable"
    return (contacts, *(f"{steps / 1000:.1f}" for steps in speeds.steps), ratio)


if __name__ == "__main__":
    sys.exit(main())

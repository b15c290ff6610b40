"""The page of a population: robots on one ground, arranged, moved and selected together.

They are arrays, so that a few operations move all of them. Every visual shape is an instance of a
unit box, cylinder or sphere, or of a mesh; a capsule is three instances. Arrays over instances are
sorted by what they are instances of.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from itertools import combinations
from pathlib import Path

import numpy as np
import torch
import trimesh
import viser
from numpy.typing import NDArray

from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.encoding.similarity import MEASURES, features, similarity_matrix
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX, grammar_names, grammar_text
from morphgen.grammar.library import Library
from morphgen.grammar.sampling import robot_name, sample_robot
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import joint_limits
from morphgen.model.kinematics_torch import KinematicTree, compile_tree, quaternion_from_matrix
from morphgen.model.kinematics_torch import forward_kinematics as batch_forward_kinematics
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Robot
from morphgen.progress import report
from morphgen.splits.split import SIDES, split_id
from morphgen.splits.split_file import split_names
from morphgen.typing import Array
from morphgen.viewer import markup, robot_uri
from morphgen.viewer.app.address import MAX_COMPARED, Address, parse_count
from morphgen.viewer.app.session import Session
from morphgen.viewer.app.workers import Workers
from morphgen.viewer.controls import RoleSliders, all_roles, bind, joint_roles
from morphgen.viewer.pages.gallery import show_index
from morphgen.viewer.robot_files import robot_facts
from morphgen.viewer.robot_rows import (
    UNITS,
    Row,
    facts_line,
    folder_rows,
    sort_rows,
    split_rows,
    uri_rows,
)
from morphgen.viewer.scene import stage
from morphgen.viewer.scene.robot import robot_bounds

UNIT_BOX, UNIT_CYLINDER, UNIT_SPHERE = Box((1.0, 1.0, 1.0)), Cylinder(0.5, 1.0), Sphere(0.5)
"""Primitives of which the others are scaled copies; their bounding boxes have edges of 1 m."""
Prototype = Box | Cylinder | Sphere | Mesh  # geometry of which instances are scaled copies


@dataclass(frozen=True, eq=False)
class Instances:
    """The shapes of all robots; m instances."""

    prototypes: dict[Prototype, slice]  # rows of the instances of each prototype
    robot: NDArray[np.intp]  # robot of each instance, shape (m,)
    link: NDArray[np.intp]  # link of each instance within its robot, shape (m,)
    T_link_shape: NDArray[np.float32]  # pose of each instance on its link, shape (m, 4, 4)
    scale: NDArray[np.float32]  # factors along the prototype's axes, shape (m, 3)
    colour: NDArray[np.uint8]  # red, green, blue, shape (m, 3)


@dataclass(frozen=True, eq=False)
class Population:
    """Robots that are drawn and moved together; n robots with at most J independent joints."""

    rows: tuple[Row, ...]  # names, URIs and facts
    robots: tuple[Robot, ...]
    instances: Instances
    tree: KinematicTree
    lower: Array  # lower joint limits, padded with 0, shape (n, J) [rad or m]
    upper: Array  # upper joint limits, padded with 0, shape (n, J) [rad or m]
    home: Array  # home configurations within the limits, padded with 0, shape (n, J) [rad or m]
    roles: tuple[str, ...]  # roles of the joints of any robot; see `controls.joint_roles`
    role: NDArray[np.intp]  # index into `roles`, shape (n, J); `len(roles)` for padding

    home_bounds: Array  # lowest and highest corners at home, shape (n, 2, 3) [m]

    def __len__(self) -> int:
        return len(self.robots)


@dataclass(frozen=True, eq=False)
class ReadRobot:
    """A robot that a worker has read."""

    row: Row
    robot: Robot
    bounds: Array  # lowest and highest corner at home, shape (2, 3) [m]


def make_population(read: Sequence[ReadRobot]) -> Population:
    """Compile robots, at least one."""
    robots = tuple(each.robot for each in read)
    n, most = len(robots), max(robot.dof for robot in robots)
    roles = all_roles(robots)
    index = {role: i for i, role in enumerate(roles)}
    lower, upper, home = np.zeros((3, n, most))
    role = np.full((n, most), len(roles), dtype=np.intp)
    for i, robot in enumerate(robots):
        dof = robot.dof
        lower[i, :dof], upper[i, :dof] = joint_limits(robot).T
        home[i, :dof] = robot.home
        role[i, :dof] = [index[name] for name in joint_roles(robot)]
    return Population(
        tuple(each.row for each in read),
        robots,
        make_instances(robots),
        compile_tree(robots),
        lower,
        upper,
        np.clip(home, lower, upper),
        tuple(roles),
        role,
        np.array([each.bounds for each in read]),
    )


def make_instances(robots: Sequence[Robot]) -> Instances:
    """Collect the visual shapes of robots, or the collision shapes of links without any."""
    members: dict[Prototype, list[tuple[int, int, Array, Array, stage.Rgb]]] = {}
    for i, robot in enumerate(robots):
        for j, link in enumerate(robot.links):
            for shape in link.visuals or link.collisions:
                for prototype, pose, scale in _copies(shape):
                    row = (i, j, pose.matrix, scale, stage.shape_colour(shape))
                    members.setdefault(prototype, []).append(row)
    prototypes, start = {}, 0
    for prototype, rows in members.items():
        prototypes[prototype] = slice(start, start + len(rows))
        start += len(rows)
    columns = list(zip(*(row for rows in members.values() for row in rows), strict=True))
    robot_index, link_index, poses, scales, colours = columns or [()] * 5
    return Instances(
        prototypes,
        np.array(robot_index, dtype=np.intp),
        np.array(link_index, dtype=np.intp),
        np.array(poses, dtype=np.float32).reshape(start, 4, 4),
        np.array(scales, dtype=np.float32).reshape(start, 3),
        np.array(colours, dtype=np.uint8).reshape(start, 3),
    )


def shape_poses(population: Population, q: Array) -> NDArray[np.float32]:
    """Return the poses (m, 4, 4) of the instances in their robots' root frames at q (n, J)."""
    index = torch.arange(len(population))
    positions = torch.from_numpy(np.ascontiguousarray(q, dtype=np.float32))
    T_root_link = batch_forward_kinematics(population.tree, index, positions).numpy()
    instances = population.instances
    return np.asarray(T_root_link[instances.robot, instances.link] @ instances.T_link_shape)


def move_roles(population: Population, q: Array, shares: dict[str, float]) -> Array:
    """Return configurations (n, J) with some roles' joints moved to shares of their ranges."""
    values = np.array([shares.get(role, np.nan) for role in population.roles] + [np.nan])
    share = values[population.role]
    moved = population.lower + share * (population.upper - population.lower)
    return np.where(np.isnan(share), q, moved)


def _copies(shape: Shape) -> list[tuple[Prototype, Pose, Array]]:
    pose = shape.T_link_shape
    match shape.geometry:
        case Box(size):
            return [(UNIT_BOX, pose, np.array(size))]
        case Cylinder(radius, length):
            return [(UNIT_CYLINDER, pose, np.array((2 * radius, 2 * radius, length)))]
        case Sphere(radius):
            return [(UNIT_SPHERE, pose, np.full(3, 2 * radius))]
        case Capsule(radius, length):
            ends = [pose @ Pose((0.0, 0.0, z)) for z in (-length / 2, length / 2)]
            middle = (UNIT_CYLINDER, pose, np.array((2 * radius, 2 * radius, length)))
            return [middle, *((UNIT_SPHERE, end, np.full(3, 2 * radius)) for end in ends)]
        case Mesh() as mesh:
            return [(mesh, pose, np.ones(3))]


MAX_FACES = 3000  # largest mesh that is drawn as it is [faces]; larger ones are simplified
MAX_SHADOWS = 300
"""Largest population that casts shadows [robots]: viser draws shadows up to 20 m from the camera,
which is nearer than larger ones are seen from, and each would be drawn four times."""
_CYLINDER_SECTIONS = 24
_SPHERE_SUBDIVISIONS = 2
_FADED_SHARE = 0.8  # share of the background's colour in robots that are not selected


class PopulationScene:
    """A population in the scene of one browser, its roots at positions (n, 2) on the ground [m]."""

    def __init__(self, client: viser.ClientHandle, population: Population) -> None:
        """Draw the robots at home, in the arrangement of a grid."""
        self.population = population
        self.positions, _ = arrange(population)
        self._client = client
        self._handles: dict[Prototype, viser.BatchedMeshHandle] = {}
        instances, (wxyzs, origins) = population.instances, self._poses(population.home)
        for number, (prototype, part) in enumerate(instances.prototypes.items()):
            is_mesh = isinstance(prototype, Mesh)
            self._handles[prototype] = client.scene.add_batched_meshes_simple(
                f"/population/{number}",
                *surface(prototype),
                batched_wxyzs=wxyzs[part],
                batched_positions=origins[part],
                batched_scales=instances.scale[part],
                batched_colors=stage.batch_colours(instances.colour[part]),
                lod="auto" if is_mesh else "off",
                cast_shadow=len(population) <= MAX_SHADOWS,
                side="double" if is_mesh else "front",  # some meshes have their faces inside out
            )

    def parts(self) -> Iterator[tuple[viser.BatchedMeshHandle, slice]]:
        """Yield the handle and the instances of every prototype."""
        for prototype, part in self.population.instances.prototypes.items():
            yield self._handles[prototype], part

    def move(self, positions: Array, q: Array) -> None:
        """Move all robots to positions and configurations (n, J); browsers get one message."""
        self.positions = positions
        wxyzs, origins = self._poses(q)
        with self._client.atomic():
            for handle, part in self.parts():
                handle.batched_wxyzs, handle.batched_positions = wxyzs[part], origins[part]

    def fade(self, selected: NDArray[np.bool_], background: stage.Rgb) -> None:
        """Fade the robots that are not in a selection (n,), unless it is empty."""
        instances = self.population.instances
        colours = instances.colour.astype(np.float64)
        if selected.any():
            faded = (1 - _FADED_SHARE) * colours + _FADED_SHARE * np.array(background)
            colours = np.where(selected[instances.robot][:, None], colours, faded)
        with self._client.atomic():
            for handle, part in self.parts():
                handle.batched_colors = stage.batch_colours(colours[part])

    def _poses(self, q: Array) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return rotations (w, x, y, z) and positions of all instances in the world."""
        poses = shape_poses(self.population, q)
        poses[:, :2, 3] += self.positions[self.population.instances.robot]
        wxyzs = quaternion_from_matrix(torch.from_numpy(poses[:, :3, :3])).numpy()
        return wxyzs, poses[:, :3, 3]


def surface(prototype: Prototype) -> stage.Triangles:
    """Return the surface of a prototype, simplified because it is drawn many times."""
    match prototype:
        case Box():
            return stage.triangles(prototype)
        case Sphere(radius):
            ball = trimesh.creation.icosphere(subdivisions=_SPHERE_SUBDIVISIONS, radius=radius)
            return stage.mesh_arrays(ball)
        case Cylinder(radius, length):
            tube = trimesh.creation.cylinder(radius, length, sections=_CYLINDER_SECTIONS)
            return stage.mesh_arrays(trimesh.graph.smooth_shade(tube, angle=stage.SHARP_ANGLE))
        case Mesh() as mesh:
            loaded = load_mesh(mesh)
            if len(loaded.faces) <= MAX_FACES:
                return stage.triangles(mesh)
            # Arrays of meshes are read-only, which the simplification refuses.
            arrays = np.array(loaded.vertices), np.array(loaded.faces)
            copy = trimesh.Trimesh(*arrays, process=False)
            simple = copy.simplify_quadric_decimation(face_count=MAX_FACES)
            return stage.mesh_arrays(trimesh.graph.smooth_shade(simple, angle=stage.SHARP_ANGLE))


MAX_ROBOTS = 1000  # largest population [robots]
NUM_SAMPLED = 100  # robots that are sampled from a grammar by default
_CHUNK = 20  # robots of one call of a worker
ASPECT = 0.7  # width of an arrangement by its depth: seen from the front above, it fills a window
_MAX_LABELS = 16  # labels beside rows: more would cover each other
_WORD_GAP = 0.2  # gap between neighbours [median widths]
_LABEL_GAP = 0.3  # gap between labels and rows [m]
_QUANTILE = 0.8  # share of a row's robots that its depth holds; others cover those behind a little


@dataclass(frozen=True)
class Source:
    """Robots that an address names."""

    rows: tuple[Row, ...]  # at most `MAX_ROBOTS`, with the facts that are known
    total: int  # number of robots that the address names
    grammar: str = ""  # name or file of the grammar from which the robots are sampled; else empty
    seed: int = 0  # seed of the sample
    stamp: str = ""  # changes with the files of the robots, the split or the grammar

    @property
    def key(self) -> str:
        """Name of the robots among the results that all browsers share."""
        return f"{hash(self)}"


def find_source(subject: str, files: robot_uri.FileAccess, seed: int, number: int) -> Source:
    """List the robots that an address names."""
    name, at, side = subject.rpartition("@")
    if not at:
        name, side = subject, ""
    elif side not in SIDES:
        raise robot_uri.UriError(f"{subject}: unknown side {side!r}; expected @train or @test")
    if name in grammar_names() or name.endswith(SUFFIX):
        number = min(max(number, 1), MAX_ROBOTS)
        grammar = robot_uri.resolve_grammar(name, files)
        names = [robot_name(grammar, i) for i in range(number)]
        rows = [Row(text, text, grammar.name, order=i) for i, text in enumerate(names)]
        return Source(tuple(rows), number, name, seed, grammar_text(grammar))
    if name in split_names() or name.endswith(".yaml") or (files.path(name) / SPLIT_FILE).is_file():
        split = robot_uri.resolve_split(name, files)
        rows = [row for row in split_rows(name, split) if side in ("", row.role)]
        stamp = split_id(split)
    elif side:
        raise robot_uri.UriError(f"{subject}: only a split has sides; {name} is a folder")
    else:
        return _listed_source(folder_rows(name, files), files)
    return Source(tuple(rows[:MAX_ROBOTS]), len(rows), stamp=stamp)


def _listed_source(rows: Sequence[Row], files: robot_uri.FileAccess) -> Source:
    stamp = "\n".join(robot_uri.content_hash(row.uri, files) for row in rows[:MAX_ROBOTS])
    return Source(tuple(rows[:MAX_ROBOTS]), len(rows), stamp=stamp)


def load_population(
    source: Source, files: robot_uri.FileAccess, workers: Workers
) -> tuple[Population, list[tuple[str, str]]]:
    """Read the robots in the workers; return also the name and error of those that are broken."""
    chunks = [source.rows[i : i + _CHUNK] for i in range(0, len(source.rows), _CHUNK)]
    calls = [
        workers.submit(read_robots, chunk, files, source.grammar, source.seed) for chunk in chunks
    ]
    results: list[ReadRobot | tuple[str, str]] = []
    for call in calls:
        read_chunk: list[ReadRobot | tuple[str, str]] = workers.result(call)
        results += read_chunk
        report(len(results), len(source.rows))
    faults = [result for result in results if not isinstance(result, ReadRobot)]
    read = [result for result in results if isinstance(result, ReadRobot)]
    if not read:
        raise robot_uri.UriError(f"no robot can be read; the first error: {faults[0][1]}")
    return make_population(read), faults


def read_robots(
    rows: Sequence[Row], files: robot_uri.FileAccess, grammar_name: str = "", seed: int = 0
) -> list[ReadRobot | tuple[str, str]]:
    """In a worker, read or sample robots and measure them, or return name and error of each."""
    grammar = robot_uri.resolve_grammar(grammar_name, files) if grammar_name else None
    results: list[ReadRobot | tuple[str, str]] = []
    for row in rows:
        try:
            if grammar is None:
                robot = robot_uri.read_robot_uri(row.uri, files)
            else:
                sample = sample_robot(grammar, files.library, row.order, seed=seed)
                robot, uri = sample.robot, f"{robot_uri.DERIVATION}{sample.derivation}"
                codes = sorted({finding.code for finding in sample.findings})
                row = replace(row, uri=uri, findings=tuple(codes))
            robot = split_colours(robot)
            if row.dof is None or row.reach is None:
                row = row.completed(robot_facts(robot))
            results.append(ReadRobot(row, robot, np.array(robot_bounds(robot))))
        except MorphgenError as error:
            results.append((row.name, files.redact(error)))
    return results


Labels = list[tuple[str, tuple[float, float]]]  # texts on the ground and their positions [m]


def arrange(population: Population, fact: str = "") -> tuple[Array, Labels]:
    """Return positions (n, 2) [m] of robots in rows from the far left to the near right.

    With a fact, the smallest come first, and labels have the values of rows' first robots. Without,
    few robots stand in one row, with their names.
    """
    rows, bounds = population.rows, population.home_bounds
    index = {row.uri: i for i, row in enumerate(rows)}
    order = [index[row.uri] for row in sort_rows(rows, fact)] if fact else list(range(len(rows)))
    is_one_row = not fact and len(rows) <= MAX_COMPARED
    places, firsts = _rows_of(bounds[order], one=is_one_row)
    positions = np.zeros((len(rows), 2))
    positions[order] = places
    if is_one_row:
        return positions, [
            (row.name, (x, y)) for row, (x, y) in zip(rows, positions.tolist(), strict=True)
        ]
    if not fact:
        return positions, []
    edge = float((places[:, 0] + bounds[order, 0, 0]).min()) - _LABEL_GAP
    labels: Labels = []
    for i in firsts[:: math.ceil(len(firsts) / _MAX_LABELS)]:
        value = getattr(rows[order[i]], fact)
        text = "unknown" if value is None else f"{value:.3g} {UNITS[fact]}"
        labels.append((text, (edge, float(places[i, 1]))))
    return positions, labels


def _rows_of(bounds: Array, *, one: bool) -> tuple[Array, list[int]]:
    """Return a place (n, 2) [m] for each robot, like words of a text, and each row's first robot.

    A row takes the depth of most of its robots, so that few large ones do not shrink others.
    """
    size = np.maximum(bounds[:, 1] - bounds[:, 0], 0.01)
    slot = size[:, 0] + _WORD_GAP * np.median(size[:, 0])
    # Rows also need room for their height, by which they hide what is behind them.
    depth = np.maximum(1.2 * size[:, 1], np.maximum(0.35 * size[:, 0], 0.75 * size[:, 2]))
    ends = np.cumsum(slot)
    num_rows = (
        1 if one else max(round(ends[-1] / math.sqrt(ASPECT * float((slot * depth).sum()))), 1)
    )
    row = np.minimum((ends - slot / 2) / ends[-1] * num_rows, num_rows - 1e-9).astype(int)
    positions, firsts, y = np.zeros((len(bounds), 2)), [], 0.0
    for k in np.unique(row):
        members = np.flatnonzero(row == k)
        firsts.append(int(members[0]))
        right = np.cumsum(slot[members])
        left = right - slot[members] - right[-1] / 2
        y -= float(np.quantile(depth[members], _QUANTILE))
        positions[members] = np.stack([left - bounds[members, 0, 0], np.full(len(left), y)], axis=1)
    positions[:, 1] -= y / 2
    return positions, firsts


PANEL_WIDTH = 340.0  # width of the panel [pixels]
ARRANGEMENTS = {
    "grid": "grid",
    "reach": "rows by reach",
    "mass": "rows by mass",
    "dof": "rows by DoF",
}
"""Labels of the arrangements by their key in the address."""
CAMERA_DIRECTION = (0.08, -0.8, 0.6)  # to the camera, which sees rows from left to right
_NUM_NAMED = 5  # selected robots that are listed
NONE_TO_COMPARE = (
    "<h2>Compare two to four robots</h2>Tick the box of cards in a gallery, or of a robot's page, "
    "and press <i>compare</i> below."
)


def show(session: Session) -> None:
    """Build the page."""
    if not session.address.subject:
        show_index(session)
        return
    subject, state = session.address.subject, session.address.state
    seed = parse_count(state.get("seed", ""), 0)
    number = parse_count(state.get("number", ""), NUM_SAMPLED)
    source = find_source(subject, session.files, seed, number)
    for key in ("seed", "number") if source.grammar else ():
        session.keep(key)
    _open(session, source, (subject, _gallery_address(subject, source)), ("population", None))


def show_compared(session: Session) -> None:
    """Build the page that compares few robots: their population, and how similar they are."""
    uris = tuple(filter(None, session.address.subjects))
    if len(uris) > MAX_COMPARED:
        raise robot_uri.UriError(f"{len(uris)} robots to compare: expected 2 to {MAX_COMPARED}")
    if uris:
        rows = uri_rows(uris, session.files)
        _open(session, _listed_source(rows, session.files), ("compare", None))
        return
    session.open_panel(PANEL_WIDTH, markup.breadcrumbs(("compare", None)))
    session.client.gui.add_html(markup.framed(NONE_TO_COMPARE))
    session.show_address("compare")


def _open(session: Session, source: Source, *steps: tuple[str, Address | None]) -> None:
    """Open the panel, and show the robots when they are read."""
    crumbs = markup.breadcrumbs(*steps)
    session.open_panel(PANEL_WIDTH, crumbs, f"reading {len(source.rows)} robots")

    def load() -> None:
        """Read the robots, once for all browsers, and show them."""
        population, faults = session.cached(
            f"population {source.key}",
            lambda: load_population(source, session.files, session.workers),
            "reading {} robots",
        )
        session.enqueue(lambda: PopulationPage(session, source, population, faults))

    session.run_in_background(load)


def _gallery_address(subject: str, source: Source) -> Address:
    if source.grammar:
        return Address("compose", (source.grammar,))
    split = subject.rpartition("@")[0] or subject
    return Address("split" if source.rows[0].role else "gallery", (split,))


class PopulationPage:
    """A population in one browser."""

    def __init__(
        self,
        session: Session,
        source: Source,
        population: Population,
        faults: Sequence[tuple[str, str]],
    ) -> None:
        """Draw the robots, add the controls, and apply the address."""
        client, gui = session.client, session.client.gui
        session.set_status("sending the shapes to the browser")
        self.session, self.population = session, population
        self.scene = PopulationScene(client, population)
        self.selected = np.zeros(len(population), np.bool_)  # mask of the selected robots
        self._labels: list[viser.LabelHandle] = []
        gui.add_html(markup.framed(summary(source, population, faults)))
        self._similarity = gui.add_html("")
        self._arrange = gui.add_dropdown("Arrange", tuple(ARRANGEMENTS.values()))
        home = gui.add_button("Home", icon=viser.Icon.HOME)
        bind(session, "arrange", self._arrange, tuple(ARRANGEMENTS))
        session.keep("select", lambda: format_selection(self.selected), self._apply_selection)
        self._sliders = RoleSliders(session, self._move)
        self._add_sliders()
        self._selection = gui.add_html("")
        select = gui.add_button_group("Select", ("all", "none", "invert"))
        choose = gui.add_button(
            "Choose", icon=viser.Icon.CHECKBOX, hint="add them to the chosen robots"
        )
        session.on_change(self._arrange, self._show_arrangement, "arrange")
        session.on_change(home, self._sliders.go_home)
        session.on_change(select, lambda: self._change_selection(select.value))
        session.on_change(choose, self._choose)
        self._connect_pointer()
        session.set_status("")
        is_comparison = session.address.page == "compare"
        names = ", ".join(row.name for row in population.rows)
        session.title = f"compare {names}" if is_comparison else session.address.subject
        session.apply_state()
        self._show_arrangement()
        self.select(self.selected)
        if is_comparison:
            session.run_in_background(self._compare)

    def _compare(self) -> None:
        """Show how similar the robots are, or why they cannot be compared."""
        session, rows = self.session, self.population.rows
        lines = markup.dim("<br>".join(map(_row_line, rows)))
        try:
            with session.activity("comparing"):
                similarity = session.workers.call(
                    compare_robots, self.population.robots, session.files.library_folders
                )
            table = f"<h3>Similarity</h3>{similarity_table([row.name for row in rows], similarity)}"
        except MorphgenError as error:
            tag = markup.tag("cannot be compared", "warning")
            table = f"{tag}{escape(session.files.redact(error))}"
        self._similarity.content = markup.framed(lines, table)

    def select(self, selected: NDArray[np.bool_]) -> None:
        """Select robots by a mask (n,), in the scene, the panel and the address."""
        self.selected = selected
        self.scene.fade(selected, stage.background_colour(dark=self.session.dark))
        self._selection.content = markup.framed(selection_text(self._selected_rows))
        self.session.show_state()

    @property
    def _selected_rows(self) -> list[Row]:
        return [self.population.rows[i] for i in np.flatnonzero(self.selected)]

    def _apply_selection(self, text: str) -> None:
        self.selected = parse_selection(text, len(self.population))

    def _change_selection(self, action: str) -> None:
        everything = np.full(len(self.population), action == "all")
        self.select(~self.selected if action == "invert" else everything)

    def _choose(self) -> None:
        if not self._selected_rows:
            raise robot_uri.UriError(
                "no robot is selected: drag a rectangle with the shift key held"
            )
        uris = (row.uri for row in self._selected_rows)
        self.session.choose((*self.session.chosen, *uris))

    def _add_sliders(self) -> None:
        gui, roles, role = self.session.client.gui, self.population.roles, self.population.role
        for title, initial in (
            ("Joints from the base to the tool", "j"),
            ("Fingers and others", "f"),
        ):
            if names := [name for name in roles if name[0] == initial]:
                with gui.add_folder(title, expand_by_default=initial == "j"):
                    for name in names:
                        count = int((role == roles.index(name)).any(axis=1).sum())
                        self._sliders.add(name, f"share of its range, of {count} robots")

    def _configurations(self) -> NDArray[np.float64]:
        """Return the configurations of all robots, shape (n, J) [rad or m]."""
        return move_roles(self.population, self.population.home, self._sliders.moved)

    def _move(self) -> None:
        self.scene.move(self.scene.positions, self._configurations())
        self.session.show_state_later()

    def _show_arrangement(self) -> None:
        """Move the robots to their places, with labels and the camera in front of them."""
        client, bounds = self.session.client, self.population.home_bounds
        fact = next(key for key, label in ARRANGEMENTS.items() if label == self._arrange.value)
        positions, labels = arrange(self.population, "" if fact == "grid" else fact)
        roots = np.pad(positions, ((0, 0), (0, 1)))
        points = np.array([(*position, 0.0) for _, position in labels]).reshape(-1, 3)
        low = np.concatenate([bounds[:, 0] + roots, points]).min(axis=0)
        high = np.concatenate([bounds[:, 1] + roots, points]).max(axis=0)
        with client.atomic():
            for handle in self._labels:
                handle.remove()
            self.scene.move(positions, self._configurations())
            self._labels = [
                client.scene.add_label(f"/labels/{i}", text, position=(*position, 0.0))
                for i, (text, position) in enumerate(labels)
            ]
            stage.add_ground(client.scene, float(np.linalg.norm(high - low)))
            stage.look_at(client, low, high, CAMERA_DIRECTION)
        self.session.show_state()

    def _connect_pointer(self) -> None:
        session, robots = self.session, np.arange(len(self.population))

        def click(part: slice, event: viser.SceneNodePointerEvent[viser.BatchedMeshHandle]) -> None:
            index, shift = event.instance_index, event.modifier == "shift"
            if index is not None and 0 <= index < part.stop - part.start:  # browsers may send any
                clicked = robots == self.population.instances.robot[part.start + index]
                session.enqueue(lambda: self.select(self.selected ^ clicked if shift else clicked))

        for handle, part in self.scene.parts():
            for modifier in (None, "shift"):
                handle.on_click(modifier=modifier)(functools.partial(click, part))
        session.client.scene.on_rect_select(modifier="shift")(
            lambda event: session.enqueue(lambda: self.select(self._inside(event)))
        )

    def _inside(self, event: viser.SceneRectSelectEvent) -> NDArray[np.bool_]:
        """Return which robots have their middle inside a rectangle of the picture, shape (n,)."""
        view = stage.camera_view(self.session.client)
        corners = np.array([event.screen_min, event.screen_max]) * (view.aspect, 1.0)
        centres = self.population.home_bounds.mean(axis=1)
        centres[:, :2] += self.scene.positions
        points, depth = stage.project_points(view, centres)
        inside = (points >= corners.min(axis=0)) & (points <= corners.max(axis=0))
        return np.asarray(inside.all(axis=1) & (depth > 0))


def summary(source: Source, population: Population, faults: Sequence[tuple[str, str]]) -> str:
    """Return the number of robots, what is missing, and how to use the pointer."""
    text = f"<h3>{len(population)} robot{'s' * (len(population) != 1)}</h3>"
    if source.total > len(source.rows):
        text += markup.dim(f"the first {len(source.rows)} of {source.total}")
    if faults:
        lines = "<br>".join(f"{escape(name)}: {escape(error)}" for name, error in faults[:5])
        text += f"{markup.tag(f'{len(faults)} cannot be read', 'error')}{markup.dim(lines)}"
    if len(population) > MAX_SHADOWS:
        text += markup.dim(f"without shadows: more than {MAX_SHADOWS} robots")
    return text + markup.dim(
        "Click a robot to select it, with the shift key to add or remove it. Shift and drag "
        "selects a rectangle."
    )


def selection_text(rows: Sequence[Row]) -> str:
    """Return the selected robots with links, and the ranges of their facts, as HTML."""
    if not rows:
        return markup.dim("no robot is selected")
    lines = [_row_line(row) for row in rows[:_NUM_NAMED]]
    if len(rows) > _NUM_NAMED:
        lines.append("...")
    for fact in ("reach", "mass", "dof") if len(rows) > 1 else ():
        values = [value for row in rows if (value := getattr(row, fact)) is not None]
        if values:
            low, high = min(values), max(values)
            numbers = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            lines.append(f"{'' if fact == 'dof' else fact + ' '}{numbers} {UNITS[fact]}")
    return f"<b>{len(rows)} selected</b>{markup.dim('<br>'.join(lines))}"


def _row_line(row: Row) -> str:
    """Return a robot with a link, its facts and findings as HTML."""
    findings = escape(", ".join(row.findings or ()))
    link = markup.link(Address("robot", (row.uri,)), row.name)
    return f"{link} {escape(facts_line(row))} {findings}".rstrip()


def compare_robots(robots: Sequence[Robot], folders: Sequence[Path]) -> dict[str, Array]:
    """Return the similarity of every pair by measure, shape (n, n). Runs in a worker."""
    library = Library(folders)
    robots = [robot_uri.with_library_meshes(robot, library) for robot in robots]
    # Splits fix the number of links; here the largest robot does.
    max_links = default_max_links(len(robot.links) for robot in robots)
    compared = [
        features(robot, token_shapes(robot, folders), max_links=max_links) for robot in robots
    ]
    return {name: similarity_matrix(compared, name) for name in MEASURES}


def similarity_table(names: Sequence[str], similarity: Mapping[str, Array]) -> str:
    """Return a table with a row for each pair of robots and a column for each measure."""
    header = [""]
    for name, measure in MEASURES.items():
        direction = "larger" if measure.larger_is_more_alike else "smaller"
        header.append(f"{name} ({direction} is more similar)")
    rows = [
        (
            f"{escape(names[i])} and {escape(names[j])}",
            *(f"{similarity[name][i, j]:.3f}" for name in MEASURES),
        )
        for i, j in combinations(range(len(names)), 2)
    ]
    return markup.table(header, rows, range(1, len(header)))


def format_selection(selected: NDArray[np.bool_]) -> str:
    """Return the indices of selected robots as ranges, such as ``0-4,9``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], selected, [False]]).astype(int)))
    pairs = edges.reshape(-1, 2).tolist()
    return ",".join(f"{a}" if b == a + 1 else f"{a}-{b - 1}" for a, b in pairs)


def parse_selection(text: str, n: int) -> NDArray[np.bool_]:
    """Return the mask of robots that ranges select, shape (n,); what is invalid selects nothing."""
    selected = np.zeros(n, dtype=np.bool_)
    for part in text.split(","):
        first, dash, last = part.partition("-")
        start = parse_count(first, n)
        selected[start : (parse_count(last, -1) if dash else start) + 1] = True
    return selected

"""Many robots as arrays, so that a few operations move all of them.

Every visual shape is an instance of a unit box, cylinder or sphere, or of a mesh; a capsule is
three instances. Arrays over instances are sorted by what they are instances of.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.benchmark.similarity import classical_mds, compared_tokens
from morphgen.benchmark.split import SIDES, split_id
from morphgen.benchmark.split_file import split_names
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.benchmark.tokens import default_max_links
from morphgen.checks.self_collision import SelfCollisionChecker
from morphgen.errors import MorphgenError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.bundle import split_colours
from morphgen.grammar.grammar_file import SUFFIX, grammar_names, grammar_text
from morphgen.grammar.sampling import robot_name, sample_robot
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Primitive, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics, joint_limits, random_configurations, reach
from morphgen.model.kinematics_torch import KinematicTree, compile_tree
from morphgen.model.kinematics_torch import forward_kinematics as batch_forward_kinematics
from morphgen.model.robot import Robot
from morphgen.progress import report
from morphgen.typing import Array
from morphgen.viewer.app.workers import Workers
from morphgen.viewer.comparison import all_roles, joint_roles
from morphgen.viewer.robot_rows import Row, folder_rows, split_rows
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import (
    DERIVATION,
    FileAccess,
    UriError,
    content_hash,
    read_robot_uri,
    resolve_grammar,
    resolve_split,
    with_library_meshes,
)
from morphgen.viewer.scene.stage import shape_colour

UNIT_BOX, UNIT_CYLINDER, UNIT_SPHERE = Box((1.0, 1.0, 1.0)), Cylinder(0.5, 1.0), Sphere(0.5)
"""Primitives of which the others are scaled copies; their bounding boxes have edges of 1 m."""
Prototype = Box | Cylinder | Sphere | Mesh
"""Geometry of which instances are scaled copies."""


@dataclass(frozen=True, eq=False)
class Instances:
    """The shapes of all robots; m instances."""

    prototypes: dict[Prototype, slice]
    """Instances of each prototype."""
    robot: NDArray[np.intp]
    """Robot of each instance, shape (m,)."""
    link: NDArray[np.intp]
    """Link of each instance within its robot, shape (m,)."""
    T_link_shape: NDArray[np.float32]
    """Pose of each instance on its link, shape (m, 4, 4)."""
    scale: NDArray[np.float32]
    """Factors by which the prototype is scaled along its axes, shape (m, 3)."""
    centre: NDArray[np.float32]
    """Centre of the bounding box in the frame of the shape, shape (m, 3) [m]."""
    size: NDArray[np.float32]
    """Edges of the bounding box in the frame of the shape, shape (m, 3) [m]."""
    colour: NDArray[np.uint8]
    """Colour, shape (m, 3)."""


@dataclass(frozen=True, eq=False)
class Population:
    """Robots that are drawn and moved together; n robots with at most J independent joints."""

    rows: tuple[Row, ...]
    """Names, URIs and facts."""
    robots: tuple[Robot, ...]
    instances: Instances
    tree: KinematicTree
    lower: Array
    """Lower joint limits, padded with 0, shape (n, J) [rad or m]."""
    upper: Array
    """Upper joint limits, padded with 0, shape (n, J) [rad or m]."""
    home: Array
    """Home configurations within the limits, padded with 0, shape (n, J) [rad or m]."""
    roles: tuple[str, ...]
    """Roles of the joints of any robot; see ``comparison.joint_roles``."""
    role: NDArray[np.intp]
    """Index into ``roles`` of each joint, shape (n, J); ``len(roles)`` for padding."""

    def __len__(self) -> int:
        return len(self.robots)

    @cached_property
    def home_bounds(self) -> Array:
        """Lowest and highest corner of each robot at home in its root frame, (n, 2, 3) [m]."""
        return robot_bounds(self, shape_poses(self, self.home))


def make_population(rows: Sequence[Row], robots: Sequence[Robot]) -> Population:
    """Compile robots, at least one."""
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
    home = np.clip(home, lower, upper)
    instances = make_instances(robots)
    tree = compile_tree(robots)
    return Population(
        tuple(rows), tuple(robots), instances, tree, lower, upper, home, tuple(roles), role
    )


def make_instances(robots: Sequence[Robot]) -> Instances:
    """Collect the visual shapes of robots, or the collision shapes of links without any."""
    members: dict[Prototype, list[tuple[int, int, Array, Array, Array, Array, object]]] = {}
    for i, robot in enumerate(robots):
        for j, link in enumerate(robot.links):
            for shape in link.visuals or link.collisions:
                colour = shape_colour(shape)
                for prototype, pose, scale in _copies(shape):
                    centre, size = _box(prototype, scale)
                    row = (i, j, pose.matrix, scale, centre, size, colour)
                    members.setdefault(prototype, []).append(row)
    prototypes, start = {}, 0
    for prototype, rows in members.items():
        prototypes[prototype] = slice(start, start + len(rows))
        start += len(rows)
    columns = list(zip(*(row for rows in members.values() for row in rows), strict=True))
    if not columns:
        columns = [()] * 7
    robot_index, link_index, *arrays, colours = columns
    T, scales, centres, sizes = (
        np.array(values, dtype=np.float32).reshape(start, *shape)
        for values, shape in zip(arrays, ((4, 4), (3,), (3,), (3,)), strict=True)
    )
    return Instances(
        prototypes,
        np.array(robot_index, dtype=np.intp),
        np.array(link_index, dtype=np.intp),
        T,
        scales,
        centres,
        sizes,
        np.array(colours, dtype=np.uint8).reshape(start, 3),
    )


def shape_poses(population: Population, q: Array) -> NDArray[np.float32]:
    """Return the pose of every instance in the root frame of its robot.

    q: Independent joint positions, shape (n, J) [rad or m].

    Returns:
        Shape (m, 4, 4).
    """
    index = torch.arange(len(population))
    positions = torch.from_numpy(np.ascontiguousarray(q, dtype=np.float32))
    T_root_link = batch_forward_kinematics(population.tree, index, positions).numpy()
    instances = population.instances
    return np.asarray(T_root_link[instances.robot, instances.link] @ instances.T_link_shape)


def instance_centres(instances: Instances, poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the centres of the bounding boxes of instances at poses (m, 4, 4), (m, 3) [m]."""
    turned = (poses[:, :3, :3] @ instances.centre[..., None])[..., 0]
    return np.asarray(turned + poses[:, :3, 3])


def robot_bounds(population: Population, T_root_shape: NDArray[np.float32]) -> Array:
    """Return the bounding boxes of robots in their root frames; the root's origin counts too.

    T_root_shape: Poses of all instances, shape (m, 4, 4).

    Returns:
        Lowest and highest corners, shape (n, 2, 3) [m].
    """
    instances = population.instances
    centre = instance_centres(instances, T_root_shape)
    half = (np.abs(T_root_shape[:, :3, :3]) @ instances.size[..., None])[..., 0] / 2
    bounds = np.zeros((len(population), 2, 3))
    np.minimum.at(bounds[:, 0], instances.robot, centre - half)
    np.maximum.at(bounds[:, 1], instances.robot, centre + half)
    return bounds


def move_roles(population: Population, q: Array, shares: dict[str, float]) -> Array:
    """Return configurations with the joints of some roles moved.

    q: Independent joint positions, shape (n, J) [rad or m].

    Returns:
        Shape (n, J).
    """
    values = np.array([shares.get(role, np.nan) for role in population.roles] + [np.nan])
    share = values[population.role]
    moved = population.lower + share * (population.upper - population.lower)
    return np.where(np.isnan(share), q, moved)


def _copies(shape: Shape) -> list[tuple[Prototype, Pose, Array]]:
    """Return the prototypes that draw a shape, with their poses on the link and their scales."""
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


def _box(prototype: Prototype, scale: Array) -> tuple[Array, Array]:
    """Return the centre and the edges of a scaled prototype's bounding box in its frame [m]."""
    if isinstance(prototype, Primitive):
        return np.zeros(3), scale
    low, high = bounding_box((Shape(prototype),))
    return (low + high) / 2, high - low


T = TypeVar("T")

MAX_ROBOTS = 1000
"""Largest population."""
NUM_SAMPLED = 100
"""Robots that are sampled from a grammar by default."""
NUM_POSES = 8
"""Configurations without self-collision of each robot."""
_MAX_TRIES = 256
"""Random configurations that are tested to find them; a robot without any stays at home."""
_GROUND_TOLERANCE = 1e-3
"""Height below the ground at which the origin of a link still counts as above it [m]."""
_CHUNK = 20
"""Robots of one call of a worker."""


@dataclass(frozen=True)
class Source:
    """Robots that an address names."""

    rows: tuple[Row, ...]
    """At most ``MAX_ROBOTS``, with the facts that are known."""
    total: int
    """Number of robots that the address names."""
    grammar: str = ""
    """Name or file of the grammar from which the robots are sampled; else empty."""
    seed: int = 0
    """Seed of the sample."""
    stamp: str = ""
    """Changes with the files of the robots, the split or the grammar."""

    @property
    def key(self) -> str:
        """Name of the robots among the results that all browsers share."""
        return f"{hash(self)}"


@dataclass(frozen=True, eq=False)
class ReadRobot:
    """A robot that a worker has read, or why it has not."""

    row: Row
    robot: Robot | None
    error: str = ""


def find_source(subject: str, files: FileAccess, seed: int, number: int) -> Source:
    """List the robots that an address names."""
    name, at, side = subject.rpartition("@")
    if not at:
        name, side = subject, ""
    elif side not in SIDES:
        raise UriError(f"{subject}: unknown side {side!r}; expected @train or @test")
    if name in grammar_names() or name.endswith(SUFFIX):
        number = min(max(number, 1), MAX_ROBOTS)
        grammar = resolve_grammar(name, files)
        names = [robot_name(grammar, i) for i in range(number)]
        rows = [Row(text, text, grammar.name, order=i) for i, text in enumerate(names)]
        return Source(tuple(rows), number, name, seed, grammar_text(grammar))
    if name in split_names() or name.endswith(".yaml") or (files.path(name) / SPLIT_FILE).is_file():
        split = resolve_split(name, files)
        rows = [row for row in split_rows(name, split) if side in ("", row.role)]
        stamp = split_id(split)
    elif side:
        raise UriError(f"{subject}: only a split has sides; {name} is a folder")
    else:
        rows = folder_rows(name, files)
        stamp = "\n".join(content_hash(row.uri, files) for row in rows[:MAX_ROBOTS])
    return Source(tuple(rows[:MAX_ROBOTS]), len(rows), stamp=stamp)


def load_population(
    source: Source, files: FileAccess, workers: Workers
) -> tuple[Population, list[tuple[str, str]]]:
    """Read the robots in the workers.

    Returns:
        The population of all robots that can be read; name and error of each other one.
    """
    chunks = _chunks(source.rows)
    if source.grammar:
        calls = [
            workers.submit(sample_robots, source.grammar, source.seed, chunk, files)
            for chunk in chunks
        ]
    else:
        calls = [workers.submit(read_robots, chunk, files) for chunk in chunks]
    results = _gather(calls, workers, len(source.rows))
    faults = [(result.row.name, result.error) for result in results if result.robot is None]
    read = [(result.row, result.robot) for result in results if result.robot is not None]
    if not read:
        raise UriError(f"no robot can be read; the first error: {faults[0][1]}")
    return make_population([row for row, _ in read], [robot for _, robot in read]), faults


def read_robots(rows: Sequence[Row], files: FileAccess) -> list[ReadRobot]:
    """Read robots, and measure the facts that their rows lack. Runs in a worker."""
    results = []
    for row in rows:
        try:
            robot = split_colours(read_robot_uri(row.uri, files))
            results.append(ReadRobot(_measured(row, robot), robot))
        except MorphgenError as error:
            results.append(ReadRobot(row, None, files.redact(error)))
    return results


def sample_robots(name: str, seed: int, rows: Sequence[Row], files: FileAccess) -> list[ReadRobot]:
    """Sample the robots of a grammar that rows list. Runs in a worker."""
    grammar, results = resolve_grammar(name, files), []
    for row in rows:
        try:
            sample = sample_robot(grammar, files.library, row.order, seed=seed)
            robot = split_colours(sample.robot)
            codes = sorted({finding.code for finding in sample.findings})
            row = replace(row, uri=f"{DERIVATION}{sample.derivation}", findings=tuple(codes))
            results.append(ReadRobot(_measured(row, robot), robot))
        except MorphgenError as error:
            results.append(ReadRobot(row, None, files.redact(error)))
    return results


def load_free_configurations(
    population: Population, workers: Workers
) -> tuple[Array, NDArray[np.bool_]]:
    """Find random configurations without self-collision in the workers.

    Returns:
        Configurations, shape (NUM_POSES, n, J), the home configuration where none was found; and
        which robots have one, shape (n,).
    """
    numbered = _chunks(list(enumerate(population.robots)))
    calls = [workers.submit(free_configurations, chunk) for chunk in numbered]
    q = np.repeat(population.home[None], NUM_POSES, axis=0)
    found = np.zeros(len(population), dtype=np.bool_)
    for i, free in enumerate(_gather(calls, workers, len(population))):
        if len(free):
            q[:, i, : free.shape[1]] = free[np.arange(NUM_POSES) % len(free)]
            found[i] = True
    return q, found


def free_configurations(robots: Sequence[tuple[int, Robot]]) -> list[Array]:
    """Return up to ``NUM_POSES`` free configurations of each robot, (k, dof). Runs in a worker.

    Those with every link above the ground come first, because the page shows a ground. A robot
    whose collision meshes cannot be read has none.
    """
    results = []
    for number, robot in robots:
        # The number of the robot is the seed, so that equal robots move differently.
        q = random_configurations(robot, _MAX_TRIES, np.random.default_rng(number))
        heights = forward_kinematics(robot, q)[..., 2, 3].min(axis=1)
        q = q[np.argsort(heights < -_GROUND_TOLERANCE, kind="stable")]
        free: list[Array] = []
        try:
            checker = SelfCollisionChecker(robot)
            for rows in np.split(q, range(2 * NUM_POSES, _MAX_TRIES, 2 * NUM_POSES)):
                free += list(rows[checker.free(rows)])
                if len(free) >= NUM_POSES:
                    break
        except MorphgenError:
            free = []
        results.append(np.array(free[:NUM_POSES]).reshape(min(len(free), NUM_POSES), robot.dof))
    return results


def load_map(population: Population, files: FileAccess, workers: Workers) -> Array:
    """Map the robots by the cosine of their tokens (see ``similarity``); shape (n, 2).

    Robots without tokens, such as those without a tool, are NaN.
    """
    max_links = default_max_links(len(robot.links) for robot in population.robots)
    calls = [
        workers.submit(token_rows, chunk, max_links, files) for chunk in _chunks(population.robots)
    ]
    tables = _gather(calls, workers, len(population))
    points = np.full((len(population), 2), np.nan)
    known = [i for i, table in enumerate(tables) if table is not None]
    if not known:
        return points
    width = max(len(table) for table in tables if table is not None)
    features = np.zeros((len(known), width))
    for row, i in zip(features, known, strict=True):
        table = tables[i]
        assert table is not None
        row[: len(table)] = table
    features /= np.linalg.norm(features, axis=1, keepdims=True)
    distances = np.maximum(1 - features @ features.T, 0.0)
    distances = (distances + distances.T) / 2
    np.fill_diagonal(distances, 0.0)
    points[known] = classical_mds(distances).points
    return points


def token_rows(robots: Sequence[Robot], max_links: int, files: FileAccess) -> list[Array | None]:
    """Return the tokens of robots as vectors, without joint positions. Runs in a worker.

    None for a robot that has no tokens.
    """
    results: list[Array | None] = []
    for robot in robots:
        try:
            source = with_library_meshes(robot, files.library)
            shapes = token_shapes(source, files.library_folders)
            results.append(compared_tokens(source, shapes, max_links=max_links).ravel())
        except MorphgenError:
            results.append(None)
    return results


def _measured(row: Row, robot: Robot) -> Row:
    """Return a row with the facts that it lacks."""
    facts: dict[str, object] = {}
    if row.dof is None:
        facts |= {"dof": robot.dof, "links": len(robot.links), "mass": robot.mass}
    if row.reach is None and has_tool(robot) and robot.dof:
        facts["reach"] = reach(robot)
    return replace(row, **facts)  # type: ignore[arg-type]


def _chunks(items: Sequence[T]) -> list[Sequence[T]]:
    return [items[i : i + _CHUNK] for i in range(0, len(items), _CHUNK)]


def _gather(calls: Sequence[Future[list[T]]], workers: Workers, total: int) -> list[T]:
    """Return the results of all calls in order."""
    results: list[T] = []
    for call in calls:
        chunk: list[T] = workers.result(call)
        results += chunk
        report(len(results), total)
    return results

"""A population in viser's scene: robots on one ground, arranged and moved together.

They are arrays, so that a few operations move all of them. Every visual shape is an instance of a
unit box, cylinder or sphere, or of a mesh; a capsule is three instances. Arrays over instances are
sorted by what they are instances of.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import trimesh
import viser
from numpy.typing import NDArray

from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import driving_joints, joint_limits
from morphgen.model.kinematics_torch import KinematicTree, compile_tree, quaternion_from_matrix
from morphgen.model.kinematics_torch import forward_kinematics as batch_forward_kinematics
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array
from morphgen.viewer.app.address import MAX_COMPARED
from morphgen.viewer.robot_rows import UNITS, Row, sort_rows
from morphgen.viewer.scene import stage

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
    number: NDArray[np.intp]  # number of each joint, see `numbered_joints`, shape (n, J); else 0
    home_bounds: Array  # lowest and highest corners at home, shape (n, 2, 3) [m]

    def __len__(self) -> int:
        return len(self.robots)


@dataclass(frozen=True, eq=False)
class ReadRobot:
    """A robot that a worker has read."""

    row: Row
    robot: Robot
    bounds: Array  # lowest and highest corner at home, shape (2, 3) [m]


def numbered_joints(robot: Robot) -> tuple[int, ...]:
    """Return the indices in q of joint 1, joint 2, ...: those that move the tool, or else all."""
    if robot.tool:
        return driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))
    return tuple(range(robot.dof))


def make_population(read: Sequence[ReadRobot]) -> Population:
    """Compile robots, at least one."""
    robots = tuple(each.robot for each in read)
    n, most = len(robots), max(robot.dof for robot in robots)
    lower, upper, home = np.zeros((3, n, most))
    number = np.zeros((n, most), dtype=np.intp)
    for i, robot in enumerate(robots):
        dof = robot.dof
        lower[i, :dof], upper[i, :dof] = joint_limits(robot).T
        home[i, :dof] = robot.home
        for k, joint in enumerate(numbered_joints(robot), 1):
            number[i, joint] = k
    return Population(
        tuple(each.row for each in read),
        robots,
        make_instances(robots),
        compile_tree(robots),
        lower,
        upper,
        np.clip(home, lower, upper),
        number,
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


def move_joints(population: Population, q: Array, shares: Mapping[int, float]) -> Array:
    """Return configurations (n, J) with joints of some numbers moved to shares of their ranges."""
    share = np.full(population.number.shape, np.nan)
    for number, value in shares.items():
        share[population.number == number] = value
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


ASPECT = 0.7  # width of an arrangement by its depth: seen from the front above, it fills a window
_MAX_LABELS = 16  # labels beside rows: more would cover each other
_WORD_GAP = 0.2  # gap between neighbours [median widths]
_LABEL_GAP = 0.3  # gap between labels and rows [m]
_QUANTILE = 0.8  # share of a row's robots that its depth holds; others cover those behind a little

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

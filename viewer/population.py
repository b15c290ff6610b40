"""Many robots as arrays, so that a few operations move all of them.

Every visual shape is an instance of a unit box, cylinder or sphere, or of a mesh; a capsule is
three instances. Arrays over instances are sorted by what they are instances of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Primitive, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import joint_limits
from morphgen.model.kinematics_torch import KinematicTree, compile_tree, forward_kinematics
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.comparison import all_roles, joint_roles
from morphgen.viewer.robot_rows import Row
from morphgen.viewer.scene_shapes import shape_colour

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
    """Compile robots, at least one.

    Raises:
        MeshError: If a mesh cannot be read.
    """
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
    """Collect the visual shapes of robots, or the collision shapes of links without any.

    Raises:
        MeshError: If a mesh cannot be read.
    """
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

    Args:
        population: The robots.
        q: Independent joint positions, shape (n, J) [rad or m].

    Returns:
        Shape (m, 4, 4).
    """
    index = torch.arange(len(population))
    positions = torch.from_numpy(np.ascontiguousarray(q, dtype=np.float32))
    T_root_link = forward_kinematics(population.tree, index, positions).numpy()
    instances = population.instances
    return np.asarray(T_root_link[instances.robot, instances.link] @ instances.T_link_shape)


def instance_centres(instances: Instances, poses: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the centres of the bounding boxes of instances at poses (m, 4, 4), (m, 3) [m]."""
    turned = (poses[:, :3, :3] @ instances.centre[..., None])[..., 0]
    return np.asarray(turned + poses[:, :3, 3])


def robot_bounds(population: Population, T_root_shape: NDArray[np.float32]) -> Array:
    """Return the bounding boxes of robots in their root frames; the root's origin counts too.

    Args:
        population: The robots.
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

    Args:
        population: The robots.
        q: Independent joint positions, shape (n, J) [rad or m].
        shares: Position within the joint's range, 0 (lower limit) to 1 (upper), by role.

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

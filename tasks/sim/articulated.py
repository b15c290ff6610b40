"""Articulated bodies of scenes: robots as simulators need them, and objects.

Of robots, rigid links are merged and constant ground contacts known. An object has a joint without
a motor between a base and a link that moves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from morphgen.checks.self_collision import untested_pairs
from morphgen.errors import SimulationError
from morphgen.model.geometry import IDENTITY, Mesh, Pose, Shape
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import TOOL, Inertial, Joint, Link, Robot, sorted_pair
from morphgen.model.rotation import Vec3, rotate
from morphgen.model.tree import RigidGroup, rename, rigid_groups, take_name
from morphgen.typing import Array

_SHORTEST_LEVER = 1e-3  # least distance of a contact point from the axis of a hinge [m]


@dataclass(frozen=True)
class ArticulatedObject:
    """An object that stands in a scene, and of which one link moves: a drawer, a door, a dial.

    Its state is a pose, as that of a block: the position of its contact point, and the rotation of
    the link that moves.
    """

    body: Robot
    """The object, with one movable joint, which has no motor, and primitive collision shapes."""
    pose: Pose = IDENTITY
    """Pose of the root link in the world."""
    friction: float = 1.0
    """Friction coefficient of its surfaces."""

    def __post_init__(self) -> None:
        """Require one joint, a link with mass beyond it, and primitive shapes.

        Raises:
            SimulationError: If the robot is not such an object.
        """
        if len(self.body.movable_joints) != 1:
            raise SimulationError(
                f"object {self.body.name!r} has {len(self.body.movable_joints)} movable joints; "
                "expected one"
            )
        if self.moving_inertial is None:
            raise SimulationError(f"object {self.body.name!r}: the link that moves has no mass")
        if self._contact_link not in {link.name for link in rigid_groups(self.body)[1].links}:
            raise SimulationError(
                f"object {self.body.name!r}: the link {self._contact_link!r} of its frame "
                f"{TOOL!r} does not move"
            )
        for shape in (*self.base_shapes, *self.moving_shapes):
            if isinstance(shape.geometry, Mesh):
                raise SimulationError(
                    f"object {self.body.name!r} has a mesh for collisions; expected primitives"
                )

    @cached_property
    def joint(self) -> Joint:
        """The joint that moves; its frame at zero is in the root frame."""
        k = self.body.movable_joints[0]
        joint = self.body.joints[k]
        T_root_parent = self._poses[self.body.link_index[joint.parent]]
        return replace(joint, T_parent_joint=T_root_parent @ joint.T_parent_joint)

    @cached_property
    def placed_joint(self) -> ObjectJoints:
        """The joint where the object stands in the world."""
        return ObjectJoints([self])

    @cached_property
    def base_shapes(self) -> tuple[Shape, ...]:
        """Collision shapes that stand still, in the root frame."""
        return self._shapes(rigid_groups(self.body)[0], IDENTITY)

    @cached_property
    def moving_shapes(self) -> tuple[Shape, ...]:
        """Collision shapes that move, in the frame of the link below the joint."""
        return self._shapes(rigid_groups(self.body)[1], self.joint.T_parent_joint)

    @cached_property
    def contact(self) -> Vec3:
        """Point where tools push, in the frame below the joint: the frame ``tool``, or its origin.

        The position of the object's state is that of this point.
        """
        tool = self.body.tool
        if tool is None:
            return (0.0, 0.0, 0.0)
        T_root_link = self._poses[self.body.link_index[tool.link]]
        T_joint_root = self.joint.T_parent_joint.inverse()
        return (T_joint_root @ T_root_link @ tool.T_link_frame).position

    @cached_property
    def contact_shapes(self) -> tuple[Shape, ...]:
        """Collision shapes that move, in the frame of the state: from the contact point."""
        T_contact_joint = Pose(self.contact).inverse()
        return tuple(
            replace(shape, T_link_shape=T_contact_joint @ shape.T_link_shape)
            for shape in self.moving_shapes
        )

    @cached_property
    def contact_box(self) -> tuple[Vec3, Vec3]:
        """Edges and centre of a box around the shape at the contact point, in that frame."""
        boxes = [bounding_box((shape,)) for shape in self.contact_shapes]
        outside = [float(np.maximum(np.maximum(low, -high), 0).sum()) for low, high in boxes]
        low, high = boxes[int(np.argmin(outside))]
        return tuple((high - low).tolist()), tuple(((high + low) / 2).tolist())

    @cached_property
    def direction(self) -> Vec3:
        """Unit vector in which the contact point moves as the joint does, in the state's frame."""
        x, y, z = self._contact_motion
        return (x / self.lever, y / self.lever, z / self.lever)

    @cached_property
    def lever(self) -> float:
        """Motion of the contact point per motion of the joint: 1 for slides, m/rad for hinges.

        Raises:
            SimulationError: If the contact point is on the axis.
        """
        lever = math.hypot(*self._contact_motion)
        if lever < _SHORTEST_LEVER:
            raise SimulationError(f"object {self.body.name!r}: its frame {TOOL!r} is on the axis")
        return lever

    def behind(self, sign: Array, distance: Array | float) -> Array:
        """Return points from where tools push, in the state's frame, shape (n, 3) [m].

        They are at a distance (n,) [m] behind the surface at the contact point, along the path of
        this point: against the motion of the joint, to positive positions if the sign (n,) is 1.
        """
        length = sign * (self.extent(sign) + distance)
        if self.joint.kind == "prismatic":
            return np.asarray(-length[:, None] * np.array(self.direction))
        half = -length[:, None] / self.lever / 2
        turn = np.concatenate([np.cos(half), np.sin(half) * np.array(self.joint.unit_axis)], axis=1)
        contact = np.array([self.contact])
        return np.asarray(rotated(turn, contact) - contact)

    def extent(self, sign: Array) -> Array:
        """Return the distance from the contact point to the surface where tools push, (n,) [m]."""
        size, centre = np.array(self.contact_box)
        return np.asarray(size / 2 @ np.abs(self.direction) - sign * (centre @ self.direction))

    @cached_property
    def _contact_motion(self) -> Vec3:
        axis = self.joint.unit_axis
        moved = axis if self.joint.kind == "prismatic" else np.cross(axis, self.contact).tolist()
        return (moved[0], moved[1], moved[2])

    @property
    def _contact_link(self) -> str:
        """Link of the contact point."""
        return self.body.tool.link if self.body.tool else self.joint.child

    @cached_property
    def moving_inertial(self) -> Inertial | None:
        """Mass and inertia of the links that move, in that frame."""
        T_child_root = self.joint.T_parent_joint.inverse()
        return merged_inertial(
            [
                (T_child_root @ self._poses[self.body.link_index[link.name]], link)
                for link in rigid_groups(self.body)[1].links
            ]
        )

    @cached_property
    def _poses(self) -> tuple[Pose, ...]:
        """Pose of every link in the root frame with the joint at zero."""
        matrices = forward_kinematics(self.body, np.zeros(self.body.dof))
        return tuple(Pose.from_matrix(matrix) for matrix in matrices)

    def _shapes(self, group: RigidGroup, T_root_frame: Pose) -> tuple[Shape, ...]:
        T_frame_root = T_root_frame.inverse()
        return tuple(
            replace(
                shape,
                T_link_shape=T_frame_root
                @ self._poses[self.body.link_index[link.name]]
                @ shape.T_link_shape,
            )
            for link in group.links
            for shape in link.collisions
        )


class ObjectJoints:
    """Joints of k articulated objects: their states from positions of the joints, and back."""

    def __init__(self, objects: Sequence[ArticulatedObject]) -> None:
        """Gather the joints' frames at zero in the world.

        Attributes:
            frame: Their poses, shape (k, 7); those of slides are at the contact points.
            offset: Contact points in frames of hinges, shape (k, 3); zeros for slides.
            direction: Their axes in the world, shape (k, 3).
            axis: Their axes in their own frames, shape (k, 3).
            is_slide: Whether each is prismatic, shape (k,), bool.
        """
        self.is_slide = np.array([each.joint.kind == "prismatic" for each in objects])
        contact = np.array([each.contact for each in objects])
        self.offset = np.where(self.is_slide[:, None], 0.0, contact)
        frames = [
            each.pose
            @ each.joint.T_parent_joint
            @ Pose(each.contact if is_slide else IDENTITY.position)
            for each, is_slide in zip(objects, self.is_slide, strict=True)
        ]
        axes = [each.joint.unit_axis for each in objects]
        self.frame = np.array([(*pose.position, *pose.quaternion) for pose in frames])
        self.axis = np.array(axes)
        self.direction = np.array(
            [rotate(pose.quaternion, axis) for pose, axis in zip(frames, axes, strict=True)]
        )

    def poses(self, q: Array) -> Array:
        """Return the states (k, 7) of the objects at joint positions (k,) [rad or m]."""
        slide = np.where(self.is_slide, q, 0.0)[:, None]
        half = np.where(self.is_slide, 0.0, q)[:, None] / 2
        turn = np.concatenate([np.cos(half), np.sin(half) * self.axis], axis=1)
        quaternion = _product(self.frame[:, 3:], turn)
        quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
        contact = self.frame[:, :3] + slide * self.direction + rotated(quaternion, self.offset)
        return np.concatenate([contact, quaternion], axis=1)

    def positions(self, poses: Array) -> Array:
        """Return the joint positions (k,) of objects in states (k, 7); angles are within a turn."""
        along = ((poses[:, :3] - self.frame[:, :3]) * self.direction).sum(axis=1)
        turn = _product(self.frame[:, 3:] * (1.0, -1.0, -1.0, -1.0), poses[:, 3:])
        angle = 2 * np.arctan2((turn[:, 1:] * self.axis).sum(axis=1), turn[:, 0])
        angle = (angle + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(np.where(self.is_slide, along, angle))


def rotated(quaternions: Array, vectors: Array) -> Array:
    """Return vectors (k, 3) turned by quaternions (k, 4)."""
    w, xyz = quaternions[:, :1], quaternions[:, 1:]
    twice = 2 * np.cross(xyz, vectors)
    return np.asarray(vectors + w * twice + np.cross(xyz, twice))


def _product(a: Array, b: Array) -> Array:
    """Return the products of quaternions, (k, 4) each."""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(axis=1, keepdims=True)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w, xyz], axis=1)


_Piece = tuple[Pose, Link]  # pose of a link in the link that it is merged into, and the link
_UPRIGHT = 1e-6
"""Tolerance of the vertical component of an axis that is horizontal (0) or vertical (1)."""


def merge_rigid_links(robot: Robot) -> Robot:
    """Merge links that fixed joints connect, since simulators take time for every link.

    Motion and contacts stay the same. Joints keep their names, order and home; a merged link has
    the name of its first link, but a root named ``world`` is renamed. Visual shapes and frames are
    dropped. Links with collision shapes are merged only if they ignore the same other links;
    otherwise the fixed joint stays. ``ignore_pairs`` then also contain the pairs that no simulator
    should test: links of one rigid part, and neighbours across a movable joint.
    """
    ignored = {
        (a, b)
        for a, b in untested_pairs(robot)
        if robot.link(a).collisions and robot.link(b).collisions
    }
    part = {link.name: i for i, group in enumerate(rigid_groups(robot)) for link in group.links}
    partners: dict[str, set[str]] = {link.name: set() for link in robot.links}
    for a, b in ignored:
        if part[a] != part[b]:
            partners[a].add(b)
            partners[b].add(a)

    merged_name = {robot.root.name: robot.root.name}
    pieces: dict[str, list[_Piece]] = {robot.root.name: [(IDENTITY, robot.root)]}
    T_merged_link = {robot.root.name: IDENTITY}
    joints = []
    for joint, link in zip(robot.joints, robot.links[1:], strict=True):
        parent = merged_name[joint.parent]
        T_merged_joint = T_merged_link[joint.parent] @ joint.T_parent_joint
        colliding = [piece.name for _, piece in pieces[parent] if piece.collisions]
        # A merged link has one set of ignored pairs, so all of its shapes must have the same.
        same_partners = not link.collisions or all(
            partners[link.name] == partners[name] for name in colliding
        )
        if not joint.is_movable and same_partners:
            merged_name[link.name], T_merged_link[link.name] = parent, T_merged_joint
            pieces[parent].append((T_merged_joint, link))
        else:
            merged_name[link.name], T_merged_link[link.name] = link.name, IDENTITY
            pieces[link.name] = [(IDENTITY, link)]
            joints.append(replace(joint, parent=parent, T_parent_joint=T_merged_joint))
    pairs = {
        sorted_pair(merged_name[a], merged_name[b])
        for a, b in ignored
        if merged_name[a] != merged_name[b]
    }
    links = tuple(
        Link(
            name,
            merged_inertial(parts),
            collisions=tuple(
                replace(shape, T_link_shape=T @ shape.T_link_shape)
                for T, link in parts
                for shape in link.collisions
            ),
        )
        for name, parts in pieces.items()
    )
    merged = Robot(
        robot.name, links, tuple(joints), home=robot.home, ignore_pairs=tuple(sorted(pairs))
    )
    # MuJoCo reserves this name: an MJCF cannot give the link the mass of those welded to it.
    names = {"world": take_name("world", {*merged.link_index})}
    return rename(merged, names) if merged.root.name == "world" else merged


def merged_inertial(pieces: list[_Piece]) -> Inertial | None:
    """Add masses, and inertias about the common centre of mass (parallel axis theorem)."""
    massive = [
        (T.matrix, link.inertial)
        for T, link in pieces
        if link.inertial is not None and link.inertial.mass > 0
    ]
    if not massive:
        return None
    if len(pieces) == 1:
        return massive[0][1]
    masses = np.array([inertial.mass for _, inertial in massive])
    centres = np.array([T[:3, :3] @ np.array(i.com) + T[:3, 3] for T, i in massive])
    mass = masses.sum()
    com = masses @ centres / mass
    matrix = np.zeros((3, 3))
    for (T, inertial), centre in zip(massive, centres, strict=True):
        d = centre - com
        matrix += T[:3, :3] @ inertial.matrix @ T[:3, :3].T
        matrix += inertial.mass * (d @ d * np.eye(3) - np.outer(d, d))  # Steiner
    x, y, z = com.tolist()
    return Inertial.from_matrix(float(mass), (x, y, z), matrix)


def ground_contact_links(robot: Robot, T_world_root: Pose) -> frozenset[str]:
    """Return the links that no joint raises, lowers or tilts: their ground contact is constant.

    These are the root, and links that only turn about vertical axes and slide along horizontal
    ones. No force can end such a contact, and simulators handle it badly, so neither tests these
    links against the ground. PyBullet creates one within 2 cm already, and light joints further
    along the arm are then tenths of a radian off, for any number of iterations. MuJoCo (4.0) takes
    an upright cylinder whose axis is a few last bits longer than 1 to be a radius deep in the
    plane.
    """
    T_world_link = T_world_root.matrix @ forward_kinematics(robot, np.array(robot.home))
    level = {robot.root.name}
    for k, joint in enumerate(robot.joints):
        if joint.is_movable:
            vertical = abs(float(T_world_link[k + 1, 2, :3] @ np.array(joint.unit_axis)))
            is_slide = joint.kind == "prismatic"
            stays_level = vertical < _UPRIGHT if is_slide else vertical > 1 - _UPRIGHT
        else:
            stays_level = True
        if stays_level and joint.parent in level:
            level.add(joint.child)
    return frozenset(level)

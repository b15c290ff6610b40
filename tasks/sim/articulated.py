"""Articulated objects of scenes: a joint without a motor between a base and a link that moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from morphgen.errors import SimulationError
from morphgen.model.geometry import IDENTITY, Mesh, Pose, Shape
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Inertial, Joint, Robot
from morphgen.model.rotation import rotate
from morphgen.model.tree import RigidGroup, rigid_groups
from morphgen.tasks.sim.rigid_bodies import merged_inertial
from morphgen.typing import Array


@dataclass(frozen=True)
class ArticulatedObject:
    """An object that stands in a scene, and of which one link moves: a drawer, a door, a dial.

    Its state is the pose of the link that moves, as the state of a block is the pose of the block.
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
    """Joints of k articulated objects: poses of their links that move, from positions and back."""

    def __init__(self, objects: Sequence[ArticulatedObject]) -> None:
        """Gather the joints' frames at zero in the world.

        Attributes:
            frame: Their poses, shape (k, 7).
            direction: Their axes in the world, shape (k, 3).
            axis: Their axes in their own frames, shape (k, 3).
            is_slide: Whether each is prismatic, shape (k,), bool.
        """
        frames = [each.pose @ each.joint.T_parent_joint for each in objects]
        axes = [each.joint.unit_axis for each in objects]
        self.frame = np.array([(*pose.position, *pose.quaternion) for pose in frames])
        self.axis = np.array(axes)
        self.direction = np.array(
            [rotate(pose.quaternion, axis) for pose, axis in zip(frames, axes, strict=True)]
        )
        self.is_slide = np.array([each.joint.kind == "prismatic" for each in objects])

    def poses(self, q: Array) -> Array:
        """Return the poses (k, 7) of the links that move at joint positions (k,) [rad or m]."""
        slide = np.where(self.is_slide, q, 0.0)[:, None]
        half = np.where(self.is_slide, 0.0, q)[:, None] / 2
        turn = np.concatenate([np.cos(half), np.sin(half) * self.axis], axis=1)
        quaternion = _product(self.frame[:, 3:], turn)
        quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
        return np.concatenate([self.frame[:, :3] + slide * self.direction, quaternion], axis=1)

    def positions(self, poses: Array) -> Array:
        """Return the joint positions (k,) of links at poses (k, 7); angles are within a turn."""
        along = ((poses[:, :3] - self.frame[:, :3]) * self.direction).sum(axis=1)
        turn = _product(self.frame[:, 3:] * (1.0, -1.0, -1.0, -1.0), poses[:, 3:])
        angle = 2 * np.arctan2((turn[:, 1:] * self.axis).sum(axis=1), turn[:, 0])
        angle = (angle + np.pi) % (2 * np.pi) - np.pi
        return np.asarray(np.where(self.is_slide, along, angle))


def _product(a: Array, b: Array) -> Array:
    """Return the products of quaternions, (k, 4) each."""
    w = a[:, :1] * b[:, :1] - (a[:, 1:] * b[:, 1:]).sum(axis=1, keepdims=True)
    xyz = a[:, :1] * b[:, 1:] + b[:, :1] * a[:, 1:] + np.cross(a[:, 1:], b[:, 1:])
    return np.concatenate([w, xyz], axis=1)

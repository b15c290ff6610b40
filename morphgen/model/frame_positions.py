"""Positions of a robot's frame without its orientation, many times as fast as its pose.

Instead of multiplying poses, points are transformed from the frame to the root, joint by joint. The
axis of each joint is aligned with z first, so that a rotation changes x and y only.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.model import rotation
from morphgen.model.geometry import Pose
from morphgen.model.robot import TOOL, Joint, Robot
from morphgen.model.rotation import Vec3
from morphgen.typing import Array


@dataclass(frozen=True, eq=False)
class _AlignedJoint:
    """A movable joint between the root and a frame, its axis along z."""

    T_joint_next: Pose
    """Pose of the next joint, or of the frame, in the frame of this joint after its motion."""
    leader: int
    """Independent joint that it follows."""
    gain: float
    offset: float
    """Its position is gain x + offset where the leader's is x [rad or m]."""
    slides: bool
    """Whether the joint is prismatic."""


def _aligned_joints(robot: Robot, frame: str) -> tuple[list[_AlignedJoint], Pose]:
    """Return the joints from a frame to the root, and the pose of the last one in the root."""
    gains, offsets = robot.mimic_map
    row = {k: i for i, k in enumerate(robot.movable_joints)}
    target, joints = robot.frame(frame), []
    T_joint_next = target.T_link_frame
    for k in reversed(robot.joint_chain(target.link)):
        joint = robot.joints[k]
        if joint.is_movable and not gains[row[k]].any():  # it follows a fixed joint, and stays
            T_joint_next = _displacement(joint, float(offsets[row[k]])) @ T_joint_next
        elif joint.is_movable:
            leader = int(np.abs(gains[row[k]]).argmax())
            gain, offset = float(gains[row[k], leader]), float(offsets[row[k]])
            T_joint_axis = Pose(quaternion=rotation.from_z(joint.unit_axis))
            T_axis_next = T_joint_axis.inverse() @ T_joint_next
            slides = joint.kind == "prismatic"
            joints.append(_AlignedJoint(T_axis_next, leader, gain, offset, slides))
            T_joint_next = T_joint_axis
        T_joint_next = joint.T_parent_joint @ T_joint_next
    return joints, T_joint_next


def _displacement(joint: Joint, position: float) -> Pose:
    x, y, z = joint.unit_axis
    if joint.kind == "prismatic":
        return Pose((position * x, position * y, position * z))
    s = math.sin(position / 2)
    return Pose(quaternion=rotation.normalize((math.cos(position / 2), s * x, s * y, s * z)))


def frame_positions(robot: Robot, q: Array, frame: str = TOOL) -> Array:
    """Return positions of a named frame in the root frame.

    Args:
        robot: The robot.
        q: Independent joint positions, a row per joint, shape (dof, n).
        frame: Name of the frame.

    Returns:
        Positions, shape (3, n) [m].

    Raises:
        RobotError: If the frame is unknown.
    """
    points = np.zeros((3, q.shape[1]))
    joints, T_root_next = _aligned_joints(robot, frame)
    for joint in joints:
        points = _transform(joint.T_joint_next, points)
        position = joint.offset + joint.gain * q[joint.leader]
        if joint.slides:
            points[2] += position
        else:
            c, s, (x, y) = np.cos(position), np.sin(position), points[:2]
            points[0], points[1] = c * x - s * y, s * x + c * y
    return _transform(T_root_next, points)


class FramePosition:
    """Position of a named frame at one configuration after the other.

    It computes in plain numbers: on so few of them, a call of NumPy takes longer than what it does.
    """

    def __init__(self, robot: Robot, frame: str = TOOL) -> None:
        """Compile the joints.

        Raises:
            RobotError: If the frame is unknown.
        """
        joints, T_root_next = _aligned_joints(robot, frame)
        self._joints = [
            (joint.leader, joint.gain, joint.offset, joint.slides, _rows(joint.T_joint_next))
            for joint in joints
        ]
        self._root = _rows(T_root_next)

    def __call__(self, q: Sequence[float]) -> Vec3:
        """Return the position in the root frame [m] at independent joint positions."""
        x = y = z = 0.0
        for leader, gain, offset, slides, rows in self._joints:
            xx, xy, xz, tx, yx, yy, yz, ty, zx, zy, zz, tz = rows
            x, y, z = (
                xx * x + xy * y + xz * z + tx,
                yx * x + yy * y + yz * z + ty,
                zx * x + zy * y + zz * z + tz,
            )
            position = gain * q[leader] + offset
            if slides:
                z += position
            else:
                c, s = math.cos(position), math.sin(position)
                x, y = c * x - s * y, s * x + c * y
        xx, xy, xz, tx, yx, yy, yz, ty, zx, zy, zz, tz = self._root
        return (
            xx * x + xy * y + xz * z + tx,
            yx * x + yy * y + yz * z + ty,
            zx * x + zy * y + zz * z + tz,
        )


def _rows(T: Pose) -> tuple[float, ...]:
    """Return the first three rows of a homogeneous matrix, 12 numbers."""
    return tuple(T.matrix[:3].ravel().tolist())


def _transform(T: Pose, points: Array) -> Array:
    # einsum, because starting the threads of a matrix product costs more than it saves
    return np.asarray(np.einsum("ij,jn->in", T.matrix[:3, :3], points) + T.matrix[:3, 3:])

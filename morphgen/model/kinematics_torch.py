"""Kinematics of many robots in one batch of torch tensors, differentiable, on any device.

The functions have the names and results of ``morphgen.model.kinematics``. Robots are compiled once:
``compile_tree`` for the poses of all links, ``compile_chain`` for the pose and the Jacobian of one
frame, which is several times as fast because only joints between the root and the frame count.
Loops go over levels of the tree, never over environments.

``robot_index``, shape (n,), int64, says which of the compiled robots each row of a batch is; ``q``,
shape (n, J), holds independent joint positions [rad or m], where J is the largest number of
independent joints; entries beyond a robot's own joints are ignored.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.robot import TOOL, Robot
from morphgen.model.rotation_torch import skew
from morphgen.typing import Array

Device = torch.device | str


@dataclass(frozen=True, eq=False)
class JointTensors:
    """R rows of K joints, padded with joints that are fixed at the identity."""

    T_parent_joint: torch.Tensor
    """Pose of each joint at position zero in the frame before it, shape (R, K, 4, 4)."""
    axis: torch.Tensor
    """Unit axis in the joint frame, shape (R, K, 3)."""
    is_prismatic: torch.Tensor
    """Whether the joint slides, shape (R, K), bool."""
    gain: torch.Tensor
    """Joint positions are ``gain @ q + offset``, mimic joints included, shape (R, K, J)."""
    offset: torch.Tensor
    """Joint positions at q = 0 [rad or m], shape (R, K)."""

    @cached_property
    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Two matrices that a joint's motion adds to ``T_parent_joint``, each (R, K, 4, 4).

        By Rodrigues' formula, R = I + sin(a) K + (1 - cos(a)) K^2 with the cross-product matrix K
        of the axis: the first is multiplied by the sine of a revolute joint's position, or by the
        position of a prismatic one, and the second by one minus the cosine.
        """
        cross = skew(self.axis)
        turns = ~self.is_prismatic[..., None, None]
        first, second = (torch.zeros_like(self.T_parent_joint) for _ in range(2))
        first[..., :3, :3] = cross * turns
        first[..., :3, 3] = self.axis * self.is_prismatic[..., None]
        second[..., :3, :3] = cross @ cross * turns
        return self.T_parent_joint @ first, self.T_parent_joint @ second

    def transforms(self, robot_index: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return each joint's frame after its motion in the frame before it, (n, K, 4, 4)."""
        positions = (self.gain[robot_index] @ q[:, :, None])[:, :, 0] + self.offset[robot_index]
        slides = self.is_prismatic[robot_index]
        first = torch.where(slides, positions, torch.sin(positions))[..., None, None]
        second = torch.where(slides, torch.zeros_like(positions), 1 - torch.cos(positions))
        by_first, by_second = self.motion
        moved = first * by_first[robot_index] + second[..., None, None] * by_second[robot_index]
        return self.T_parent_joint[robot_index] + moved


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """All links of R robots, padded to L links and J independent joints."""

    joints: JointTensors
    """The joint that attaches each link to its parent; the root's is fixed; K = L."""
    is_link: torch.Tensor
    """Which links exist, shape (R, L), bool."""
    is_movable: torch.Tensor
    """Which links a joint moves, mimic joints included, shape (R, L), bool."""
    levels: tuple[tuple[torch.Tensor, torch.Tensor], ...]
    """For each depth from 1 on, the links of that depth and the columns of their parents among the
    links of the depth before, both (R, W), int64; padding is 0."""
    column: torch.Tensor
    """Where each link is in the concatenation of all levels, the root's first, shape (R, L)."""


@dataclass(frozen=True, eq=False)
class FrameChain:
    """The joints between the root and one frame of R robots, fixed joints folded into the next.

    Chains are padded at their root end to D joints.
    """

    joints: JointTensors
    """The joints in order; K = D."""
    T_joint_tool: torch.Tensor
    """Pose of the frame in the frame of the last joint, shape (R, 4, 4)."""


def compile_tree(
    robots: Sequence[Robot],
    *,
    max_links: int | None = None,
    dtype: torch.dtype = torch.float32,
    device: Device = "cpu",
) -> KinematicTree:
    """Compile robots for ``forward_kinematics``.

    Args:
        robots: At least one robot.
        max_links: L; by default that of the robot with the most links.
        dtype: Of the floating-point tensors.
        device: Of all tensors.

    Raises:
        ValueError: If a robot has more than ``max_links`` links.
    """
    most = max(len(robot.links) for robot in robots)
    if max_links is not None and max_links < most:
        raise ValueError(f"max_links is {max_links}; expected at least {most}")
    links = max_links or most
    depths = [_depths(robot) for robot in robots]
    at_level = [[np.flatnonzero(own == d) for d in range(max(own) + 1)] for own in depths]
    height = max(len(own) for own in at_level)
    levels, column, start = [], np.zeros((len(robots), links), dtype=np.int64), 1
    place = np.zeros_like(column)  # of each link within its level
    for d in range(1, height):
        width = max(len(own[d]) for own in at_level if len(own) > d)
        link, parent = np.zeros((2, len(robots), width), dtype=np.int64)
        for r, (robot, own) in enumerate(zip(robots, at_level, strict=True)):
            for w, i in enumerate(own[d] if len(own) > d else ()):
                link[r, w], parent[r, w] = i, place[r, robot.parents[i]]
                place[r, i], column[r, i] = w, start + w
        levels.append((torch.from_numpy(link).to(device), torch.from_numpy(parent).to(device)))
        start += width
    movable = np.zeros((len(robots), links), dtype=np.bool_)
    for row, robot in zip(movable, robots, strict=True):
        row[[k + 1 for k in robot.movable_joints]] = True
    counts = np.array([len(robot.links) for robot in robots])
    rows = [
        [(None, np.eye(4)), *((k, joint.T_parent_joint.matrix) for k, joint in joints)]
        for joints in (enumerate(robot.joints) for robot in robots)
    ]
    return KinematicTree(
        joints=_joint_tensors(robots, rows, links, dtype, device, pad_front=False),
        is_link=torch.from_numpy(np.arange(links) < counts[:, None]).to(device),
        is_movable=torch.from_numpy(movable).to(device),
        levels=tuple(levels),
        column=torch.from_numpy(column).to(device),
    )


def compile_chain(
    robots: Sequence[Robot],
    frame: str = TOOL,
    *,
    dtype: torch.dtype = torch.float32,
    device: Device = "cpu",
) -> FrameChain:
    """Compile robots for ``frame_jacobian``, ``frame_pose`` and ``FramePositions``.

    Args:
        robots: At least one robot; each has the frame.
        frame: Name of the frame.
        dtype: Of the floating-point tensors.
        device: Of all tensors.

    Raises:
        RobotError: If a robot has no such frame.
    """
    rows, ends = [], []
    for robot in robots:
        named = robot.frame(frame)
        T, row = np.eye(4), []
        for k in robot.joint_chain(named.link):
            T = T @ robot.joints[k].T_parent_joint.matrix
            if robot.joints[k].is_movable:
                row.append((k, T))
                T = np.eye(4)
        rows.append(row)
        ends.append(T @ named.T_link_frame.matrix)
    depth = max(1, *map(len, rows))
    joints = _joint_tensors(robots, rows, depth, dtype, device, pad_front=True)
    return FrameChain(joints, torch.from_numpy(np.array(ends)).to(device, dtype))


def forward_kinematics(
    tree: KinematicTree, robot_index: torch.Tensor, q: torch.Tensor
) -> torch.Tensor:
    """Return the pose of every link in its robot's root frame.

    Args:
        tree: Compiled robots.
        robot_index: Which robot each row is, shape (n,), int64.
        q: Independent joint positions, shape (n, J), rad or m.

    Returns:
        ``T_root_link``, shape (n, L, 4, 4); the identity for padding.
    """
    T_parent_link = tree.joints.transforms(robot_index, q)
    level = torch.eye(4, dtype=q.dtype, device=q.device).expand(len(q), 1, 4, 4)
    poses = [level]
    for link, parent in tree.levels:
        level = _taken(level, parent[robot_index]) @ _taken(T_parent_link, link[robot_index])
        poses.append(level)
    return _taken(torch.cat(poses, dim=1), tree.column[robot_index])


def joint_axes(
    tree: KinematicTree, robot_index: torch.Tensor, T_root_link: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return an anchor and the axis of the joint that moves each link, in the root frame.

    Args:
        tree: Compiled robots.
        robot_index: Which robot each row is, shape (n,), int64.
        T_root_link: Poses of all links, shape (n, L, 4, 4).

    Returns:
        Anchors [m] and unit axes, both (n, L, 3); zeros where no joint moves the link.
    """
    moves = tree.is_movable[robot_index][..., None]
    axes = (T_root_link[..., :3, :3] @ tree.joints.axis[robot_index][..., None])[..., 0]
    return T_root_link[..., :3, 3] * moves, axes * moves


def frame_pose(chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return ``T_root_tool``, shape (n, 4, 4); arguments as for ``frame_jacobian``."""
    return _chain_frames(chain, robot_index, q)[-1]


def frame_jacobian(
    chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose and the geometric Jacobian of the chain's frame in the root frame.

    Siciliano et al., Robotics: Modelling, Planning and Control, 2009, section 3.1.3: a revolute
    joint with axis z and anchor p contributes (z x (p_tool - p), z), a prismatic one (z, 0).

    Args:
        chain: Compiled robots.
        robot_index: Which robot each row is, shape (n,), int64.
        q: Independent joint positions, shape (n, J), rad or m.

    Returns:
        ``T_root_tool``, shape (n, 4, 4), and ``J_root_tool``, shape (n, 6, J): linear velocity of
        the frame's origin, then angular velocity; mimic joints are folded into their leaders, and
        columns of joints that do not move the frame are zero.
    """
    *joints, T_root_tool = _chain_frames(chain, robot_index, q)
    T_root_joint = torch.stack(joints, dim=1)
    axis = (T_root_joint[..., :3, :3] @ chain.joints.axis[robot_index][..., None])[..., 0]
    arm = T_root_tool[:, None, :3, 3] - T_root_joint[..., :3, 3]
    slides = chain.joints.is_prismatic[robot_index][..., None]
    linear = torch.where(slides, axis, torch.linalg.cross(axis, arm))
    angular = torch.where(slides, torch.zeros_like(axis), axis)
    columns = torch.cat([linear, angular], dim=2).transpose(1, 2)
    return T_root_tool, columns @ chain.joints.gain[robot_index]


class FramePositions:
    """Positions of the frames of a fixed batch, several times as fast as ``frame_pose``.

    A point is carried from the frame to the root, joint by joint, instead of multiplying poses.
    """

    def __init__(self, chain: FrameChain, robot_index: torch.Tensor) -> None:
        """Prepare; arguments as for ``frame_jacobian``."""
        joints = chain.joints
        parts = torch.stack([joints.T_parent_joint, *joints.motion])[:, robot_index, :, :3]
        self._still, self._by_first, self._by_second = parts.permute(0, 2, 3, 4, 1).contiguous()
        # Joint frames at zero, and what motion adds to them; each (D, 3, 4, n).
        self._tool = chain.T_joint_tool[robot_index, :3, 3].T.contiguous()
        gain = joints.gain[robot_index].transpose(0, 1)
        self._leader = gain.abs().argmax(dim=2)
        self._gain = torch.gather(gain, 2, self._leader[..., None])[..., 0].contiguous()
        self._offset = joints.offset[robot_index].T.contiguous()
        self._slides = joints.is_prismatic[robot_index].T.contiguous()

    def __call__(self, q: torch.Tensor) -> torch.Tensor:
        """Return positions in the root frames, shape (n, 3), metres, at q, shape (n, J)."""
        moved = self._gain * torch.gather(q.T, 0, self._leader) + self._offset
        first = torch.where(self._slides, moved, torch.sin(moved))[:, None, None]
        second = torch.where(self._slides, 0.0, 1 - torch.cos(moved))[:, None, None]
        frames = self._still + first * self._by_first + second * self._by_second
        turns, shifts = frames[:, :, :3].unbind(), frames[:, :, 3].unbind()
        point = self._tool
        for turn, shift in zip(reversed(turns), reversed(shifts), strict=True):
            point = (turn * point).sum(dim=1) + shift
        return point.T


def frame_positions(chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return the frames' positions in their root frames, shape (n, 3), metres."""
    return FramePositions(chain, robot_index)(q)


def _chain_frames(
    chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor
) -> list[torch.Tensor]:
    """Return T_root_joint after each joint's motion, then T_root_tool; D + 1 of (n, 4, 4)."""
    steps = chain.joints.transforms(robot_index, q)
    frames = [steps[:, 0]]
    for d in range(1, steps.shape[1]):
        frames.append(frames[-1] @ steps[:, d])
    return [*frames, frames[-1] @ chain.T_joint_tool[robot_index]]


def _joint_tensors(
    robots: Sequence[Robot],
    rows: Sequence[Sequence[tuple[int | None, Array]]],
    length: int,
    dtype: torch.dtype,
    device: Device,
    *,
    pad_front: bool,
) -> JointTensors:
    """Stack joints, each an index into ``robot.joints`` (None: fixed) and its T_parent_joint."""
    size = len(robots), length
    T = np.tile(np.eye(4), (*size, 1, 1))
    axis, slides = np.tile((0.0, 0.0, 1.0), (*size, 1)), np.zeros(size, dtype=np.bool_)
    gain, offset = np.zeros((*size, max(robot.dof for robot in robots))), np.zeros(size)
    for r, (robot, row) in enumerate(zip(robots, rows, strict=True)):
        matrix, shift = robot.mimic_map
        place = {k: i for i, k in enumerate(robot.movable_joints)}
        for i, (k, T_parent_joint) in enumerate(row, length - len(row) if pad_front else 0):
            T[r, i] = T_parent_joint
            if k in place:
                axis[r, i] = robot.joints[k].unit_axis
                slides[r, i] = robot.joints[k].kind == "prismatic"
                gain[r, i, : robot.dof], offset[r, i] = matrix[place[k]], shift[place[k]]
    T_all, axes, gains, offsets = (
        torch.from_numpy(values).to(device, dtype) for values in (T, axis, gain, offset)
    )
    return JointTensors(T_all, axes, torch.from_numpy(slides).to(device), gains, offsets)


def _depths(robot: Robot) -> NDArray[np.int64]:
    """Return the number of joints between the root and each link, shape (n_links,)."""
    depths = np.zeros(len(robot.links), dtype=np.int64)
    for i, parent in enumerate(robot.parents[1:], 1):
        depths[i] = depths[parent] + 1
    return depths


def _taken(poses: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Return poses (n, K, 4, 4) by columns (n, W), shape (n, W, 4, 4)."""
    if poses.shape[1] == 1:
        return poses.expand(-1, columns.shape[1], -1, -1)
    # Indexing copies whole poses, which is twice as fast as take_along_dim, entry by entry.
    return poses[torch.arange(len(poses), device=poses.device)[:, None], columns]

"""Kinematics of many robots in one batch of torch tensors, on any device.

The functions have the names, formulas and results of ``morphgen.model.kinematics``. Robots are
compiled once: ``compile_tree`` for the poses of all links, ``compile_chain`` for the pose and the
Jacobian of one frame, which is several times as fast because only joints between the root and the
frame count.
Loops run over levels of the tree, never over environments.

Arguments that the functions share:

* ``robot_index``, shape (n,), int64: index of the compiled robot in each row of the batch.
* ``q``, shape (n, J): independent joint positions [rad or m], padded to the largest number J of
  independent joints; entries beyond a robot's joints are ignored. Inverse kinematics starts there.
* ``positions``, shape (n, 3) [m], and ``rotations``, shape (n, 3, 3): goals of the tools in the
  root frames.
* ``limits``: lower and upper joint limits, each (n, J) [rad or m].
* ``max_step``: largest change of a joint position in one iteration [rad or m].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from morphgen.model.kinematics import DAMPING, moving_chain
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array


def quaternion_from_matrix(R: torch.Tensor) -> torch.Tensor:
    """Return unit quaternions (w, x, y, z), w >= 0, (..., 4) of rotation matrices (..., 3, 3).

    Shepperd, Quaternion from rotation matrix, 1978: the products of a quaternion's components with
    its largest one are sums of the matrix's elements.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = R.flatten(-2).unbind(-1)
    rows = (
        (1 + xx + yy + zz, zy - yz, xz - zx, yx - xy),
        (zy - yz, 1 + xx - yy - zz, yx + xy, zx + xz),
        (xz - zx, yx + xy, 1 + yy - xx - zz, zy + yz),
        (yx - xy, zx + xz, zy + yz, 1 + zz - xx - yy),
    )
    products = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    row = torch.gather(products, -2, index).squeeze(-2)
    q = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    return torch.where(q[..., :1] < 0, -q, q)


def matrix_from_quaternion(quaternion: torch.Tensor) -> torch.Tensor:
    """Return rotation matrices (..., 3, 3) of unit quaternions (w, x, y, z), shape (..., 4)."""
    w, v = quaternion[..., :1, None], quaternion[..., 1:]
    cross = skew(v)
    eye = torch.eye(3, device=quaternion.device)
    return eye + 2 * w * cross + 2 * cross @ cross


def skew(v: torch.Tensor) -> torch.Tensor:
    """Return the skew-symmetric matrices K (..., 3, 3) of vectors v (..., 3): K u = v x u."""
    x, y, z = v.unbind(-1)
    o = torch.zeros_like(x)
    return torch.stack([o, -z, y, z, o, -x, -y, x, o], dim=-1).reshape(*x.shape, 3, 3)


def rotation_from_z(axes: torch.Tensor) -> torch.Tensor:
    """Return the smallest rotations (..., 3, 3) that turn z into unit vectors (..., 3)."""
    z = torch.zeros_like(axes)
    z[..., 2] = 1
    cross, cosine = torch.linalg.cross(z, axes), axes[..., 2]
    K = skew(cross)
    opposite = cosine < -1 + 1e-6  # there the formula divides by zero
    factor = 1 / torch.where(opposite, torch.ones_like(cosine), 1 + cosine)
    eye = torch.eye(3, device=axes.device)
    R = eye + K + K @ K * factor[..., None, None]
    half_turn = torch.diag(torch.tensor([1.0, -1.0, -1.0], device=axes.device))
    return torch.where(opposite[..., None, None], half_turn, R)


def rotvec_from_matrix(R: torch.Tensor) -> torch.Tensor:
    """Return rotation vectors, angle times axis, (n, 3) [rad] of rotation matrices (n, 3, 3).

    Computed as the logarithm of the unit quaternion, which is well-conditioned at 0 and at pi.
    """
    quaternion = quaternion_from_matrix(R)
    w, v = quaternion[:, :1], quaternion[:, 1:]
    sine = torch.linalg.vector_norm(v, dim=1, keepdim=True)
    angle = 2 * torch.atan2(sine, w)
    # The limit of angle / sine at 0 is 2.
    return v * torch.where(sine > 0, angle / sine.clamp(min=1e-30), 2.0)


Device = torch.device | str


@dataclass(frozen=True, eq=False)
class JointTensors:
    """Joints of R robots, K per robot, padded with joints that are fixed at the identity."""

    T_parent_joint: torch.Tensor
    """Pose of each joint frame at position zero in the preceding frame, shape (R, K, 4, 4)."""
    axis: torch.Tensor  # unit axis in the joint frame, shape (R, K, 3)
    is_prismatic: torch.Tensor  # whether each joint is prismatic, shape (R, K), bool
    gain: torch.Tensor
    """Joint positions are ``gain @ q + offset``, mimic joints included, shape (R, K, J)."""
    offset: torch.Tensor  # joint positions at q = 0 [rad or m], shape (R, K)

    @cached_property
    def motion(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Matrices A and B of a joint's motion, T = T_parent_joint + a A + b B, each (R, K, 4, 4).

        Revolute: a = sin(x), b = 1 - cos(x), by Rodrigues' formula. Prismatic: a = x, b = 0.
        """
        K = skew(self.axis)
        rotates = ~self.is_prismatic[..., None, None]
        A, B = torch.zeros_like(self.T_parent_joint), torch.zeros_like(self.T_parent_joint)
        A[..., :3, :3] = K * rotates
        A[..., :3, 3] = self.axis * self.is_prismatic[..., None]
        B[..., :3, :3] = K @ K * rotates
        return self.T_parent_joint @ A, self.T_parent_joint @ B

    def transforms(self, robot_index: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Return each joint's frame after its motion in the preceding frame, (n, K, 4, 4)."""
        positions = (self.gain[robot_index] @ q[:, :, None])[:, :, 0] + self.offset[robot_index]
        prismatic = self.is_prismatic[robot_index]
        a = torch.where(prismatic, positions, torch.sin(positions))[..., None, None]
        b = torch.where(prismatic, torch.zeros_like(positions), 1 - torch.cos(positions))
        A, B = self.motion
        motion = a * A[robot_index] + b[..., None, None] * B[robot_index]
        return self.T_parent_joint[robot_index] + motion


@dataclass(frozen=True, eq=False)
class KinematicTree:
    """All links of R robots, padded to L links and J independent joints."""

    joints: JointTensors
    """The joint that attaches each link to its parent, fixed for the root; K = L."""
    is_movable: torch.Tensor  # mask of the links whose joint is not fixed, shape (R, L), bool
    levels: tuple[tuple[torch.Tensor, torch.Tensor], ...]
    """For each depth from 1 on, the indices of the links at that depth and the columns of their
    parents within the level above, both (R, W), int64, padded with 0."""
    column: torch.Tensor
    """Column of each link in the concatenation of all levels, root first, shape (R, L), int64."""


@dataclass(frozen=True, eq=False)
class FrameChain:
    """The movable joints between the root and one frame of R robots.

    Chains are padded to D joints at the root. Fixed joints are merged into the next joint's pose.
    """

    joints: JointTensors  # the joints, root first; K = D
    T_joint_frame: torch.Tensor  # pose of the frame in the frame of the last joint, shape (R, 4, 4)


def compile_tree(
    robots: Sequence[Robot],
    *,
    max_links: int | None = None,
    dtype: torch.dtype = torch.float32,
    device: Device = "cpu",
) -> KinematicTree:
    """Compile robots for ``forward_kinematics``."""
    links = max_links or max(len(robot.links) for robot in robots)
    size = len(robots), links
    parents, depth, place, column = np.zeros((4, *size), dtype=np.int64)
    movable = np.zeros(size, dtype=np.bool_)
    for r, robot in enumerate(robots):
        movable[r, [k + 1 for k in robot.movable_joints]] = True
        for i, parent in enumerate(robot.parents[1:], 1):
            parents[r, i], depth[r, i] = parent, depth[r, parent] + 1
    levels, start = [], 1
    for level in range(1, depth.max() + 1):
        row, links_at = np.nonzero(depth == level)
        places = (depth == level).cumsum(axis=1)[row, links_at] - 1
        place[row, links_at], column[row, links_at] = places, start + places
        link, above = np.zeros((2, len(robots), places.max() + 1), dtype=np.int64)
        link[row, places] = links_at
        above[row, places] = place[row, parents[row, links_at]]
        levels.append((torch.from_numpy(link).to(device), torch.from_numpy(above).to(device)))
        start += link.shape[1]
    rows = [
        [(None, np.eye(4)), *((k, joint.T_parent_joint.matrix) for k, joint in joints)]
        for joints in (enumerate(robot.joints) for robot in robots)
    ]
    return KinematicTree(
        joints=_joint_tensors(robots, rows, links, dtype, device, pad_front=False),
        is_movable=torch.from_numpy(movable).to(device),
        levels=tuple(levels),
        column=torch.from_numpy(column).to(device),
    )


def compile_chain(
    robots: Sequence[Robot], *, dtype: torch.dtype = torch.float32, device: Device = "cpu"
) -> FrameChain:
    """Compile the tools of robots for ``frame_jacobian``, ``frame_pose``, ``FramePositions``."""
    rows, ends = zip(*(moving_chain(robot, TOOL) for robot in robots), strict=True)
    depth = max(1, *map(len, rows))
    joints = _joint_tensors(robots, rows, depth, dtype, device, pad_front=True)
    return FrameChain(joints, torch.from_numpy(np.array(ends)).to(device, dtype))


def forward_kinematics(
    tree: KinematicTree, robot_index: torch.Tensor, q: torch.Tensor
) -> torch.Tensor:
    """Return ``T_root_link`` of all links, shape (n, L, 4, 4); the identity for padding."""
    T_parent_link = tree.joints.transforms(robot_index, q)
    T_root_level = torch.eye(4, dtype=q.dtype, device=q.device).expand(len(q), 1, 4, 4)
    poses = [T_root_level]
    for link, parent in tree.levels:
        T_root_parent = _select(T_root_level, parent[robot_index])
        T_root_level = T_root_parent @ _select(T_parent_link, link[robot_index])
        poses.append(T_root_level)
    return _select(torch.cat(poses, dim=1), tree.column[robot_index])


def joint_axes(
    tree: KinematicTree, robot_index: torch.Tensor, T_root_link: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return a point [m] and the direction of each link's joint axis in the root frame.

    Both have shape (n, L, 3), with zeros where the joint is fixed; ``T_root_link`` has the poses of
    all links, shape (n, L, 4, 4).
    """
    movable = tree.is_movable[robot_index][..., None]
    axes = (T_root_link[..., :3, :3] @ tree.joints.axis[robot_index][..., None])[..., 0]
    return T_root_link[..., :3, 3] * movable, axes * movable


def frame_pose(chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return ``T_root_frame``, shape (n, 4, 4); for the arguments see ``frame_jacobian``."""
    return _chain_frames(chain, robot_index, q)[-1]


def frame_jacobian(
    chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the pose (n, 4, 4) and geometric Jacobian (n, 6, J) of the chain's frame.

    As ``kinematics.frame_jacobian``; columns of joints that do not move the frame are zero.
    """
    *joints, T_root_frame = _chain_frames(chain, robot_index, q)
    T_root_joint = torch.stack(joints, dim=1)
    axis = (T_root_joint[..., :3, :3] @ chain.joints.axis[robot_index][..., None])[..., 0]
    lever = T_root_frame[:, None, :3, 3] - T_root_joint[..., :3, 3]
    prismatic = chain.joints.is_prismatic[robot_index][..., None]
    linear = torch.where(prismatic, axis, torch.linalg.cross(axis, lever))
    angular = torch.where(prismatic, torch.zeros_like(axis), axis)
    columns = torch.cat([linear, angular], dim=2).transpose(1, 2)
    return T_root_frame, columns @ chain.joints.gain[robot_index]


class FramePositions:
    """Frame positions of a batch with fixed robots, several times as fast as ``frame_pose``.

    A point is transformed from the frame to the root, joint by joint, instead of multiplying poses.
    """

    def __init__(self, chain: FrameChain, robot_index: torch.Tensor) -> None:
        """Gather the joints of each row; for the arguments see ``frame_jacobian``."""
        joints = chain.joints
        # T_parent_joint and the matrices A and B of ``JointTensors.motion``, each (D, 3, 4, n)
        parts = torch.stack([joints.T_parent_joint, *joints.motion])[:, robot_index, :, :3]
        self._T, self._A, self._B = parts.permute(0, 2, 3, 4, 1).contiguous()
        self._point = chain.T_joint_frame[robot_index, :3, 3].T.contiguous()
        gain = joints.gain[robot_index].transpose(0, 1)
        self._leader = gain.abs().argmax(dim=2)
        self._gain = torch.gather(gain, 2, self._leader[..., None])[..., 0].contiguous()
        self._offset = joints.offset[robot_index].T.contiguous()
        self._prismatic = joints.is_prismatic[robot_index].T.contiguous()

    def __call__(self, q: torch.Tensor) -> torch.Tensor:
        """Return positions in the root frames, shape (n, 3) [m], at q, shape (n, J)."""
        positions = self._gain * torch.gather(q.T, 0, self._leader) + self._offset
        a = torch.where(self._prismatic, positions, torch.sin(positions))[:, None, None]
        b = torch.where(self._prismatic, 0.0, 1 - torch.cos(positions))[:, None, None]
        T = self._T + a * self._A + b * self._B
        rotations, translations = T[:, :, :3].unbind(), T[:, :, 3].unbind()
        point = self._point
        for R, p in zip(reversed(rotations), reversed(translations), strict=True):
            point = (R * point).sum(dim=1) + p
        return point.T


def frame_positions(chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
    """Return the frames' positions in their root frames, shape (n, 3) [m]."""
    return FramePositions(chain, robot_index)(q)


def _chain_frames(
    chain: FrameChain, robot_index: torch.Tensor, q: torch.Tensor
) -> list[torch.Tensor]:
    """Return ``T_root_joint`` after each joint's motion, then ``T_root_frame``, all (n, 4, 4)."""
    T_parent_joint = chain.joints.transforms(robot_index, q)
    frames = [T_parent_joint[:, 0]]
    for d in range(1, T_parent_joint.shape[1]):
        frames.append(frames[-1] @ T_parent_joint[:, d])
    return [*frames, frames[-1] @ chain.T_joint_frame[robot_index]]


def _joint_tensors(
    robots: Sequence[Robot],
    rows: Sequence[Sequence[tuple[int | None, Array]]],
    length: int,
    dtype: torch.dtype,
    device: Device,
    *,
    pad_front: bool,
) -> JointTensors:
    size = len(robots), length
    T = np.tile(np.eye(4), (*size, 1, 1))
    axis, prismatic = np.tile((0.0, 0.0, 1.0), (*size, 1)), np.zeros(size, dtype=np.bool_)
    gain, offset = np.zeros((*size, max(robot.dof for robot in robots))), np.zeros(size)
    for r, (robot, row) in enumerate(zip(robots, rows, strict=True)):
        matrix, shift = robot.mimic_map
        for i, (k, T_parent_joint) in enumerate(row, length - len(row) if pad_front else 0):
            T[r, i] = T_parent_joint
            if k in robot.movable_rows:
                axis[r, i] = robot.joints[k].unit_axis
                prismatic[r, i] = robot.joints[k].kind == "prismatic"
                gain[r, i, : robot.dof] = matrix[robot.movable_rows[k]]
                offset[r, i] = shift[robot.movable_rows[k]]
    T_all, axes, gains, offsets = (
        torch.from_numpy(values).to(device, dtype) for values in (T, axis, gain, offset)
    )
    return JointTensors(T_all, axes, torch.from_numpy(prismatic).to(device), gains, offsets)


def _select(poses: torch.Tensor, columns: torch.Tensor) -> torch.Tensor:
    """Select poses (n, K, 4, 4) by columns (n, W) in each row, shape (n, W, 4, 4)."""
    if poses.shape[1] == 1:
        return poses.expand(-1, columns.shape[1], -1, -1)
    # Indexing copies whole poses, which is twice as fast as take_along_dim, entry by entry.
    return poses[torch.arange(len(poses), device=poses.device)[:, None], columns]


ROTATION_DAMPING = 0.1  # damping of rotations [joint units per radian]
_ROTATION_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Fractions of a rotation step that are compared with the rotation budget."""


def dls_step(J: torch.Tensor, error: torch.Tensor, damping: float) -> torch.Tensor:
    """Return the damped least-squares steps (..., J) of Jacobians (..., m, J), errors (..., m)."""
    # Not ``solve``, which reads whether a matrix is singular: these are positive definite.
    scaled: torch.Tensor
    scaled, _ = torch.linalg.solve_ex(_regularized(J, damping), error[..., None])
    return (J.transpose(-1, -2) @ scaled)[..., 0]


def dls_step_within(
    J: torch.Tensor,
    error: torch.Tensor,
    damping: float,
    q: torch.Tensor,
    limits: tuple[torch.Tensor, torch.Tensor],
) -> torch.Tensor:
    """Return ``dls_step`` from configurations (..., J) with the limits of their joints, each too.

    Joints that would leave their limits are held in a second pass, so that the others take over
    their share.
    """
    there, (lower, upper) = q + dls_step(J, error, damping), limits
    is_free = (there >= lower) & (there <= upper)
    return dls_step(J * is_free[..., None, :], error, damping)


def pose_task(
    T_root_tool: torch.Tensor,
    J_root_tool: torch.Tensor,
    positions: torch.Tensor,
    rotations: torch.Tensor,
    rotation_weight: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return Jacobians (n, 6, J) and errors (n, 6) [m] of pose tasks, with weighted rotations.

    T_root_tool, J_root_tool: Poses of the tools and their Jacobians; see ``frame_jacobian``.
    rotation_weight: Weight of the rotation errors [m/rad].
    """
    rotation_error = rotvec_from_matrix(rotations @ T_root_tool[:, :3, :3].transpose(1, 2))
    angular = rotation_weight * J_root_tool[:, 3:]
    errors = (positions - T_root_tool[:, :3, 3], rotation_weight * rotation_error)
    return torch.cat([J_root_tool[:, :3], angular], dim=1), torch.cat(errors, dim=1)


def solve_ik(
    chain: FrameChain,
    robot_index: torch.Tensor,
    starts: torch.Tensor,
    positions: torch.Tensor,
    rotations: torch.Tensor | None,
    limits: tuple[torch.Tensor, torch.Tensor],
    *,
    rotation_weight: float = 0.0,
    iterations: int = 25,
    damping: float = 0.05,
    max_step: float = 0.5,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move tools to positions or poses by damped least squares, from starts (S, n, J) each.

    Position and rotation have the same priority. From random starts this finds more solutions than
    repeating ``pose_ik_step``, which is made for paths that start near their goals. Return
    configurations within the limits and errors (S, n, 3) or, as of ``pose_task``, (S, n, 6) [m].
    """
    count = len(starts)
    robot_index, positions = robot_index.repeat(count), positions.repeat(count, 1)
    lower, upper = (limit.repeat(count, 1) for limit in limits)
    R = None if rotations is None else rotations.repeat(count, 1, 1)

    def task(q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        T_root_tool, J_root_tool = frame_jacobian(chain, robot_index, q)
        if R is None:
            return J_root_tool[:, :3], positions - T_root_tool[:, :3, 3]
        return pose_task(T_root_tool, J_root_tool, positions, R, rotation_weight)

    q = torch.clamp(starts.flatten(0, 1), lower, upper)
    for _ in range(iterations):
        J, error = task(q)
        step = dls_step(J, error, damping)
        q = torch.clamp(q + step.clamp(-max_step, max_step), lower, upper)
    return q.view_as(starts), task(q)[1].view(*starts.shape[:2], -1)


def pose_ik_step(
    chain: FrameChain,
    robot_index: torch.Tensor,
    q: torch.Tensor,
    positions: torch.Tensor,
    rotations: torch.Tensor,
    limits: tuple[torch.Tensor, torch.Tensor],
    *,
    rotation_budget: torch.Tensor | None = None,
) -> torch.Tensor:
    """Move tools towards poses by one step of damped least squares, position before rotation.

    The rotation error is reduced only in the null space of the position task (Nakamura, Hanafusa
    and Yoshikawa, Task-priority based redundancy control of robot manipulators, 1987), and its step
    is shortened until no joint exceeds the ``rotation_budget`` (n, J).
    """
    T_root_tool, J_root_tool = frame_jacobian(chain, robot_index, q)
    position_error = (positions - T_root_tool[:, :3, 3])[..., None]
    rotation_error = rotvec_from_matrix(rotations @ T_root_tool[:, :3, :3].transpose(1, 2))[
        ..., None
    ]
    lower, upper = limits
    eye = torch.eye(q.shape[1], dtype=q.dtype, device=q.device)
    target, free = q, torch.ones_like(q, dtype=torch.bool)
    for _ in range(2):  # the second pass is without the joints that the first moved out of limits
        J = J_root_tool * free[:, None]
        linear, angular = J[:, :3], J[:, 3:]
        inverse = _damped_inverse(linear, DAMPING)
        step = inverse @ position_error
        null_space = eye - inverse @ linear
        inverse = _damped_inverse(angular @ null_space, ROTATION_DAMPING)
        rotation_step = null_space @ (inverse @ (rotation_error - angular @ step))
        if rotation_budget is not None:
            rotation_step = _limit_rotation(rotation_budget, step, rotation_step)
        target = q + (step + rotation_step)[..., 0]
        free = free & (target >= lower) & (target <= upper)
    return torch.clamp(target, lower, upper)


def _limit_rotation(
    budget: torch.Tensor, step: torch.Tensor, rotation_step: torch.Tensor
) -> torch.Tensor:
    """Return the largest fraction of the rotation steps (n, J, 1) within the budget (n, J)."""
    limited = torch.zeros_like(rotation_step)
    for share in _ROTATION_SHARES:
        fits = ((step + share * rotation_step)[..., 0].abs() <= budget).all(dim=1)
        limited = torch.where(fits[:, None, None], share * rotation_step, limited)
    return limited


def _damped_inverse(J: torch.Tensor, damping: float) -> torch.Tensor:
    inverse: torch.Tensor
    inverse, _ = torch.linalg.inv_ex(_regularized(J, damping))
    return J.transpose(1, 2) @ inverse


def _regularized(J: torch.Tensor, damping: float) -> torch.Tensor:
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return J @ J.transpose(-1, -2) + damping**2 * eye

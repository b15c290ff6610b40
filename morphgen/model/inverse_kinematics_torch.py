"""Damped least squares for many robots in one batch of torch tensors.

The functions have the names and formulas of ``morphgen.model.inverse_kinematics``; see
``morphgen.model.kinematics_torch`` for ``chain``, ``robot_index`` and ``q``.
"""

from __future__ import annotations

import torch

from morphgen.model.inverse_kinematics import DAMPING, MAX_STEP
from morphgen.model.kinematics_torch import FrameChain, frame_jacobian, frame_pose
from morphgen.model.rotation_torch import rotvec_from_matrix

ROTATION_DAMPING = 0.1
"""Damping of rotations [joint units per radian]."""

_ROTATION_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Shares of a rotation that are tried against a rotation budget."""


def dls_step(J: torch.Tensor, error: torch.Tensor, damping: float) -> torch.Tensor:
    """Return J^T (J J^T + damping^2 I)^-1 error; see the NumPy version.

    Args:
        J: Jacobians, shape (..., m, J).
        error: Wanted changes, shape (..., m).
        damping: In units of a singular value of ``J``.

    Returns:
        Changes of the joints, shape (..., J).
    """
    scaled: torch.Tensor = torch.linalg.solve(_regularized(J, damping), error[..., None])
    return (J.transpose(-1, -2) @ scaled)[..., 0]


def solve_position_ik(
    chain: FrameChain,
    robot_index: torch.Tensor,
    q: torch.Tensor,
    positions: torch.Tensor,
    limits: tuple[torch.Tensor, torch.Tensor],
    *,
    iterations: int = 25,
    damping: float = DAMPING,
    max_step: float = MAX_STEP,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move tools to positions by damped least squares, within the joint limits.

    Args:
        chain: Compiled robots.
        robot_index: Which robot each row is, shape (n,), int64.
        q: Configurations to start from, shape (n, J), rad or m.
        positions: Goals of the tools in the root frames, shape (n, 3), metres.
        limits: Lower and upper joint limits, each (n, J).
        iterations: Number of steps.
        damping: See ``dls_step``.
        max_step: Largest change of a joint in one step, rad or m.

    Returns:
        Configurations, shape (n, J), and the remaining errors, shape (n, 3), metres.
    """
    q = torch.clamp(q, *limits)
    for _ in range(iterations):
        T_root_tool, J_root_tool = frame_jacobian(chain, robot_index, q)
        step = dls_step(J_root_tool[:, :3], positions - T_root_tool[:, :3, 3], damping)
        q = torch.clamp(q + step.clamp(-max_step, max_step), *limits)
    return q, positions - frame_pose(chain, robot_index, q)[:, :3, 3]


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
    """Return configurations whose tools are nearer to poses, first in position, then in rotation.

    One iteration of damped least squares in two levels of priority: the rotation is corrected only
    by motion that leaves the position alone (Nakamura, Hanafusa and Yoshikawa, Task-priority based
    redundancy control of robot manipulators, 1987). Joints that would leave their limits stand
    still.

    Args:
        chain: Compiled robots.
        robot_index: Which robot each row is, shape (n,), int64.
        q: Joint positions, shape (n, J), rad or m.
        positions: Goals of the tools in the root frames, shape (n, 3), metres.
        rotations: Goal rotations of the tools in the root frames, shape (n, 3, 3).
        limits: Lower and upper joint limits, each (n, J).
        rotation_budget: Largest change of each joint, shape (n, J): the tool then rotates only by
            a share of the way for which no joint exceeds it. By default it rotates all the way.

    Returns:
        Joint positions within the limits, shape (n, J).
    """
    T_root_tool, J_root_tool = frame_jacobian(chain, robot_index, q)
    shift = (positions - T_root_tool[:, :3, 3])[..., None]
    turn = rotvec_from_matrix(rotations @ T_root_tool[:, :3, :3].transpose(1, 2))[..., None]
    lower, upper = limits
    eye = torch.eye(q.shape[1], dtype=q.dtype, device=q.device)
    target, moves = q, torch.ones_like(q, dtype=torch.bool)
    for _ in range(2):
        J = J_root_tool * moves[:, None]
        linear, angular = J[:, :3], J[:, 3:]
        inverse = _damped_inverse(linear, DAMPING)
        step = inverse @ shift
        null_space = eye - inverse @ linear
        inverse = _damped_inverse(angular @ null_space, ROTATION_DAMPING)
        rotation_step = null_space @ (inverse @ (turn - angular @ step))
        if rotation_budget is not None:
            rotation_step = _within(rotation_budget, step, rotation_step)
        target = q + (step + rotation_step)[..., 0]
        moves = moves & (target >= lower) & (target <= upper)
    return torch.clamp(target, lower, upper)


def _within(budget: torch.Tensor, step: torch.Tensor, extra: torch.Tensor) -> torch.Tensor:
    """Return the largest share of extra steps (n, J, 1) that the budget (n, J) leaves room for."""
    largest = torch.zeros_like(extra)
    for share in _ROTATION_SHARES:
        fits = ((step + share * extra)[..., 0].abs() <= budget).all(dim=1)
        largest = torch.where(fits[:, None, None], share * extra, largest)
    return largest


def _damped_inverse(J: torch.Tensor, damping: float) -> torch.Tensor:
    inverse: torch.Tensor = torch.linalg.inv(_regularized(J, damping))
    return J.transpose(1, 2) @ inverse


def _regularized(J: torch.Tensor, damping: float) -> torch.Tensor:
    eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
    return J @ J.transpose(-1, -2) + damping**2 * eye

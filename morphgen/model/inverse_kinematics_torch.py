"""Damped least squares for many robots in one batch of torch tensors.

The functions have the names and formulas of ``morphgen.model.inverse_kinematics``; see
``morphgen.model.kinematics_torch`` for ``chain``, ``robot_index`` and ``q``.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from morphgen.model.inverse_kinematics import DAMPING, MAX_STEP
from morphgen.model.kinematics_torch import FrameChain, frame_jacobian, rotvec_from_matrix

ROTATION_DAMPING = 0.1
"""Damping of rotations [joint units per radian]."""
START_DAMPING = 0.05
"""Damping of ``solve_from_starts`` [joint units per metre]: more than of paths that start near."""
START_MAX_STEP = 0.5
"""Largest change of a joint in one iteration of ``solve_from_starts`` [rad or m]."""

_ROTATION_SHARES = (0.25, 0.5, 0.75, 1.0)
"""Fractions of a rotation step that are compared with the rotation budget."""


def dls_step(J: torch.Tensor, error: torch.Tensor, damping: float) -> torch.Tensor:
    """Return the damped least-squares step; see ``inverse_kinematics.dls_step``.

    J: Jacobians, shape (..., m, J).
    error: Task-space errors, shape (..., m).

    Returns:
        Changes of the joint positions, shape (..., J).
    """
    # Not ``solve``, which reads whether a matrix is singular: these are positive definite.
    scaled: torch.Tensor
    scaled, _ = torch.linalg.solve_ex(_regularized(J, damping), error[..., None])
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

    robot_index: Compiled robot of each row, shape (n,), int64.
    q: Initial configurations, shape (n, J) [rad or m].
    positions: Goal positions of the tools in the root frames, shape (n, 3) [m].
    limits: Lower and upper joint limits, each (n, J) [rad or m].
    max_step: Largest change of a joint position in one iteration [rad or m].

    Returns:
        Configurations, shape (n, J), and the remaining position errors, shape (n, 3) [m].
    """

    def task(q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        T_root_tool, J_root_tool = frame_jacobian(chain, robot_index, q)
        return J_root_tool[:, :3], positions - T_root_tool[:, :3, 3]

    return _solve(task, q, limits, iterations, damping, max_step)


def pose_task(
    T_root_tool: torch.Tensor,
    J_root_tool: torch.Tensor,
    positions: torch.Tensor,
    rotations: torch.Tensor,
    rotation_weight: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the Jacobians and errors of pose tasks, with weighted rotations.

    T_root_tool: Poses of the tools, shape (n, 4, 4).
    J_root_tool: Their Jacobians, shape (n, 6, J); see ``frame_jacobian``.
    positions: Goal positions of the tools in the root frames, shape (n, 3) [m].
    rotations: Goal rotations of the tools in the root frames, shape (n, 3, 3).
    rotation_weight: Weight of the rotation errors [m/rad].

    Returns:
        Jacobians, shape (n, 6, J), and errors, shape (n, 6) [m].
    """
    rotation_error = rotvec_from_matrix(rotations @ T_root_tool[:, :3, :3].transpose(1, 2))
    angular = rotation_weight * J_root_tool[:, 3:]
    errors = (positions - T_root_tool[:, :3, 3], rotation_weight * rotation_error)
    return torch.cat([J_root_tool[:, :3], angular], dim=1), torch.cat(errors, dim=1)


def solve_pose_ik(
    chain: FrameChain,
    robot_index: torch.Tensor,
    q: torch.Tensor,
    positions: torch.Tensor,
    rotations: torch.Tensor,
    limits: tuple[torch.Tensor, torch.Tensor],
    *,
    rotation_weight: float,
    iterations: int = 25,
    damping: float = DAMPING,
    max_step: float = MAX_STEP,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move tools to poses by damped least squares, within the joint limits.

    Position and rotation have the same priority. From random starts this finds more solutions than
    repeating ``pose_ik_step``, which is made for paths that start near their goals.

    robot_index: Compiled robot of each row, shape (n,), int64.
    q: Initial configurations, shape (n, J) [rad or m].
    positions: Goal positions of the tools in the root frames, shape (n, 3) [m].
    rotations: Goal rotations of the tools in the root frames, shape (n, 3, 3).
    limits: Lower and upper joint limits, each (n, J) [rad or m].
    rotation_weight: Weight of the rotation errors [m/rad].
    max_step: Largest change of a joint position in one iteration [rad or m].

    Returns:
        Configurations, shape (n, J), and the remaining errors of ``pose_task``, shape (n, 6) [m].
    """

    def task(q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        T_root_tool, J_root_tool = frame_jacobian(chain, robot_index, q)
        return pose_task(T_root_tool, J_root_tool, positions, rotations, rotation_weight)

    return _solve(task, q, limits, iterations, damping, max_step)


def solve_from_starts(
    chain: FrameChain,
    robot_index: torch.Tensor,
    starts: torch.Tensor,
    positions: torch.Tensor,
    rotations: torch.Tensor | None,
    limits: tuple[torch.Tensor, torch.Tensor],
    *,
    rotation_weight: float,
    iterations: int,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Move tools to positions or poses from several starts each; see ``solve_position_ik``.

    robot_index: Compiled robot of each goal, shape (n,), int64.
    starts: Initial configurations, S of each goal, shape (S, n, J) [rad or m].
    positions: Goal positions of the tools in the root frames, shape (n, 3) [m].
    rotations: Goal rotations, shape (n, 3, 3); None if only positions matter.
    limits: Lower and upper joint limits, each (n, J) [rad or m].
    rotation_weight: Weight of the rotation errors [m/rad].

    Returns:
        Configurations, shape (S, n, J), and the remaining errors, shape (S, n, 3) or, for poses as
        of ``pose_task``, (S, n, 6) [m].
    """
    count = len(starts)
    robots, q = robot_index.repeat(count), starts.flatten(0, 1)
    goals = positions.repeat(count, 1)
    all_limits = limits[0].repeat(count, 1), limits[1].repeat(count, 1)
    constants = {"damping": START_DAMPING, "max_step": START_MAX_STEP}
    if rotations is None:
        q, error = solve_position_ik(
            chain, robots, q, goals, all_limits, iterations=iterations, **constants
        )
    else:
        q, error = solve_pose_ik(
            chain,
            robots,
            q,
            goals,
            rotations.repeat(count, 1, 1),
            all_limits,
            rotation_weight=rotation_weight,
            iterations=iterations,
            **constants,
        )
    return q.view_as(starts), error.view(count, len(positions), -1)


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
    and Yoshikawa, Task-priority based redundancy control of robot manipulators, 1987). Joints that
    would leave their limits do not move.

    robot_index: Compiled robot of each row, shape (n,), int64.
    q: Joint positions, shape (n, J) [rad or m].
    positions: Goal positions of the tools in the root frames, shape (n, 3) [m].
    rotations: Goal rotations of the tools in the root frames, shape (n, 3, 3).
    limits: Lower and upper joint limits, each (n, J) [rad or m].
    rotation_budget: Largest change of each joint position, shape (n, J). The rotation step is
        shortened until no joint exceeds it. Unlimited by default.

    Returns:
        Joint positions within the limits, shape (n, J).
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


def _solve(
    task: Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
    q: torch.Tensor,
    limits: tuple[torch.Tensor, torch.Tensor],
    iterations: int,
    damping: float,
    max_step: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Repeat steps of damped least squares; return configurations and the remaining errors.

    task: Function from configurations (n, J) to Jacobians (n, m, J) and errors (n, m).
    q: Initial configurations, shape (n, J) [rad or m].
    limits: Lower and upper joint limits, each (n, J) [rad or m].
    max_step: Largest change of a joint position in one iteration [rad or m].
    """
    q = torch.clamp(q, *limits)
    for _ in range(iterations):
        J, error = task(q)
        step = dls_step(J, error, damping)
        q = torch.clamp(q + step.clamp(-max_step, max_step), *limits)
    return q, task(q)[1]


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

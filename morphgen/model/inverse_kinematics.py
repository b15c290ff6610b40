"""Damped least squares in NumPy: configurations of one robot that bring a frame to a goal.

``morphgen.model.inverse_kinematics_torch`` has the same for many robots in one batch of tensors.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from morphgen.model.kinematics import frame_jacobian, frame_pose, joint_limits
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array

DAMPING = 0.02
"""Damping of position tasks [m/rad or 1]; in ``solve_pose_ik`` it is relative to the largest
singular value of the Jacobian."""
MAX_STEP = 0.3
"""Largest change of a joint position in one iteration [rad or m]."""
POSE_ITERATIONS = 24
"""Maximum number of iterations of ``solve_pose_ik``, which runs while the user drags a gizmo."""
POSE_TOLERANCE = 1e-5
"""Weighted pose error at which ``solve_pose_ik`` stops [m]."""


def dls_step(J: Array, error: Array, damping: float) -> Array:
    """Return the damped least-squares step, J^T (J J^T + damping^2 I)^-1 error.

    Wampler, Manipulator inverse kinematic solutions based on vector formulations and damped
    least-squares methods, 1986.

    J: Jacobians, shape (..., m, dof).
    error: Task-space errors, shape (..., m).

    Returns:
        Changes of the joint positions, shape (..., dof).
    """
    J_T = J.swapaxes(-1, -2)
    regularized = J @ J_T + damping**2 * np.eye(J.shape[-2])
    return np.asarray((J_T @ np.linalg.solve(regularized, error[..., None]))[..., 0])


def solve_position_ik(
    robot: Robot,
    q: Array,
    positions: Array,
    *,
    iterations: int = 25,
    damping: float = DAMPING,
    max_step: float = MAX_STEP,
    tolerance: float = 0.0,
) -> tuple[Array, Array]:
    """Move tools to positions by damped least squares, within the joint limits.

    q: Initial configurations, shape (n, dof) [rad or m].
    positions: Goal positions of the tools in the root frame, shape (n, 3) [m].
    max_step: Largest change of a joint position in one iteration [rad or m].
    tolerance: Distance at which a tool has arrived and its row iterates no more [m].

    Returns:
        Configurations, shape (n, dof), and the remaining position errors, shape (n, 3) [m].
    """
    low, high = joint_limits(robot).T
    q = np.clip(q, low, high)
    rows = np.arange(len(q))
    for _ in range(iterations):
        T_root_tool, J_root_tool = frame_jacobian(robot, q[rows])
        error = positions[rows] - T_root_tool[:, :3, 3]
        if tolerance:
            away = np.linalg.norm(error, axis=1) > tolerance
            rows, error, J_root_tool = rows[away], error[away], J_root_tool[away]
        step = dls_step(J_root_tool[:, :3], error, damping)
        q[rows] = np.clip(q[rows] + np.clip(step, -max_step, max_step), low, high)
    return q, positions - frame_pose(robot, q)[:, :3, 3]


def solve_pose_ik(
    robot: Robot,
    T_root_goal: Array,
    q: ArrayLike,
    *,
    rotation_weight: float = 0.2,
    frame: str = TOOL,
) -> Array:
    """Move a frame to a pose, or as near as possible, by damped least squares.

    Joints at a limit that a step would move beyond it are excluded from the step.

    T_root_goal: Goal pose of the frame in the root frame, shape (4, 4).
    q: Initial configuration, shape (dof,) [rad or m].
    rotation_weight: Weight of the rotation error [m/rad]; 0 leaves the orientation free.

    Returns:
        The best configuration found, shape (dof,), within the joint limits.
    """
    low, high = joint_limits(robot).T
    current = best = np.clip(np.asarray(q, dtype=np.float64), low, high)
    least = np.inf
    weights = np.repeat([1.0, rotation_weight], 3)
    for _ in range(POSE_ITERATIONS):
        T_root_frame, J = frame_jacobian(robot, current, frame)
        R_error = T_root_goal[:3, :3] @ T_root_frame[:3, :3].T
        position_error = T_root_goal[:3, 3] - T_root_frame[:3, 3]
        rotation_error = Rotation.from_matrix(R_error).as_rotvec()
        error = np.concatenate([position_error, rotation_error]) * weights
        norm = float(np.linalg.norm(error))
        if norm < least:
            best, least = current, norm
        if norm < POSE_TOLERANCE:
            break
        direction = J.T @ error
        blocked = ((current <= low) & (direction < 0)) | ((current >= high) & (direction > 0))
        weighted = np.where(blocked, 0.0, J * weights[:, None])
        damping = DAMPING * max(float(np.linalg.norm(weighted, 2)), 1e-9)
        step = dls_step(weighted, error, damping)
        # Scale all joints equally, so that the frame keeps its direction of motion.
        scale = min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-9))
        current = np.clip(current + step * scale, low, high)
    return best

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
"""Damping of positions [joint units per metre]; of ``solve_pose_ik`` relative to the largest
singular value of the Jacobian."""
MAX_STEP = 0.3
"""Largest change of a joint in one iteration, rad or m."""
POSE_ITERATIONS = 24
"""Most iterations of ``solve_pose_ik``: a drag of the mouse waits for them."""
POSE_TOLERANCE = 1e-5
"""Error at which ``solve_pose_ik`` stops, metres and radians times ``rotation_weight``."""


def dls_step(J: Array, error: Array, damping: float) -> Array:
    """Return the damped least-squares step, J^T (J J^T + damping^2 I)^-1 error.

    Wampler, Manipulator inverse kinematic solutions based on vector formulations and damped
    least-squares methods, 1986.

    Args:
        J: Jacobians, shape (..., m, dof).
        error: Wanted changes, shape (..., m).
        damping: In units of a singular value of ``J``.

    Returns:
        Changes of the joints, shape (..., dof).
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
) -> tuple[Array, Array]:
    """Move tools to positions by damped least squares, within the joint limits.

    Args:
        robot: The robot, with a tool.
        q: Configurations to start from, shape (n, dof), rad or m.
        positions: Goals of the tools in the root frame, shape (n, 3), metres.
        iterations: Number of steps.
        damping: See ``dls_step``.
        max_step: Largest change of a joint in one step, rad or m.

    Returns:
        Configurations, shape (n, dof), and the remaining errors, shape (n, 3), metres.

    Raises:
        RobotError: If the robot has no tool.
    """
    low, high = joint_limits(robot).T
    q = np.clip(q, low, high)
    for _ in range(iterations):
        T_root_tool, J_root_tool = frame_jacobian(robot, q)
        step = dls_step(J_root_tool[:, :3], positions - T_root_tool[:, :3, 3], damping)
        q = np.clip(q + np.clip(step, -max_step, max_step), low, high)
    return q, positions - frame_pose(robot, q)[:, :3, 3]


def solve_pose_ik(
    robot: Robot,
    T_root_goal: Array,
    q: ArrayLike,
    *,
    rotation_weight: float = 0.2,
    frame: str = TOOL,
) -> Array:
    """Bring a frame to a pose by damped least squares, or as near as the iterations lead.

    Joints at a limit that a step would push beyond it are left out of the step.

    Args:
        robot: The robot.
        T_root_goal: Goal pose of the frame, shape (4, 4).
        q: Configuration to start from, shape (dof,), rad or m.
        rotation_weight: Metres that a radian counts for; 0 leaves the orientation free.
        frame: Name of the frame.

    Returns:
        The best configuration found, shape (dof,), within the joint limits.

    Raises:
        RobotError: If there is no such frame.
    """
    low, high = joint_limits(robot).T
    current = best = np.clip(np.asarray(q, dtype=np.float64), low, high)
    least = np.inf
    weights = np.repeat([1.0, rotation_weight], 3)
    for _ in range(POSE_ITERATIONS):
        T_root_frame, J = frame_jacobian(robot, current, frame)
        turn = Rotation.from_matrix(T_root_goal[:3, :3] @ T_root_frame[:3, :3].T).as_rotvec()
        error = np.concatenate([T_root_goal[:3, 3] - T_root_frame[:3, 3], turn]) * weights
        size = float(np.linalg.norm(error))
        if size < least:
            best, least = current, size
        if size < POSE_TOLERANCE:
            break
        push = J.T @ error
        blocked = ((current <= low) & (push < 0)) | ((current >= high) & (push > 0))
        weighted = np.where(blocked, 0.0, J * weights[:, None])
        damping = DAMPING * max(float(np.linalg.norm(weighted, 2)), 1e-9)
        step = dls_step(weighted, error, damping)
        # All joints in proportion, so that the frame keeps its direction.
        share = min(1.0, MAX_STEP / max(float(np.abs(step).max(initial=0.0)), 1e-9))
        current = np.clip(current + step * share, low, high)
    return best

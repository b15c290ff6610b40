"""The configuration that brings a robot's frame to a pose, from where it is."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from morphgen.model.kinematics import bounds, frame_jacobian
from morphgen.model.robot import TOOL, Robot

Array = NDArray[np.float64]

STEPS = 24
"""Most steps of one search."""
DAMPING = 0.02
"""Of the least squares, relative to the largest singular value."""
LARGEST = 0.3
"""Largest change of a joint in one step, rad or m."""
EXACT = 1e-5
"""Error at which a search ends, metres and radians times ``turn``."""


def solve(
    robot: Robot, T_root_goal: Array, q: ArrayLike, *, turn: float = 0.2, frame: str = TOOL
) -> Array:
    """Damped least squares from a configuration, within the joint limits.

    Wampler, Manipulator inverse kinematic solutions based on vector formulations and damped
    least-squares methods, 1986. Where the pose cannot be reached, the result is as near as the
    steps led.

    Args:
        robot: The body.
        T_root_goal: Wanted pose of the frame, shape (4, 4).
        q: Where to start, shape (dof,), rad or m.
        turn: What a radian counts for, in metres; 0 leaves the orientation free.
        frame: Name of the frame.

    Returns:
        The best configuration found, shape (dof,).

    Raises:
        RobotError: If there is no such frame.
    """
    low, high = bounds(robot).T
    best = q = np.clip(np.asarray(q, dtype=np.float64), low, high)
    least = np.inf
    weights = np.array([1.0, 1.0, 1.0, turn, turn, turn])
    for _ in range(STEPS):
        T, jacobian = frame_jacobian(robot, q, frame)
        error = np.concatenate([T_root_goal[:3, 3] - T[:3, 3], _turned(T, T_root_goal)]) * weights
        size = float(np.linalg.norm(error))
        if size < least:
            best, least = q, size
        if size < EXACT:
            break
        step = _damped(jacobian * weights[:, None], error, _stuck(q, low, high, jacobian, error))
        q = np.clip(q + step, low, high)
    return best


def _turned(T: Array, T_goal: Array) -> Array:
    """Rotation vector from one orientation to another, in the root frame."""
    return np.asarray(Rotation.from_matrix(T_goal[:3, :3] @ T[:3, :3].T).as_rotvec())


def _stuck(q: Array, low: Array, high: Array, jacobian: Array, error: Array) -> NDArray[np.bool_]:
    """Joints at a limit that the error would push beyond it."""
    push = jacobian.T @ error
    return np.asarray(((q <= low) & (push < 0)) | ((q >= high) & (push > 0)))


def _damped(jacobian: Array, error: Array, stuck: NDArray[np.bool_]) -> Array:
    J = np.where(stuck, 0.0, jacobian)
    damping = DAMPING * max(float(np.linalg.norm(J, 2)), 1e-9)
    step = J.T @ np.linalg.solve(J @ J.T + damping**2 * np.eye(6), error)
    largest = float(np.abs(step).max(initial=0.0))
    return np.asarray(step if largest <= LARGEST else step * (LARGEST / largest))

"""Configurations of one robot whose tool is where it is wanted, in NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morphgen.model.kinematics import bounds, frame_jacobian, frame_pose
from morphgen.model.robot import Robot

Array = NDArray[np.float64]

ITERATIONS = 25
DAMPING = 0.02
"""Of the least squares, in units of joints over metres."""
LARGEST = 0.3
"""Largest change of a joint in an iteration, rad or m."""


def bring_tool(robot: Robot, q: Array, positions: Array) -> tuple[Array, Array]:
    """Move tools to positions by damped least squares (Wampler 1986), within the joints' limits.

    Args:
        robot: The body, with a tool.
        q: Where to start, shape (n, dof), rad or m.
        positions: Where the tools are to be in the root frame, shape (n, 3), metres.

    Returns:
        Configurations, shape (n, dof), and how far their tools then are from where they are to be,
        along x, y and z, shape (n, 3), metres.

    Raises:
        RobotError: If the robot has no tool.
    """
    low, high = bounds(robot).T
    damping = DAMPING**2 * np.eye(3)
    q = np.clip(q, low, high)
    for _ in range(ITERATIONS):
        T_root_tool, J = frame_jacobian(robot, q)
        J, error = J[:, :3], positions - T_root_tool[:, :3, 3]
        lever = np.linalg.solve(J @ J.transpose(0, 2, 1) + damping, error[..., None])
        step = (J.transpose(0, 2, 1) @ lever)[..., 0]
        q = np.clip(q + np.clip(step, -LARGEST, LARGEST), low, high)
    return q, positions - frame_pose(robot, q)[:, :3, 3]

"""Configurations of one robot whose tool is where it is wanted, in NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morphgen.model.kinematics import bounds, forward_kinematics
from morphgen.model.robot import TOOL, Robot

Array = NDArray[np.float64]

ITERATIONS = 25
DAMPING = 0.02
"""Of the least squares, in units of joints over metres."""
LARGEST = 0.3
"""Largest change of a joint in an iteration, rad or m."""


def tool_jacobian(robot: Robot, q: Array) -> tuple[Array, Array]:
    """Where the tool is, and how the joints move it.

    Args:
        robot: The body, with a tool.
        q: Independent joint positions, shape (n, dof), rad or m.

    Returns:
        Its position in the root frame, shape (n, 3), and its linear Jacobian, shape (n, 3, dof).

    Raises:
        RobotError: If the robot has no tool.
    """
    frame = robot.frame(TOOL)
    T_root_link = forward_kinematics(robot, q)
    at = robot.link_index[frame.link]
    tool = (T_root_link[:, at] @ frame.T_link_frame.matrix)[:, :3, 3]
    matrix, _ = robot.mimic_map
    row = {k: i for i, k in enumerate(robot.movable)}
    jacobian = np.zeros((len(q), 3, robot.dof))
    for k in robot.joints_to(frame.link):
        joint = robot.joints[k]
        if not joint.is_movable:
            continue
        axis = T_root_link[:, k + 1, :3, :3] @ np.array(joint.unit_axis)
        if joint.kind != "prismatic":
            axis = np.cross(axis, tool - T_root_link[:, k + 1, :3, 3])
        jacobian += axis[:, :, None] * matrix[row[k]]
    return tool, jacobian


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
        tool, J = tool_jacobian(robot, q)
        lever = np.linalg.solve(J @ J.transpose(0, 2, 1) + damping, (positions - tool)[..., None])
        step = (J.transpose(0, 2, 1) @ lever)[..., 0]
        q = np.clip(q + np.clip(step, -LARGEST, LARGEST), low, high)
    return q, positions - tool_jacobian(robot, q)[0]

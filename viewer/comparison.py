"""Joints of different robots that do the same: by their place on the way to the tool."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from morphgen.model.kinematics import joint_limits
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array


def roles(robot: Robot) -> list[str]:
    """The role of every independent joint, in the order of q.

    ``joint 1`` is the first on the way from the root to the tool; ``finger 1`` the first of those
    that do not move the tool. A joint that moves the tool through a mimic is on the way, too.
    """
    on_way: list[int] = []
    if any(frame.name == TOOL for frame in robot.frames):
        row = {k: i for i, k in enumerate(robot.movable_joints)}
        gains, _ = robot.mimic_map
        path = [k for k in robot.joint_chain(robot.frame(TOOL).link) if k in row]
        on_way = [int(column) for k in path for column in gains[row[k]].nonzero()[0]]
    on_way = list(dict.fromkeys(on_way))
    others = [i for i in range(robot.dof) if i not in on_way]
    named = {i: f"joint {n}" for n, i in enumerate(on_way, 1)}
    named |= {i: f"finger {n}" for n, i in enumerate(others, 1)}
    return [named[i] for i in range(robot.dof)]


def all_roles(robots: Sequence[Robot]) -> list[str]:
    """Every role that one of the robots has, joints before fingers, by number."""
    found = {role for robot in robots for role in roles(robot)}
    return sorted(found, key=lambda role: (role[0] != "j", int(role.split()[1])))


def scaled(robot: Robot, q: Array) -> Array:
    """Positions as shares of the ranges: -1 at the lower bound, 1 at the upper, shape (dof,)."""
    low, high = joint_limits(robot).T
    half = np.where(high > low, (high - low) / 2, 1.0)
    return np.asarray((q - (low + high) / 2) / half)


def with_roles(robot: Robot, q: Array, values: Mapping[str, float]) -> Array:
    """A configuration with the joints of some roles moved.

    Args:
        robot: The body.
        q: Independent joint positions, shape (dof,), rad or m.
        values: Share of the range by role, in [-1, 1].

    Returns:
        Shape (dof,), within the bounds.
    """
    low, high = joint_limits(robot).T
    found = np.array(q, dtype=np.float64)
    for i, role in enumerate(roles(robot)):
        if role in values:
            found[i] = (low[i] + high[i]) / 2 + values[role] * (high[i] - low[i]) / 2
    return np.asarray(np.clip(found, low, high))

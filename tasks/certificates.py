"""What certificates of goal sets test: joint limits, and poses of the tool by MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from morphgen.model.kinematics import joint_limits
from morphgen.model.robot import Robot
from morphgen.typing import Array


def outside_limits(robot: Robot, q: Array) -> Iterator[tuple[int, str]]:
    """Find joints that are outside of their limits in configurations (n, dof).

    Yields:
        The row of the configuration, and what is wrong with it.
    """
    names = [robot.joints[k].name for k in robot.independent_joints]
    low, high = joint_limits(robot).T
    outside = (q < low) | (q > high) | ~np.isfinite(q)
    for i, j in np.argwhere(outside).tolist():
        yield i, f"joint {names[j]!r} is at {q[i, j]:g}, outside ({low[j]:g}, {high[j]:g})"

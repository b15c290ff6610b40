"""What certificates of goal sets test: joint limits, and poses of the tool by MuJoCo."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import NDArray

from morphgen.formats.mjcf import to_spec
from morphgen.model.kinematics import bounds, movable_positions
from morphgen.model.robot import TOOL, Robot

Array = NDArray[np.float64]


def outside_limits(robot: Robot, q: Array) -> Iterator[tuple[int, str]]:
    """Find joints that are outside of their limits in configurations (n, dof).

    Yields:
        The row of the configuration, and what is wrong with it.
    """
    names = [robot.joints[k].name for k in robot.independent]
    low, high = bounds(robot).T
    outside = (q < low) | (q > high) | ~np.isfinite(q)
    for i, j in np.argwhere(outside).tolist():
        yield i, f"joint {names[j]!r} is at {q[i, j]:g}, outside ({low[j]:g}, {high[j]:g})"


def tools_in_mujoco(robot: Robot, q: Array) -> Array:
    """Return the pose of the tool in the root frame, as MuJoCo has it, shape (n, 4, 4)."""
    bare = robot.with_links([replace(link, visuals=(), collisions=()) for link in robot.links])
    model = to_spec(bare).compile()
    data = mujoco.MjData(model)
    at = [model.joint(robot.joints[k].name).qposadr[0] for k in robot.movable]
    T_root_tool = np.tile(np.eye(4), (len(q), 1, 1))
    for T, positions in zip(T_root_tool, movable_positions(robot, q), strict=True):
        data.qpos[at] = positions
        mujoco.mj_kinematics(model, data)
        T[:3, :3] = data.site(TOOL).xmat.reshape(3, 3)
        T[:3, 3] = data.site(TOOL).xpos
    return T_root_tool

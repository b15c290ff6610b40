"""Region where a robot's block starts, the block's size, and the line that it must cross."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from morphgen.benchmark.workspace import tool_reach
from morphgen.errors import TaskError
from morphgen.model.frame_positions import frame_positions
from morphgen.model.kinematics import (
    forward_kinematics,
    joint_axes,
    random_configurations,
)
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.push.config import PushConfig
from morphgen.typing import Array

FULL_REACH = 0.4
"""Reach below which everything is scaled down in proportion [m]."""

_SAMPLES, _SEED = 16_384, 0
"""Number and seed of the configurations that sample the tool's range."""
_LEVEL = 1e-3
"""Variation of its height below which a tool moves in a plane [m]."""


@dataclass(frozen=True)
class Region:
    """Size of a block, range of its start poses and line that it must cross, in the world frame."""

    edge: float
    """Edge length of the block, a cube [m]."""
    scale: float
    """Scale of lengths: 1, or less for robots that reach less than ``FULL_REACH``."""
    x: tuple[float, float]
    """Range of x of the block's centre at the start [m]."""
    y: tuple[float, float]
    """Range of y of the block's centre at the start [m]."""
    line: float
    """y that the block's centre must cross [m]."""


def push_region(
    robot: Robot, config: PushConfig, ground: float, rng: np.random.Generator
) -> Region:
    """Return the region of a robot's block, which depends on how its tool moves.

    - Free robots, whose tool slides along two horizontal directions: the edge is in metres, x in
      ``config.free_x``.
    - Arms, whose tool slides along none and leaves every plane: the edge is relative to the
      effective reach, x in ``config.arm_x`` effective reaches beyond the shoulder.
    - All others, such as a rod on one slide or a chain of links in a plane: x is anywhere the tool
      can be at the height of the block while slides are at home; feasibility tests decide where it
      can push. The edge is in metres if the tool slides, else relative to the effective reach.

    y at the start is at most ``config.start_depth`` below ``config.start``, and the line is at
    ``config.line``; both are scaled down in proportion for robots that reach less than 0.4 m. That
    reach is the effective reach, or for robots that slide half of the range of y of the tool; for
    slides along one direction only it is divided by the square root of 2, since the tool has to
    swing around the block.

    Args:
        robot: The robot, with a tool.
        config: Constants of the task.
        ground: Height of the ground in the root frame [m].
        rng: Source of the random edge length.

    Raises:
        TaskError: If the tool cannot get down to the block, or cannot move along y.
        BenchmarkError: If the robot has no tool that moves.
    """
    shoulder, arm_reach = tool_reach(robot)  # refuses a robot whose tool does not move
    tool_positions = _tool_positions(robot)
    size = float(rng.uniform(*config.block_size))
    slides = _num_slide_directions(robot)
    if slides:
        reach = float(np.ptp(tool_positions[1])) / 2 / (1.0 if slides == 2 else math.sqrt(2))
    else:
        reach = effective_reach(arm_reach, shoulder[2] - ground, size)
    if not reach > 0:
        fault = "does not move along y" if slides else "does not get down to the ground"
        raise TaskError(f"robot {robot.name!r} cannot push: its tool {fault}")
    scale = min(1.0, reach / FULL_REACH)
    edge = size * (scale if slides else reach)
    if slides == 2:
        x = (config.free_x[0] * scale, config.free_x[1] * scale)
    elif not slides and np.ptp(tool_positions[2]) > _LEVEL:
        x = (
            shoulder[0] + config.arm_x[0] * reach,
            shoulder[0] + config.arm_x[1] * reach,
        )
    else:
        x = _tool_x_range(robot, ground, edge)
    y = ((config.start - config.start_depth) * scale, config.start * scale)
    return Region(edge, scale, x, y, config.line * scale)


def draw_blocks(region: Region, ground: float, n: int, rng: np.random.Generator) -> Array:
    """Draw poses of blocks that stand on the ground, uniform in the region and turned at random.

    Args:
        region: Region of the blocks.
        ground: Height of the ground [m].
        n: Number of poses; fewer are the beginning of more.
        rng: Source of random numbers.

    Returns:
        Shape (n, 7).
    """
    x, y, yaw = rng.random((n, 3)).T
    blocks = np.empty((n, 7))
    blocks[:, 0] = region.x[0] + x * (region.x[1] - region.x[0])
    blocks[:, 1] = region.y[0] + y * (region.y[1] - region.y[0])
    blocks[:, 2] = ground + region.edge / 2
    blocks[:, 3:] = yawed((2 * yaw - 1) * np.pi)
    return blocks


def yawed(yaw: Array) -> Array:
    """Return quaternions of rotations about z, shape (n, 4), w >= 0."""
    zero = np.zeros_like(yaw)
    q = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
    return np.where(q[:, :1] < 0, -q, q)


def effective_reach(reach: float, height: float, size: float) -> float:
    """Return the largest horizontal distance from the shoulder to a block's centre in reach [m].

    The block's edge is ``size`` times this effective reach e, so its centre is size e / 2 above the
    ground, and by Pythagoras e^2 + (height - size e / 2)^2 = reach^2; e is the larger root.

    Args:
        reach: Largest distance of the tool from the shoulder [m].
        height: Height of the shoulder above the ground [m].
        size: Edge length of the block, relative to e.

    Returns:
        The effective reach; 0 if the tool cannot get down to the block.
    """
    a, b = 1 + size**2 / 4, height * size / 2
    root = b**2 - a * (height**2 - reach**2)
    return max((b + math.sqrt(root)) / a, 0.0) if root >= 0 else 0.0


def _tool_positions(robot: Robot, *, sliding: bool = True) -> Array:
    """Return positions of the tool at random configurations, in the root frame, shape (3, n)."""
    q = random_configurations(robot, _SAMPLES, np.random.default_rng(_SEED))
    if not sliding:
        slides = [robot.joints[k].kind == "prismatic" for k in robot.independent_joints]
        q[:, slides] = np.array(robot.home)[slides]
    return frame_positions(robot, np.ascontiguousarray(q.T))


def _num_slide_directions(robot: Robot) -> int:
    """Return the number of horizontal directions along which the tool slides, at home."""
    _, directions = joint_axes(robot, forward_kinematics(robot, np.array(robot.home)))
    axes = [
        directions[k + 1, :2]
        for k in robot.joint_chain(robot.frame(TOOL).link)
        if robot.joints[k].kind == "prismatic"
    ]
    return int(np.linalg.matrix_rank(np.array(axes), tol=1e-3)) if axes else 0


def _tool_x_range(robot: Robot, ground: float, edge: float) -> tuple[float, float]:
    """Return the range of x of the tool at the height of the block, its slides at home."""
    tool_positions = _tool_positions(robot, sliding=False)
    x_low = tool_positions[0, (tool_positions[2] > ground) & (tool_positions[2] < ground + edge)]
    if not len(x_low):
        raise TaskError(
            f"robot {robot.name!r} cannot push: its tool is never as low as a block of "
            f"{edge:.3g} m, its height is {tool_positions[2].min() - ground:.3g} m at least"
        )
    return float(x_low.min()), float(x_low.max())

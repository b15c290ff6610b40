"""Where a robot's block starts, how large it is and what it has to cross."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.workspace import workspace
from morphgen.errors import TaskError
from morphgen.model.kinematics import (
    forward_kinematics,
    frame_positions,
    joint_axes,
    random_configurations,
)
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.config import PushConfig

Array = NDArray[np.float64]

FULL_REACH = 0.4
"""Bodies that reach less have everything scaled down, metres."""

_SAMPLES = 16_384
_LEVEL = 1e-3
"""A tool whose height varies by less moves in a plane, metres."""
_SEED = 0


@dataclass(frozen=True)
class Region:
    """A block's place in the world and what it is to cross, metres."""

    edge: float
    """Of the block, a cube."""
    scale: float
    """1, or less for bodies that reach under ``FULL_REACH``."""
    x: tuple[float, float]
    y: tuple[float, float]
    """Ranges of the block's centre at the start."""
    line: float
    """y that its centre must cross."""


def push_region(
    robot: Robot, config: PushConfig, ground: float, rng: np.random.Generator
) -> Region:
    """Where a robot's block starts, by how its tool moves.

    - Free bodies, whose tool slides along two horizontal directions: the edge is in metres, x in
      ``config.free_x``.
    - Arms, whose tool slides along none and leaves every plane: the edge is relative to the
      effective reach, x in ``config.arm_x`` of it beyond the shoulder.
    - All others, such as a rod on one slide or a chain of links in a plane: x is anywhere that the
      tool gets to at the height of the block while slides are at home, and it is left to proofs
      where it can push. The edge is in metres if the tool slides, relative to the effective reach
      if not.

    y at the start is below ``config.start``, by ``config.start_depth`` at most, and the line is at
    ``config.line``: in proportion less for bodies that reach under 0.4 m. The reach that counts is
    the effective reach, or for bodies that slide half of their tool's range of y; where it slides
    along one direction only, over the square root of 2, since it has to swing round the block.

    Args:
        robot: The body, with a tool.
        config: The task.
        ground: Height of the ground in the root frame, metres.
        rng: Where the edge comes from.

    Raises:
        TaskError: If the tool does not get down to the block, or not along y at all.
        BenchmarkError: If the robot has no tool that moves.
    """
    found = workspace(robot)  # refuses a robot whose tool does not move
    tools = _tools(robot)
    share = float(rng.uniform(*config.block_size))
    slides = _directions(robot)
    if slides:
        reach = float(np.ptp(tools[1])) / 2 / (1.0 if slides == 2 else math.sqrt(2))
    else:
        reach = effective_reach(found.reach, found.shoulder[2] - ground, share)
    if not reach > 0:
        how = "does not move along y" if slides else "does not get down to the ground"
        raise TaskError(f"robot {robot.name!r} cannot push: its tool {how}")
    scale = min(1.0, reach / FULL_REACH)
    edge = share * (scale if slides else reach)
    if slides == 2:
        x = (config.free_x[0] * scale, config.free_x[1] * scale)
    elif not slides and np.ptp(tools[2]) > _LEVEL:
        x0 = found.shoulder[0]
        x = (x0 + config.arm_x[0] * reach, x0 + config.arm_x[1] * reach)
    else:
        x = _sweep(robot, ground, edge)
    y = ((config.start - config.start_depth) * scale, config.start * scale)
    return Region(edge, scale, x, y, config.line * scale)


def effective_reach(reach: float, height: float, share: float) -> float:
    """How far from the shoulder's vertical an arm gets to the middle of a block on the ground.

    The block's edge is a share of this effective reach e, so its centre is ``share * e / 2`` above
    the ground, and by Pythagoras e^2 + (height - share e / 2)^2 = reach^2; e is the larger root.

    Args:
        reach: Largest distance of the tool from the shoulder, metres.
        height: Of the shoulder above the ground, metres.
        share: The block's edge, relative to e.

    Returns:
        Metres; 0 if the tool does not get down there.
    """
    a, b = 1 + share**2 / 4, height * share / 2
    root = b**2 - a * (height**2 - reach**2)
    return max((b + math.sqrt(root)) / a, 0.0) if root >= 0 else 0.0


def _tools(robot: Robot, *, sliding: bool = True) -> Array:
    """Where the tool is at random configurations, in the root frame, shape (3, n)."""
    q = random_configurations(robot, _SAMPLES, np.random.default_rng(_SEED))
    if not sliding:
        slides = [robot.joints[k].kind == "prismatic" for k in robot.independent]
        q[:, slides] = np.array(robot.home)[slides]
    return frame_positions(robot, np.ascontiguousarray(q.T))


def _directions(robot: Robot) -> int:
    """Along how many horizontal directions the tool slides, all else at home."""
    _, directions = joint_axes(robot, forward_kinematics(robot, np.array(robot.home)))
    axes = [
        directions[k + 1, :2]
        for k in robot.joints_to(robot.frame(TOOL).link)
        if robot.joints[k].kind == "prismatic"
    ]
    return int(np.linalg.matrix_rank(np.array(axes), tol=1e-3)) if axes else 0


def _sweep(robot: Robot, ground: float, edge: float) -> tuple[float, float]:
    """Range of x of the tool at the height of the block, its slides at home."""
    tools = _tools(robot, sliding=False)
    low = tools[0, (tools[2] > ground) & (tools[2] < ground + edge)]
    if not len(low):
        raise TaskError(
            f"robot {robot.name!r} cannot push: its tool is never as low as a block of "
            f"{edge:.3g} m, its height is {tools[2].min() - ground:.3g} m at least"
        )
    return float(low.min()), float(low.max())

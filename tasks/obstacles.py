"""Obstacles: random boxes in a robot's workspace that leave it room to move."""

from __future__ import annotations

import math

import numpy as np

from morphgen.benchmark.workspace import tool_reach
from morphgen.errors import BenchmarkError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.sim.base import Block, Scene

KEPT = 0.5
"""Fraction of otherwise free configurations that obstacles must leave free."""
PROBES = 128
"""Number of free configurations that test it."""
CANDIDATES = 16
"""Number of random boxes per required one."""


def draw_obstacles(
    robot: Robot,
    count: int,
    size: tuple[float, float],
    rng: np.random.Generator,
    *,
    ground: float = 0.0,
) -> tuple[Block, ...]:
    """Draw random boxes around positions of the tool.

    Edges are uniform in ``size`` times the reach, the largest distance of the tool from the robot's
    shoulder (``workspace``), which depends neither on a pedestal nor on the position of a rail.
    Each box is centred on the tool at a random free configuration and turned about the vertical at
    random; one that would cut the ground rests on it. Boxes are accepted in the order in which they
    are drawn, unless the robot with its base touches them at home, or they and those before leave
    less than ``KEPT`` of the free configurations. Boxes may overlap.

    Args:
        robot: The robot, with a tool.
        count: Number of boxes.
        size: Range of their edge lengths, relative to the reach.
        rng: Source of random numbers.
        ground: Height of the ground in the root frame [m].

    Raises:
        BenchmarkError: If count or size is invalid, the robot has no workspace or hardly a free
            configuration, or too few of the boxes can be accepted.
        MeshError: If a collision mesh cannot be read.
    """
    low, high = size
    if count < 1 or not 0 < low <= high < math.inf:
        raise BenchmarkError(
            f"{count} obstacles of size {size}: at least one, and 0 < lowest <= highest"
        )
    num_boxes = CANDIDATES * count
    _, reach = tool_reach(robot)
    edges = rng.uniform(low, high, (num_boxes, 3)) * reach
    turns = rng.uniform(-math.pi, math.pi, num_boxes)
    q, _ = FreeSpace(Scene(robot, ground=ground)).sample(PROBES + num_boxes, rng)
    tools = frame_pose(robot, q[PROBES:], TOOL)
    boxes = [
        _box(position, edge, turn, ground)
        for position, edge, turn in zip(
            tools[:, :3, 3].tolist(), edges.tolist(), turns, strict=True
        )
    ]
    space = FreeSpace(Scene(robot, obstacles=tuple(boxes), ground=ground))
    at_home = space.obstacle_hits([robot.home])[0]
    hits = space.obstacle_hits(q[:PROBES])
    accepted: list[Block] = []
    blocked = np.zeros(PROBES, dtype=np.bool_)
    for box, home, hit in zip(boxes, at_home, hits.T, strict=True):
        if len(accepted) < count and not home and np.mean(~(blocked | hit)) >= KEPT:
            accepted.append(box)
            blocked |= hit
    if len(accepted) < count:
        raise BenchmarkError(
            f"robot {robot.name!r}: of {num_boxes} boxes in its workspace only "
            f"{len(accepted)} are clear "
            f"of it at home and leave {KEPT:.0%} of its free configurations; {count} are asked "
            "for: take fewer or smaller obstacles"
        )
    return tuple(accepted)


def _box(centre: list[float], size: list[float], turn: float, ground: float) -> Block:
    x, y, z = centre
    a, b, c = size
    position = (x, y, max(z, ground + c / 2))
    return Block((a, b, c), Pose.from_xyz_rpy(position, (0.0, 0.0, float(turn))))

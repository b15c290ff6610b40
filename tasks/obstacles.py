"""Boxes in a robot's way: where it works, but neither at home nor everywhere."""

from __future__ import annotations

import math

import numpy as np

from morphgen.benchmark.workspace import workspace
from morphgen.errors import BenchmarkError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.model.robot import TOOL, Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.sim.base import Block, Scene

KEPT = 0.5
"""Share of otherwise free configurations that obstacles must leave free."""
PROBES = 128
"""Free configurations at which that is tested."""
CANDIDATES = 16
"""Boxes drawn for each that is wanted."""


def draw_obstacles(
    robot: Robot,
    count: int,
    size: tuple[float, float],
    rng: np.random.Generator,
    *,
    ground: float = 0.0,
) -> tuple[Block, ...]:
    """Place boxes where the tool goes.

    Edges are uniform in ``size`` times reach: the largest distance of the tool from the robot's
    shoulder (``workspace``), which neither a pedestal nor the position of a rail changes. Each box
    is centred on the tool at a random free configuration, turned about the vertical at random; one
    that would cut the ground rests on it. Boxes are taken in the order in which they are drawn, and
    passed over if the robot touches them at home, its base included, or if with those before they
    leave less than ``KEPT`` of the free configurations. Two may overlap.

    Args:
        robot: The body, with a tool.
        count: How many boxes.
        size: Range of their edges, relative to the reach.
        rng: Where they come from.
        ground: Height of the ground in the root frame, metres.

    Raises:
        BenchmarkError: If count or size is none, the robot has no workspace or hardly a free
            configuration, or too few of the boxes drawn could be taken.
        MeshError: If a collision mesh cannot be read.
    """
    low, high = size
    if count < 1 or not 0 < low <= high < math.inf:
        raise BenchmarkError(
            f"{count} obstacles of size {size}: at least one, and 0 < lowest <= highest"
        )
    drawn = CANDIDATES * count
    edges = rng.uniform(low, high, (drawn, 3)) * workspace(robot).reach
    turns = rng.uniform(-math.pi, math.pi, drawn)
    q, _ = FreeSpace(Scene(robot, ground=ground)).sample(PROBES + drawn, rng)
    tools = frame_pose(robot, q[PROBES:], TOOL)
    boxes = [
        _box(place, edge, turn, ground)
        for place, edge, turn in zip(tools[:, :3, 3].tolist(), edges.tolist(), turns, strict=True)
    ]
    space = FreeSpace(Scene(robot, obstacles=tuple(boxes), ground=ground))
    at_home = space.obstacle_hits([robot.home])[0]
    hits = space.obstacle_hits(q[:PROBES])
    taken: list[Block] = []
    lost = np.zeros(PROBES, dtype=np.bool_)
    for box, home, hit in zip(boxes, at_home, hits.T, strict=True):
        if len(taken) < count and not home and np.mean(~(lost | hit)) >= KEPT:
            taken.append(box)
            lost |= hit
    if len(taken) < count:
        raise BenchmarkError(
            f"robot {robot.name!r}: of {drawn} boxes in its workspace only {len(taken)} are clear "
            f"of it at home and leave {KEPT:.0%} of its free configurations; {count} are asked "
            "for: take fewer or smaller obstacles"
        )
    return tuple(taken)


def _box(centre: list[float], size: list[float], turn: float, ground: float) -> Block:
    x, y, z = centre
    a, b, c = size
    at = (x, y, max(z, ground + c / 2))
    return Block((a, b, c), Pose.from_xyz_rpy(at, (0.0, 0.0, float(turn))))

"""Where blocks are put, and whether anything stands in their way across the line."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.model.robot import Robot
from morphgen.tasks.config import PushConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.obstacles import draw_obstacles
from morphgen.tasks.push_region import Region
from morphgen.tasks.sim.base import Block, Scene

Array = NDArray[np.float64]

LAYOUTS = 8
"""Sets of obstacles that are drawn before giving up."""
KEPT = 0.5
"""Share of the ways clear without obstacles that must be left with them."""

_PROBES = 64
_SPACING = 0.125
"""Between places of the block that are tested on its way, in its edges."""


def draw_places(region: Region, ground: float, n: int, rng: np.random.Generator) -> Array:
    """Poses of blocks that stand on the ground, uniform in the region and turned at random.

    Args:
        region: Where they start.
        ground: Height of the ground, metres.
        n: How many.
        rng: Where they come from; the first of many are the same as few.

    Returns:
        Shape (n, 7).
    """
    x, y, yaw = rng.random((n, 3)).T
    place = np.empty((n, 7))
    place[:, 0] = region.x[0] + x * (region.x[1] - region.x[0])
    place[:, 1] = region.y[0] + y * (region.y[1] - region.y[0])
    place[:, 2] = ground + region.edge / 2
    place[:, 3:] = _yawed((2 * yaw - 1) * np.pi)
    return place


def way_is_clear(space: FreeSpace, region: Region, blocks: Array) -> NDArray[np.bool_]:
    """Whether nothing that stands still is on the straight ways of blocks, also if they turn.

    Args:
        space: Obstacles, base and block.
        region: Where the ways end.
        blocks: Poses at the start, shape (n, 7).

    Returns:
        Shape (n,).
    """
    parts = int((region.line - region.y[0]) / (_SPACING * region.edge)) + 2
    turned = blocks.copy()
    turned[:, 3:] = _yawed(_yaws(blocks) + np.pi / 4)
    ways = np.tile(np.stack([blocks, turned]), (parts, 1, 1, 1))
    ways[..., 1] = np.linspace(blocks[:, 1], region.line, parts)[:, None]
    return np.asarray(space.room(ways.reshape(-1, 7)).reshape(-1, len(blocks)).all(axis=0))


def clear_obstacles(
    robot: Robot,
    config: PushConfig,
    region: Region,
    block: Block,
    ground: float,
    seeds: np.random.SeedSequence,
) -> tuple[Block, ...]:
    """Obstacles as ``draw_obstacles`` places them that leave most ways of the block free.

    Args:
        robot: The body.
        config: How many obstacles, and of what size.
        region: Where the block starts and ends.
        block: Its size.
        ground: Height of the ground in the root frame, metres.
        seeds: Of all that is drawn.

    Raises:
        TaskError: If in each of ``LAYOUTS`` layouts less than ``KEPT`` of the ways are left.
        BenchmarkError: If obstacles cannot be placed at all.
    """
    of_probes, *layouts = seeds.spawn(LAYOUTS + 1)
    probes = draw_places(region, ground, _PROBES, np.random.default_rng(of_probes))

    def ways(placed: tuple[Block, ...]) -> int:
        space = FreeSpace(Scene(robot, block=block, obstacles=placed, ground=ground))
        return int(way_is_clear(space, region, probes).sum())

    needed = KEPT * ways(())
    for layout in layouts:
        rng = np.random.default_rng(layout)
        placed = draw_obstacles(robot, config.obstacles, config.obstacle_size, rng, ground=ground)
        if ways(placed) >= needed:
            return placed
    raise TaskError(
        f"robot {robot.name!r}: each of {LAYOUTS} layouts of {config.obstacles} obstacles stands "
        f"in more than {1 - KEPT:.0%} of the block's ways: take fewer or smaller obstacles"
    )


def _yawed(yaw: Array) -> Array:
    """Quaternions (n, 4) of turns about z, w >= 0."""
    zero = np.zeros_like(yaw)
    q = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
    return np.where(q[:, :1] < 0, -q, q)


def _yaws(blocks: Array) -> Array:
    return np.asarray(2 * np.arctan2(blocks[:, 6], blocks[:, 3]))


def breadths(blocks: Array) -> Array:
    """Extents along an axis of blocks (n, 7), in edges: from 1 to the square root of 2."""
    yaw = _yaws(blocks)
    return np.asarray(np.abs(np.cos(yaw)) + np.abs(np.sin(yaw)))

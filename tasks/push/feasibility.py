"""Feasibility of a push: a free way for the block, and configurations behind it and at the line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.model.inverse_kinematics import solve_position_ik
from morphgen.model.kinematics import frame_positions, random_configurations
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.obstacles import draw_obstacles
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.push.region import Region, draw_blocks, yawed
from morphgen.tasks.sim.base import Block, Scene
from morphgen.typing import Array

LAYOUTS = 8
"""Number of obstacle layouts that are drawn before giving up."""
KEPT = 0.5
"""Share of the ways clear without obstacles that must be left with them."""
BEHIND = (0.1, 0.4, 0.8, 1.2, 1.6)
"""Distances of the tool behind the block's hindmost point, in edges; the first that is free counts.
They go beyond the radius of the largest sphere, whose tool is at its bottom."""
CLOSE = 1e-3
"""Largest distance of a tool from its goal along x and along y, metres."""
NEAREST = 12
"""Number of configurations from which each goal of the tool is tried."""

_PROBES = 64
"""Number of blocks by whose ways a layout of obstacles is tested."""
_SPACING = 0.125
"""Distance of the block poses that are tested on a way, in edges of the block."""
_BANK = 2048
_DRAWN = 65_536
_ROUNDS = 8
_LOW, _HIGH = 0.15, 0.85
"""Range of heights of the tool, in edges of the block."""


@dataclass(frozen=True, eq=False)
class Feasibility:
    """What a robot can do with n blocks; rows where it cannot are not finite."""

    room: NDArray[np.bool_]
    """Whether nothing that stands still is on the block's straight way, shape (n,)."""
    behind: Array
    """Free configurations with the tool behind the block, at its height, shape (n, dof)."""
    across: Array
    """The same with the tool where the block's centre crosses the line, without the block."""


class FeasibilityTest:
    """Finds configurations near random free ones whose tools are where blocks will be."""

    def __init__(self, space: FreeSpace, region: Region, rng: np.random.Generator) -> None:
        """Collect free configurations whose tools are low and near the blocks.

        Args:
            space: The robot with its obstacles and block.
            region: Where blocks start and end.
            rng: Where configurations come from.
        """
        self._space, self._region = space, region
        self._robot: Robot = space.scene.robot
        self._ground = space.scene.ground or 0.0
        edge = region.edge
        low = np.array([region.x[0] - edge, region.y[0] - 2 * edge, self._ground])
        high = np.array([region.x[1] + edge, region.line + edge, self._ground + 1.5 * edge])
        self._bank, self._tools = sample_tools_in_box(space, low, high, rng)

    def __call__(self, blocks: Array) -> Feasibility:
        """Test blocks.

        Args:
            blocks: Poses of blocks that stand on the ground, shape (n, 7).
        """
        n, edge = len(blocks), self._region.edge
        room = path_is_clear(self._space, self._region, blocks)
        behind, across = (np.full((n, self._robot.dof), np.nan) for _ in range(2))
        if len(self._bank):
            at_line = blocks[:, :2].copy()
            at_line[:, 1] = self._region.line
            self._fill(across, room, at_line, None)
            hindmost = blocks[:, 1] - edge / 2 * _extents(blocks)
            for distance in BEHIND:
                place = np.stack([blocks[:, 0], hindmost - distance * edge], axis=1)
                wanted = np.isfinite(across[:, 0]) & ~np.isfinite(behind[:, 0])
                self._fill(behind, wanted, place, blocks)
        return Feasibility(room, behind, across)

    def _fill(
        self, found: Array, wanted: NDArray[np.bool_], places: Array, blocks: Array | None
    ) -> None:
        """Put free configurations whose tools are at places (n, 2) into rows that are wanted."""
        rows = np.flatnonzero(wanted)
        if not len(rows):
            return
        near, edge = min(NEAREST, len(self._bank)), self._region.edge
        apart = np.linalg.norm(places[rows, None] - self._tools[None, :, :2], axis=2)
        start = np.argsort(apart, axis=1, kind="stable")[:, :near].ravel()
        height = np.clip(self._tools[start, 2] - self._ground, _LOW * edge, _HIGH * edge)
        goals = np.concatenate(
            [np.repeat(places[rows], near, axis=0), self._ground + height[:, None]], axis=1
        )
        q, error = solve_position_ik(self._robot, self._bank[start], goals)
        low = height - error[:, 2]
        there = (np.abs(error[:, :2]) < CLOSE).all(axis=1) & (low > 0) & (low < edge)
        tested = np.zeros(len(q), dtype=np.bool_)
        of = None if blocks is None else np.repeat(blocks[rows], near, axis=0)[there]
        tested[there] = self._space.free(q[there], of)
        free = tested.reshape(len(rows), near)
        first = free.argmax(axis=1)
        good = free.any(axis=1)
        found[rows[good]] = q.reshape(len(rows), near, -1)[good, first[good]]


def path_is_clear(space: FreeSpace, region: Region, blocks: Array) -> NDArray[np.bool_]:
    """Return whether nothing that stands still is on the ways of blocks, also if they turn.

    Args:
        space: Obstacles, base and block.
        region: Where the ways end.
        blocks: Poses at the start, shape (n, 7).

    Returns:
        Shape (n,).
    """
    parts = int((region.line - region.y[0]) / (_SPACING * region.edge)) + 2
    turned = blocks.copy()
    turned[:, 3:] = yawed(_yaws(blocks) + np.pi / 4)
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
    """Draw obstacles as ``draw_obstacles`` does that leave most ways of the block free.

    Args:
        robot: The robot.
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
    probes = draw_blocks(region, ground, _PROBES, np.random.default_rng(of_probes))

    def ways(placed: tuple[Block, ...]) -> int:
        space = FreeSpace(Scene(robot, block=block, obstacles=placed, ground=ground))
        return int(path_is_clear(space, region, probes).sum())

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


def sample_tools_in_box(
    space: FreeSpace, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Draw random free configurations whose tools are in a box.

    Args:
        space: What is free; the block is nowhere.
        low: Lowest corner of the box in the root frame, shape (3,), metres.
        high: Its highest corner.
        rng: Where configurations come from.

    Returns:
        As many as are found soon: configurations, shape (n, dof), and their tools, (n, 3), metres.
    """
    robot = space.scene.robot
    kept, where = np.zeros((0, robot.dof)), np.zeros((0, 3))
    for _ in range(_ROUNDS):
        q = random_configurations(robot, _DRAWN, rng)
        tools = frame_positions(robot, np.ascontiguousarray(q.T)).T
        inside = np.flatnonzero(((tools > low) & (tools < high)).all(axis=1))[:_BANK]
        free = inside[space.free(q[inside])]
        kept, where = np.concatenate([kept, q[free]]), np.concatenate([where, tools[free]])
        if len(kept) >= _BANK:
            break
    return kept[:_BANK], where[:_BANK]


def _yaws(blocks: Array) -> Array:
    """Return rotations of blocks (n, 7) about z, shape (n,), rad."""
    return np.asarray(2 * np.arctan2(blocks[:, 6], blocks[:, 3]))


def _extents(blocks: Array) -> Array:
    """Return extents of blocks (n, 7) along y, in edges: from 1 to the square root of 2."""
    yaw = _yaws(blocks)
    return np.asarray(np.abs(np.cos(yaw)) + np.abs(np.sin(yaw)))

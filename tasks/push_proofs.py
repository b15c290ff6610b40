"""Proofs that a robot can push a block: configurations behind it, and at the line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.model.inverse_kinematics import solve_position_ik
from morphgen.model.kinematics import frame_positions, random_configurations
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push_region import Region
from morphgen.tasks.push_ways import breadths, way_is_clear

Array = NDArray[np.float64]

BEHIND = (0.1, 0.4, 0.8, 1.2, 1.6)
"""How far the tool may be behind the block's hindmost point, in its edges: the first that is free.
More than the radius of the largest sphere, whose tool is at its bottom."""
CLOSE = 1e-3
"""Distance of a tool from where it is to be, along x and y, that counts as there, metres."""
NEAREST = 12
"""Configurations from which each place is tried."""

_BANK = 2048
_DRAWN = 65_536
_ROUNDS = 8
_LOW, _HIGH = 0.15, 0.85
"""Heights of the tool that are aimed at, in edges of the block."""


@dataclass(frozen=True, eq=False)
class Proofs:
    """For n blocks; rows where there is no proof are not finite."""

    room: NDArray[np.bool_]
    """Whether nothing that stands still is on the block's straight way, shape (n,)."""
    behind: Array
    """Free configurations with the tool behind the block, at its height, shape (n, dof)."""
    across: Array
    """The same with the tool where the block's centre crosses the line, without the block."""


class Prover:
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
        self._bank, self._tools = free_within(space, low, high, rng)

    def prove(self, blocks: Array) -> Proofs:
        """Look for proofs.

        Args:
            blocks: Poses of blocks that stand on the ground, shape (n, 7).
        """
        n, edge = len(blocks), self._region.edge
        room = way_is_clear(self._space, self._region, blocks)
        behind, across = (np.full((n, self._robot.dof), np.nan) for _ in range(2))
        if len(self._bank):
            at_line = blocks[:, :2].copy()
            at_line[:, 1] = self._region.line
            self._fill(across, room, at_line, None)
            hindmost = blocks[:, 1] - edge / 2 * breadths(blocks)
            for distance in BEHIND:
                place = np.stack([blocks[:, 0], hindmost - distance * edge], axis=1)
                wanted = np.isfinite(across[:, 0]) & ~np.isfinite(behind[:, 0])
                self._fill(behind, wanted, place, blocks)
        return Proofs(room, behind, across)

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


def free_within(
    space: FreeSpace, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Random free configurations whose tools are in a box.

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

"""Feasibility of a push: a clear path, and configurations behind the block and at the line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.model.frame_positions import frame_positions
from morphgen.model.inverse_kinematics import solve_position_ik
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push.region import Region, yawed
from morphgen.typing import Array

BEHIND = (0.1, 0.4, 0.8, 1.2, 1.6)
"""Distances of the tool behind the block's rearmost point, in block edges, in the order of trial.
They exceed the radius of the largest sphere, whose tool is at its bottom."""
CLOSE = 1e-3
"""Largest distance of a tool from its goal along x and along y [m]."""
NEAREST = (1, 2, 3, 6)
"""Numbers of nearest sampled configurations from which inverse kinematics starts, in turn."""

_SPACING = 0.125
"""Distance of the tested poses on a path, in block edges."""
_BANK = 2048
"""Number of free configurations to collect."""
_DRAWN, _ROUNDS = 65_536, 8
"""Configurations drawn per round, and number of rounds."""
_FEW = 8192
"""Number of configurations whose tools are computed at a time."""
_ARRIVED = 1e-6
"""Distance from its goal at which inverse kinematics leaves a tool [m]."""
_LOW, _HIGH = 0.15, 0.85
"""Range of heights of the tool, in block edges."""


Indices = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Feasibility:
    """Certificates of pushes of n blocks; rows of infeasible pushes are NaN."""

    path_is_clear: NDArray[np.bool_]
    """Whether no obstacle or base is on the block's straight path, shape (n,)."""
    behind: Array
    """Free configurations with the tool behind the block, at its height, shape (n, dof)."""
    across: Array
    """Free configurations with the tool where the block's centre crosses the line, without the
    block, shape (n, dof)."""


class FeasibilityTest:
    """Finds certificates of pushes, by inverse kinematics from sampled free configurations."""

    def __init__(self, space: FreeSpace, region: Region, rng: np.random.Generator) -> None:
        """Sample free configurations whose tools are low and near the blocks.

        Args:
            space: The robot with its obstacles and block.
            region: Region of the blocks.
            rng: Source of random configurations.
        """
        self._space, self._region = space, region
        self._robot: Robot = space.scene.robot
        self._ground = space.scene.ground or 0.0
        edge = region.edge
        low = np.array([region.x[0] - edge, region.y[0] - 2 * edge, self._ground])
        high = np.array([region.x[1] + edge, region.line + edge, self._ground + 1.5 * edge])
        self._bank_q, self._bank_tools = sample_tools_in_box(space, low, high, rng)

    def __call__(self, blocks: Array) -> Feasibility:
        """Find certificates for blocks.

        Args:
            blocks: Poses of blocks that stand on the ground, shape (n, 7).
        """
        n, edge = len(blocks), self._region.edge
        clear = path_is_clear(self._space, self._region.line, blocks)
        behind, across = (np.full((n, self._robot.dof), np.nan) for _ in range(2))
        if len(self._bank_q):
            at_line = blocks[:, :2].copy()
            at_line[:, 1] = self._region.line
            self._fill(across, clear, at_line, None)
            # A block that is turned by its yaw extends |cos| + |sin| edges along y.
            yaw = _yaws(blocks)
            rear_y = blocks[:, 1] - edge / 2 * (np.abs(np.cos(yaw)) + np.abs(np.sin(yaw)))
            for distance in BEHIND:
                goals = np.stack([blocks[:, 0], rear_y - distance * edge], axis=1)
                missing = np.isfinite(across[:, 0]) & ~np.isfinite(behind[:, 0])
                self._fill(behind, missing, goals, blocks)
        return Feasibility(clear, behind, across)

    def _fill(
        self, q_out: Array, mask: NDArray[np.bool_], tool_xy: Array, blocks: Array | None
    ) -> None:
        """Write free configurations with tools at ``tool_xy`` (n, 2) into the rows of a mask."""
        rows = np.flatnonzero(mask)
        if not len(rows):
            return
        starts = _nearest(tool_xy[rows], self._bank_tools[:, :2], sum(NEAREST))
        begin = 0
        for count in NEAREST:  # most succeed from the nearest, which spares the others
            missing = ~np.isfinite(q_out[rows, 0])
            rows, starts = rows[missing], starts[missing]
            candidates = starts[:, begin : begin + count]
            begin += count
            if not candidates.size:
                return
            q, free = self._solve(
                candidates, tool_xy[rows], None if blocks is None else blocks[rows]
            )
            first, has_free = free.argmax(axis=1), free.any(axis=1)
            q_out[rows[has_free]] = q[has_free, first[has_free]]

    def _solve(
        self, start: Indices, tool_xy: Array, blocks: Array | None
    ) -> tuple[Array, NDArray[np.bool_]]:
        """Solve inverse kinematics for goals (m, 2) from k configurations of the bank each.

        Args:
            start: Indices of configurations, shape (m, k).
            tool_xy: Positions of the tool on the ground plane, shape (m, 2) [m].
            blocks: Poses of the block, shape (m, 7), or None.

        Returns:
            Configurations, shape (m, k, dof), and which of them are free and bring the tool to its
            goal between the bottom and the top of the block, shape (m, k).
        """
        (m, k), edge = start.shape, self._region.edge
        height = self._bank_tools[start.ravel(), 2] - self._ground
        height = np.clip(height, _LOW * edge, _HIGH * edge)
        goals = np.concatenate(
            [np.repeat(tool_xy, k, axis=0), self._ground + height[:, None]], axis=1
        )
        q, error = solve_position_ik(
            self._robot, self._bank_q[start.ravel()], goals, tolerance=_ARRIVED
        )
        tool_z = height - error[:, 2]
        is_close = (np.abs(error[:, :2]) < CLOSE).all(axis=1)
        reached = is_close & (tool_z > 0) & (tool_z < edge)
        free = np.zeros(len(q), dtype=np.bool_)
        poses = None if blocks is None else np.repeat(blocks, k, axis=0)[reached]
        free[reached] = self._space.free(q[reached], poses)
        return q.reshape(m, k, -1), free.reshape(m, k)


def path_is_clear(space: FreeSpace, line: float, blocks: Array) -> NDArray[np.bool_]:
    """Return whether the paths of blocks are clear of obstacles and base, even if they turn.

    Args:
        space: The robot with its obstacles and block.
        line: y where the paths end [m].
        blocks: Poses at the start, shape (n, 7).

    Returns:
        Shape (n,).
    """
    assert space.scene.block is not None
    step = _SPACING * space.scene.block.size[1]
    parts = int((line - blocks[:, 1].min()) / step) + 2
    turned = blocks.copy()
    turned[:, 3:] = yawed(_yaws(blocks) + np.pi / 4)
    poses = np.tile(np.stack([blocks, turned]), (parts, 1, 1, 1))
    advance = step * np.arange(parts)[:, None]
    poses[..., 1] = np.minimum(blocks[:, 1] + advance, line)[:, None]
    return np.asarray(
        space.block_is_clear(poses.reshape(-1, 7)).reshape(-1, len(blocks)).all(axis=0)
    )


def sample_tools_in_box(
    space: FreeSpace, low: Array, high: Array, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Sample free configurations whose tools are in a box.

    Args:
        space: The robot with its obstacles, without a block.
        low: Lowest corner of the box in the root frame, shape (3,) [m].
        high: Highest corner of the box.
        rng: Source of random configurations.

    Returns:
        Configurations, shape (n, dof), and tool positions, shape (n, 3) [m]; at most ``_BANK``, and
        fewer if ``_ROUNDS`` rounds find fewer.
    """
    robot = space.scene.robot
    kept, kept_tools = np.zeros((0, robot.dof)), np.zeros((0, 3))
    for _ in range(_ROUNDS):
        q = random_configurations(robot, _DRAWN, rng)
        tools, inside = _tools_in_box(robot, q, low, high)
        free = inside[space.free(q[inside])]
        kept = np.concatenate([kept, q[free]])
        kept_tools = np.concatenate([kept_tools, tools[free]])
        if len(kept) >= _BANK:
            break
    return kept[:_BANK], kept_tools[:_BANK]


def _tools_in_box(robot: Robot, q: Array, low: Array, high: Array) -> tuple[Array, Indices]:
    """Return tools of the first configurations, and which of these are in a box: ``_BANK`` at most.

    Args:
        robot: The robot.
        q: Configurations, shape (n, dof).
        low: Lowest corner of the box in the root frame, shape (3,) [m].
        high: Highest corner of the box.

    Returns:
        Tool positions, shape (m, 3) [m], where m <= n, and increasing indices below m.
    """
    tools, inside = np.zeros((0, 3)), np.zeros(0, dtype=np.int64)
    for begin in range(0, len(q), _FEW):
        few = frame_positions(robot, np.ascontiguousarray(q[begin : begin + _FEW].T)).T
        tools = np.concatenate([tools, few])
        inside = np.append(inside, begin + np.flatnonzero(((few > low) & (few < high)).all(axis=1)))
        if len(inside) >= _BANK:
            break
    return tools, inside[:_BANK]


def _nearest(goals: Array, points: Array, count: int) -> Indices:
    """Return the indices of the nearest points of each goal, in order, shape (n, at most count).

    Args:
        goals: Positions, shape (n, 2).
        points: Positions, shape (m, 2).
        count: Number of points for each goal.
    """
    count = min(count, len(points))
    x, y = (goals[:, i, None] - points[:, i] for i in range(2))
    distance = np.sqrt(x * x + y * y)
    farthest = np.partition(distance, count - 1, axis=1)[:, count - 1 : count]
    nearest = np.empty((len(goals), count), dtype=np.int64)
    for i, row in enumerate(distance):  # points at equal distance in the order of their indices
        candidates = np.flatnonzero(row <= farthest[i])
        nearest[i] = candidates[np.argsort(row[candidates], kind="stable")][:count]
    return nearest


def _yaws(blocks: Array) -> Array:
    """Return rotations of blocks (n, 7) about z, shape (n,) [rad]."""
    return np.asarray(2 * np.arctan2(blocks[:, 6], blocks[:, 3]))

"""Free ways in joint space: straight, by way of a free configuration, or round about."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.model.kinematics import bounds
from morphgen.rl.connect import connected
from morphgen.tasks.free_space import FreeSpace

Array = NDArray[np.float64]

STOPS = 12
"""Free configurations by way of which an end may be reached, besides home."""
ATTEMPTS = 4
"""Times that these are others."""
STRIDE = 0.05
"""Largest change of a joint between configurations of a way that are tested, rad or m."""


@dataclass(frozen=True, eq=False)
class Way:
    """A free way."""

    points: tuple[Array, ...]
    """Configurations to go through in straight lines, the end among them, each (dof,)."""
    end: int
    """Which of the ends it is."""


class FreeWays:
    """Ways of one robot."""

    def __init__(self, space: FreeSpace, step: Array, rng: np.random.Generator) -> None:
        """Draw stops.

        Args:
            space: What is free, with a block.
            step: Largest change of every joint in a control step, shape (dof,).
            rng: Where stops come from.
        """
        self._space, self._step = space, step
        robot = space.scene.robot
        self._home, self._bounds = np.array(robot.home), bounds(robot)
        self._seed = int(rng.integers(2**63))
        self._stops, _ = space.draw(STOPS * ATTEMPTS, rng)

    def steps(self, start: Array, ends: Array) -> Array:
        """Control steps that straight ways to ends (..., dof) take, shape (...,)."""
        return np.asarray((np.abs(ends - start) / self._step).max(axis=-1))

    def find(
        self,
        start: Array,
        ends: Array,
        vias: Array,
        costs: Array,
        block: Array,
        attempt: int,
    ) -> Way | None:
        """The free way that costs least, to one of several ends, by way of one stop at most.

        Args:
            start: Where it begins, shape (dof,).
            ends: Where it may end, shape (n, dof).
            vias: By way of which each end may be reached, shape (n, dof).
            costs: What it costs to go on from each end, in control steps, shape (n,).
            block: Where the block is, shape (7,).
            attempt: Which stops there are: others for the next ``ATTEMPTS`` numbers.

        Returns:
            None if no way is free.
        """
        known: dict[bytes, bool] = {}

        def free(a: Array, b: Array) -> bool:
            key = a.tobytes() + b.tobytes()
            if key not in known:
                known[key] = self._free_part(a, b, block) == 1
            return known[key]

        first = STOPS * (attempt % ATTEMPTS)
        stops = [self._home, *self._stops[first : first + STOPS]]
        ways = self._ways(start, ends, vias, stops, costs)
        for _, way in sorted(ways, key=lambda each: each[0]):
            points = (start, *way.points)
            # From the end: there the room is least.
            if all(free(a, b) for a, b in zip(points[:0:-1], points[-2::-1], strict=True)):
                return way
        return None

    def find_round_about(self, start: Array, ends: Array, block: Array, attempt: int) -> Way | None:
        """Any free way to one of several ends; see ``connected``. Arguments as of ``find``."""

        def free_part(a: Array, b: Array) -> float:
            return self._free_part(a, b, block)

        rng = np.random.default_rng([self._seed, attempt])
        found = connected(start, ends, self._bounds, self._step, free_part, rng)
        if found is None:
            return None
        return Way(found[1:], int(np.abs(ends - found[-1]).max(axis=1).argmin()))

    def _ways(
        self, start: Array, ends: Array, vias: Array, stops: Sequence[Array], costs: Array
    ) -> Iterator[tuple[float, Way]]:
        """All ways there may be, with what they cost."""
        for i, (end, via) in enumerate(zip(ends, vias, strict=True)):
            for before in ((), *((stop,) for stop in stops)):
                for points in ((*before, end), (*before, via, end)):
                    legs = np.diff(np.array([start, *points]), axis=0)
                    steps = (np.abs(legs) / self._step).max(axis=1).sum()
                    yield float(steps + costs[i]), Way(points, i)

    def _free_part(self, start: Array, end: Array, block: Array) -> float:
        """Which part of the straight way between two configurations is free, from the start."""
        parts = max(int(np.abs(end - start).max() / STRIDE) + 1, 2)
        way = start + np.linspace(0, 1, parts)[:, None] * (end - start)
        free = self._space.free(way, np.tile(block, (parts, 1)))
        return 1.0 if free.all() else max(int(free.argmin()) - 1, 0) / (parts - 1)

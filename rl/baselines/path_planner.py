"""Free ways in joint space: straight, by way of a free configuration, or round about."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.kinematics import joint_limits, unwrap_joints
from morphgen.rl.baselines.rrt_connect import FreePart, Tree, connected, explored, shortened
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.free_space import FreeSpace
from morphgen.typing import Array

ALONG = 6
"""Free ways along a tree that are compared."""
GROWN = 12
"""Times that a tree grows for every configuration that is drawn from it."""
STOPS = 12
"""Free configurations by way of which an end may be reached, besides home."""
ATTEMPTS = 4
"""Times that these are others."""
STRIDE = 0.05
"""Largest change of a joint between configurations of a way that are tested, rad or m."""
LATE, TOO_LATE = 20.0, 400.0
"""Control steps that one is worth by which a way is late, and that it is worth at most."""
LEGS = 24
"""Of a way for which there is room before there is one with more."""
NEAR = 1.01 * min(share for share in BINS if share > 0)
"""Part of a joint's step that is left where a leg ends: discrete actions get no nearer."""


@dataclass(frozen=True, eq=False)
class Way:
    """A free way."""

    points: tuple[Array, ...]
    """Configurations to go through in straight lines, the end among them, each (dof,)."""
    end: int
    """Which of the ends it is."""


@dataclass(frozen=True, eq=False)
class Price:
    """What ways to several ends are worth, in control steps."""

    after: Array
    """What it is worth to go on from each end, shape (n,)."""
    left: Array
    """In how many a way has to be at each end, shape (n,)."""

    def of(self, steps: Array | float, ends: int | slice = slice(None)) -> Array:
        """Of ways that take so many control steps, to all ends, shape (n,), or to one, ()."""
        late = np.maximum(steps - self.left[ends], 0)
        return steps + self.after[ends] + np.minimum(LATE * late, TOO_LATE)


class FreeWays:
    """Ways of one robot."""

    def __init__(
        self,
        space: FreeSpace,
        step: Array,
        rng: np.random.Generator,
        moves: NDArray[np.bool_] | None = None,
    ) -> None:
        """Draw stops.

        Args:
            space: What is free.
            step: Largest change of every joint in a control step, shape (dof,).
            rng: Where stops come from.
            moves: Which joints move, shape (dof,); by default all.
        """
        self._space, self._step = space, step
        robot = space.scene.robot
        self._moves = np.ones(robot.dof, dtype=np.bool_) if moves is None else moves
        self._home, self._bounds = np.array(robot.home), joint_limits(robot)
        self._seed = int(rng.integers(2**63))
        self._stops, _ = space.draw(STOPS * ATTEMPTS, rng)

    def steps(self, start: Array, ends: Array) -> Array:
        """Control steps that straight ways to ends (..., dof) take, shape (...,)."""
        return np.asarray((np.abs(ends - start) / self._step).max(axis=-1))

    def find(
        self,
        start: Array,
        ends: Array,
        *,
        vias: Array | None = None,
        price: Price | None = None,
        block: Array | None = None,
        attempt: int = 0,
    ) -> Way | None:
        """The free way that costs least, to one of several ends, by way of one stop at most.

        Args:
            start: Where it begins, shape (dof,).
            ends: Where it may end, shape (n, dof).
            vias: By way of which each end may also be reached, shape (n, dof).
            price: What ways are worth; by default the control steps that they take.
            block: Where the block is, shape (7,); nowhere without.
            attempt: Which stops there are: others for the next ``ATTEMPTS`` numbers.

        Returns:
            None if no way is free.
        """
        known: dict[bytes, float] = {}

        def free_part(a: Array, b: Array) -> float:
            key = a.tobytes() + b.tobytes()
            if key not in known:
                known[key] = self._free_part(a, b, block)
            return known[key]

        first = STOPS * (attempt % ATTEMPTS)
        drawn = np.array([self._home, *self._stops[first : first + STOPS]])
        drawn = unwrap_joints(self._space.scene.robot, start, drawn)
        stops = [np.where(self._moves, stop, start) for stop in drawn]
        price = price or Price(np.zeros(len(ends)), np.full(len(ends), np.inf))
        ways = self._ways(start, ends, vias, stops, price)
        for _, way in sorted(ways, key=lambda each: each[0]):
            if _all_free((start, *way.points), free_part):
                return way
        return None

    def find_round_about(self, start: Array, ends: Array, *, attempt: int = 0) -> Way | None:
        """Any free way to one of several ends; see ``connected``. Arguments as of ``find``."""
        free_part = partial(self._free_part, block=None)
        rng = np.random.default_rng([self._seed, attempt])
        found = connected(start, ends, self._within(start), self._step, free_part, rng)
        if found is None:
            return None
        return Way(found[1:], int(np.abs(ends - found[-1]).max(axis=1).argmin()))

    def explored(
        self, start: Array, times: int, *, block: Array | None = None, attempt: int = 0
    ) -> Tree:
        """A tree of configurations to which free ways lead, grown so many times."""
        free_part, within = partial(self._free_part, block=block), self._within(start)
        rng = np.random.default_rng([self._seed, attempt])
        return explored(start, within, self._step, free_part, rng, times)

    def reached(self, start: Array, count: int, *, attempt: int = 0) -> Array:
        """Configurations to which free ways lead without the block, shape (count, dof).

        They are drawn from a tree, maybe more than once.
        """
        nodes = np.array(self.explored(start, GROWN * count, attempt=attempt).nodes)
        return nodes[np.random.default_rng([self._seed, attempt]).integers(len(nodes), size=count)]

    def find_along(
        self, tree: Tree, ends: Array, *, vias: Array, price: Price, block: Array
    ) -> Way | None:
        """A free way along a tree to one of several ends.

        Arguments as of ``find``. Ends that cost less come first, how far they are from the tree
        counted, by way of a configuration of the tree each, and of the end's via if need be; of
        the first ``ALONG`` ways that are free it is the one that costs least.
        """
        near = [tree.nearest(end) for end in ends]
        far = self.steps(np.array([tree.nodes[i] for i in near]), ends) if near else price.after
        free_part = partial(self._free_part, block=block)
        found: list[tuple[float, Way]] = []
        for i in np.argsort(price.after + far, kind="stable").tolist():
            if len(found) == ALONG:
                break
            for last in ((ends[i],), (vias[i], ends[i])):
                if _all_free((tree.nodes[near[i]], *last), free_part):
                    points = [*tree.back(near[i])[::-1], *last]
                    rng = np.random.default_rng([self._seed, i])
                    way = Way(tuple(shortened(points, free_part, rng)[1:]), i)
                    found.append((float(price.of(self.length(points[0], way), i)), way))
                    break
        return min(found, key=lambda each: each[0])[1] if found else None

    def length(self, start: Array, way: Way) -> float:
        """Control steps that a way takes from a start, shape (dof,)."""
        points = np.array([start, *way.points])
        return float(self.steps(points[:-1], points[1:]).sum())

    def _within(self, start: Array) -> Array:
        """Bounds of the joints; those that do not move are where they are."""
        return np.where(self._moves[:, None], self._bounds, start[:, None])

    def _ways(
        self,
        start: Array,
        ends: Array,
        vias: Array | None,
        stops: Sequence[Array],
        price: Price,
    ) -> Iterator[tuple[float, Way]]:
        """All ways there may be, with what they cost."""
        for i, end in enumerate(ends):
            lasts = ((end,),) if vias is None else ((end,), (vias[i], end))
            for before in ((), *((stop,) for stop in stops)):
                for last in lasts:
                    way = Way((*before, *last), i)
                    yield float(price.of(self.length(start, way), i)), way

    def _free_part(self, start: Array, end: Array, block: Array | None) -> float:
        """Which part of the straight way between two configurations is free, from the start."""
        parts = max(math.ceil(np.abs(end - start).max() / STRIDE), 1) + 1
        way = start + np.linspace(0, 1, parts)[:, None] * (end - start)
        free = self._space.free(way, None if block is None else np.tile(block, (parts, 1)))
        return 1.0 if free.all() else max(int(free.argmin()) - 1, 0) / (parts - 1)


def _all_free(points: Sequence[Array], free_part: FreePart) -> bool:
    """Whether straight lines through configurations are free; from the end, where room is least."""
    return all(free_part(b, a) == 1 for a, b in zip(points[-2::-1], points[:0:-1], strict=True))


class Routes:
    """Ways that the robots of a batch follow, each a leg after the other."""

    def __init__(self, task: TaskBatch) -> None:
        """All stay where they are."""
        self._task = task
        self._points = task.targets[:, None].repeat(1, LEGS, 1)
        self._leg, self._last = torch.zeros(2, task.num_envs, dtype=torch.int64).to(task.device)
        self._rows = torch.arange(task.num_envs, device=task.device)

    def take(self, env: int, points: Sequence[Array]) -> None:
        """Begin a way through configurations, each (dof,)."""
        more = len(points) - self._points.shape[1]
        if more > 0:
            last = self._points[:, -1:].repeat(1, more, 1)
            self._points = torch.cat([self._points, last], dim=1)
        for i, q in enumerate(points):
            self._points[env, i, : len(q)] = torch.from_numpy(q)
        self._leg[env], self._last[env] = 0, len(points) - 1

    @property
    def wanted(self) -> torch.Tensor:
        """Where the leg of each robot ends, shape (n, J)."""
        points: torch.Tensor = self._points[self._rows, self._leg]
        return points

    def go_on(self) -> torch.Tensor:
        """Begin the next leg where one is at its end; where the last is, shape (n,), bool."""
        task = self._task
        step = task.robot_tables.max_step[task.env_robot_index].clamp(min=1e-9)
        done = ((self.wanted - task.targets) / step).abs().amax(dim=1) < NEAR
        final: torch.Tensor = done & (self._leg == self._last)
        self._leg = torch.where(done & ~final, self._leg + 1, self._leg)
        return final


def shares_to(task: TaskBatch, wanted: torch.Tensor) -> torch.Tensor:
    """Shares of the joints' steps, a number a link (n, L), that bring targets to others (n, J).

    All joints get there at once.
    """
    step = task.robot_tables.max_step[task.env_robot_index]
    ahead = wanted - task.targets
    shares = torch.where(step > 0, ahead / step.clamp(min=1e-9), torch.zeros_like(ahead))
    shares = shares / shares.abs().amax(dim=1, keepdim=True).clamp(min=1)
    joint = task.robot_tables.joint_of_link[task.env_robot_index]
    return torch.gather(shares, 1, joint.clamp(min=0)) * (joint >= 0)

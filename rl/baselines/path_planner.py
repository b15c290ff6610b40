"""Collision-free paths in joint space: straight lines, or RRT-Connect with shortcuts.

Distances between configurations are counted in control steps: the largest change of a joint,
divided by what that joint may change in one control step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.kinematics import joint_limits
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.free_space import RESOLUTION, FreeSpace
from morphgen.typing import Array

FreeFraction = Callable[[Array, Array], float]
"""Return the collision-free fraction of the line between two configurations, each (dof,)."""

ITERATIONS = 2500  # maximum number of random configurations of RRT-Connect
MIN_EDGE, MAX_EDGE = 1.0, 12.0  # length of a tree's edges [control steps]
SHORTCUTS = 60  # number of random pairs of waypoints that are tried as shortcuts of a path
COMPARED = 6  # number of free paths along a tree of which the cheapest is taken
LATE_COST, MAX_LATE_COST = 20.0, 400.0
"""Cost of each control step after the deadline, and the largest such cost [control steps]."""
ARRIVED = 1.01 * min(fraction for fraction in BINS if fraction > 0)
"""Distance from a waypoint that counts as arrived [control steps]: the smallest discrete action."""


@dataclass(frozen=True, eq=False)
class Path:
    """A path of straight lines to one of several goals."""

    waypoints: tuple[Array, ...]
    """Configurations to go through after the start, each (dof,); the last is the goal."""
    goal: int  # index of the goal


@dataclass(frozen=True, eq=False)
class PathCost:
    """Cost of paths to n goals, in control steps."""

    goal_cost: Array  # cost of the motion that follows at each goal, shape (n,)
    deadline: Array  # control steps within which a path should reach each goal, shape (n,)

    def of(self, length: Array | float, goal: int | slice = slice(None)) -> Array:
        """Return the cost of paths of a length [control steps] to all goals (n,), or to one ()."""
        late = np.maximum(length - self.deadline[goal], 0)
        return length + self.goal_cost[goal] + np.minimum(LATE_COST * late, MAX_LATE_COST)


class Tree:
    """Configurations that are connected to roots by collision-free straight lines."""

    def __init__(self, roots: Array, step: Array, free_fraction: FreeFraction) -> None:
        """Start with roots (n, dof); ``step`` is the largest change of joints in a control step."""
        self._step, self._free_fraction = step, free_fraction
        self._rows, self._parents = roots.copy(), [-1] * len(roots)

    @property
    def nodes(self) -> Array:
        """The configurations, shape (nodes, dof)."""
        return self._rows[: len(self._parents)]

    def _add(self, q: Array, parent: int) -> int:
        if len(self._parents) == len(self._rows):  # room for twice as many
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows), q[None]])
        self._rows[len(self._parents)] = q
        self._parents.append(parent)
        return len(self._parents) - 1

    def nearest(self, q: Array) -> int:
        """Return the index of the node from which q, shape (dof,), takes the fewest steps."""
        return int((np.abs(self.nodes - q) / self._step).max(axis=1).argmin())

    def extend(self, near: int, q: Array) -> int | None:
        """Add a node on the line from the node ``near`` to q, as far as the line is free.

        Returns its index, or None if the free part is shorter than ``MIN_EDGE``.
        """
        origin = self.nodes[near]
        length = float((np.abs(q - origin) / self._step).max())
        new = q if length <= MAX_EDGE else origin + (q - origin) * (MAX_EDGE / length)
        fraction = self._free_fraction(origin, new)
        if fraction * min(length, MAX_EDGE) < MIN_EDGE and fraction < 1:
            return None
        return self._add(new if fraction == 1 else origin + fraction * (new - origin), near)

    def connect(self, q: Array) -> int | None:
        """Extend the tree to q; return the index of q's node, None if q cannot be reached."""
        node: int | None = self.nearest(q)
        while node is not None and not np.array_equal(self.nodes[node], q):
            node = self.extend(node, q)
        return node

    def to_root(self, node: int) -> list[Array]:
        """Return the configurations from a node to its root."""
        path = []
        while node >= 0:
            path.append(self.nodes[node])
            node = self._parents[node]
        return path


def shortcut(
    path: list[Array], free_fraction: FreeFraction, rng: np.random.Generator
) -> list[Array]:
    """Return a path with straight lines between random pairs of its waypoints, where free."""
    for _ in range(SHORTCUTS):
        if len(path) < 3:
            break
        i, j = sorted(rng.choice(len(path), size=2, replace=False).tolist())
        if j > i + 1 and free_fraction(path[i], path[j]) == 1:
            path = [*path[: i + 1], *path[j:]]
    return path


class PathPlanner:
    """Plans paths of one robot; the same seed and arguments give the same path."""

    def __init__(
        self,
        space: FreeSpace,
        step: Array,
        seed: int,
        movable: NDArray[np.bool_] | None = None,
        resolution: float = RESOLUTION,
    ) -> None:
        """Set up the planner with the largest steps of the joints, and which may move, (dof,).

        Paths are tested at points that no joint moves more than ``resolution`` between.
        """
        self._resolution = resolution
        self.space, self._step, self._seed = space, step, seed
        self._limits = joint_limits(space.scene.robot)
        self._movable = np.ones(len(step), dtype=np.bool_) if movable is None else movable

    def steps(self, start: Array, ends: Array) -> Array:
        """Return the length of straight lines to ends (..., dof) [control steps], shape (...,)."""
        return np.asarray((np.abs(ends - start) / self._step).max(axis=-1))

    def length(self, start: Array, path: Path) -> float:
        """Return the length of a path from a start (dof,) [control steps]."""
        points = np.array([start, *path.waypoints])
        return float(self.steps(points[:-1], points[1:]).sum())

    def plan_straight(
        self,
        start: Array,
        goals: Array,
        *,
        vias: Array | None = None,
        cost: PathCost | None = None,
        block: Array | None = None,
        tree: Tree | None = None,
        limit: float = np.inf,
    ) -> Path | None:
        """Return the cheapest free path, straight to a goal or by way of its via; None without one.

        Start (dof,), goals (n, dof) and vias (n, dof) are configurations; the block has a pose (7,)
        if the scene has one. Paths that cost as much as the limit are not tried.
        """
        free_fraction = partial(self.space.free_fraction, block=block, resolution=self._resolution)
        cost = cost or PathCost(np.zeros(len(goals)), np.full(len(goals), np.inf))
        candidates: list[tuple[float, int, Path]] = []
        for i, goal in enumerate(goals):
            along = [] if tree is None else tree.to_root(tree.nearest(goal))[-2::-1]
            for last in ((goal,),) if vias is None else ((goal,), (vias[i], goal)):
                path = Path((*along, *last), i)
                candidates.append((float(cost.of(self.length(start, path), i)), len(last), path))
        free: list[tuple[float, Path]] = []
        for value, new, path in sorted(candidates, key=lambda candidate: candidate[0]):
            if value >= limit:
                break
            points = [start, *path.waypoints]
            # From the goal backwards: there the room is least. The tree's own lines are free.
            if any(free_fraction(a, b) < 1 for a, b in pairwise(points[: -new - 2 : -1])):
                continue
            if tree is None:
                return path
            shortened = shortcut(
                points, free_fraction, np.random.default_rng([self._seed, path.goal])
            )
            path = Path(tuple(shortened[1:]), path.goal)
            free.append((float(cost.of(self.length(start, path), path.goal)), path))
            if len(free) == COMPARED:
                break
        return min(free, key=lambda pair: pair[0])[1] if free else None

    def plan_rrt(
        self,
        start: Array,
        goals: Array,
        *,
        block: Array | None = None,
        attempt: int = 0,
        iterations: int = ITERATIONS,
    ) -> tuple[Path | None, Tree]:
        """Plan from a start (dof,) to any of n goals (n, dof); n may be 0.

        Two trees grow from the start and the goals until they meet (RRT-Connect, Kuffner and
        LaValle 2000); without goals, that of the start grows alone. Returns the shortened path,
        None if the trees did not meet; and the tree of the start, whose nodes can all be reached.
        """
        free_fraction = partial(self.space.free_fraction, block=block, resolution=self._resolution)
        rng = np.random.default_rng([self._seed, attempt])
        # Joints that may not move have limits without width.
        limits = np.where(self._movable[:, None], self._limits, start[:, None])
        start_tree = Tree(start[None], self._step, free_fraction)
        growing, other = start_tree, Tree(goals, self._step, free_fraction)
        for _ in range(iterations):
            sample = rng.uniform(limits[:, 0], limits[:, 1])
            new = growing.extend(growing.nearest(sample), sample)
            if not len(goals):
                continue
            met = None if new is None else other.connect(growing.nodes[new])
            if new is not None and met is not None:
                ends = growing.to_root(new), other.to_root(met)
                first, second = ends if growing is start_tree else ends[::-1]
                points = shortcut([*first[::-1], *second[1:]], free_fraction, rng)
                goal = int(np.abs(goals - points[-1]).max(axis=1).argmin())
                return Path(tuple(points[1:]), goal), start_tree
            growing, other = other, growing
        return None, start_tree


class PathFollower:
    """Waypoints that the robots of a batch go through, one after the other."""

    def __init__(self, task: TaskBatch) -> None:
        """Set each robot's current targets as its only waypoint."""
        self._task = task
        self._waypoints = task.targets[:, None].clone()
        self._index, self._last = torch.zeros(2, task.num_envs, dtype=torch.int64).to(task.device)
        self._envs = torch.arange(task.num_envs, device=task.device)

    def follow(self, env: int, waypoints: Sequence[Array]) -> None:
        """Start a path of waypoints (dof,) in one environment."""
        missing = max(len(waypoints) - self._waypoints.shape[1], 0)
        padding = self._waypoints[:, -1:].repeat(1, missing, 1)
        self._waypoints = torch.cat([self._waypoints, padding], dim=1)
        for i, q in enumerate(waypoints):
            self._waypoints[env, i, : len(q)] = torch.from_numpy(q)
        self._index[env], self._last[env] = 0, len(waypoints) - 1

    @property
    def waypoint(self) -> torch.Tensor:
        """Waypoint that each robot is going to, shape (n, J)."""
        waypoints: torch.Tensor = self._waypoints[self._envs, self._index]
        return waypoints

    def advance(self) -> torch.Tensor:
        """Switch arrived robots to their next waypoint; return who is at the last, (n,), bool."""
        task = self._task
        step = task.robot_tables.max_step[task.env_robot_index].clamp(min=1e-9)
        arrived = ((self.waypoint - task.targets) / step).abs().amax(dim=1) < ARRIVED
        finished: torch.Tensor = arrived & (self._index == self._last)
        self._index = torch.where(arrived & ~finished, self._index + 1, self._index)
        return finished


def fractions_towards(task: TaskBatch, targets: torch.Tensor) -> torch.Tensor:
    """Return actions (n, L) that move the joint targets in a straight line to others (n, J).

    They are fractions of the joints' largest steps, such that all joints arrive together.
    """
    return fractions_of(task, targets - task.targets)


def fractions_of(task: TaskBatch, change: torch.Tensor) -> torch.Tensor:
    """Return the actions (n, L) of ``fractions_towards`` by changes of the joint targets (n, J)."""
    step = task.robot_tables.max_step[task.env_robot_index]
    fractions = torch.where(step > 0, change / step.clamp(min=1e-9), torch.zeros_like(change))
    fractions = fractions / fractions.abs().amax(dim=1, keepdim=True).clamp(min=1)
    joint = task.robot_tables.joint_of_link[task.env_robot_index]
    return torch.gather(fractions, 1, joint.clamp(min=0)) * (joint >= 0)

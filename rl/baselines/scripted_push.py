"""The baseline ``scripted`` of push: follow a planned path behind the block, push, and steer.

A robot pushes its block along y, across a line. A *pre-contact* is a configuration with the tool
behind the block, from which the robot touches the block if it moves along y. It is found by moving
the block until both collide.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields
from typing import Any, Self, TypeAlias

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.dynamics import actuation
from morphgen.model.kinematics import MAX_STEP, frame_jacobian, solve_position_ik, unwrap_joints
from morphgen.model.kinematics_torch import frame_pose, frame_positions, pose_ik_step
from morphgen.rl.baselines.path_planner import (
    Path,
    PathCost,
    PathFollower,
    PathPlanner,
    Tree,
    fractions_towards,
)
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push.task import PushStartSet, sample_tools_in_box
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.tasks.sim.base import CONTROL_PERIOD, GRAVITY, Scene
from morphgen.tasks.task import EnvSpec
from morphgen.typing import Array

SPEED = 0.006  # largest motion of the tool in a control step while it pushes [m]: 0.3 m/s

# Lengths below are in edges of the block, costs in control steps; both were tuned on the robots of
# the shipped splits.
_DISTANCES = (0.1, 0.4, 0.8, 1.3)
"""Distances of the tool behind the block's hindmost point that are tried."""
_NEAREST, _QUICKEST = 24, 36
"""Starts of inverse kinematics per distance: those nearest in space, and nearest in joint space."""
_MIN_HEIGHT, _MAX_HEIGHT = 0.2, 0.45
"""Heights of the tool: pushed above its middle, a block with a friction of 1 tips over."""
_CANDIDATES = 24  # pre-contacts, the cheapest first, to which straight paths are tried
_SIMULATED_AT_ONCE = 48  # candidates that are simulated at once, those of several pushes together
_SIMULATED, _OVERHANG_EVERY = 12, 3
"""Number of points at which a push is tested; the overhang is tested at every third of them."""
_TOLERANCE = 0.02  # distance from a point that counts as reached
_NEARER, _FARTHER = 0.3, 0.4
"""In a simulated push, the robot must touch a block that is nearer by the one distance, and not
touch one that is farther by the other."""
_LIFT = 1.4  # height of the waypoint above a pre-contact, from which the tool comes down
_RETREAT_STEP, _RETREAT_STEPS = 0.15, 8
"""Motion of the tool in a step away from the block, and the largest number of such steps."""
_RETREAT_DIRECTIONS = (
    (0.0, -1.0, 0.0),
    (0.0, -0.7, 0.7),
    (0.0, 0.0, 1.0),
    (1.0, 0.0, 0.0),
    (-1.0, 0.0, 0.0),
)
_UNFINISHED_COST, _NARROW_COST = 400.0, 120.0
"""Cost of a push that does not move the block, and of a contact of width zero."""
_OVERHANG_COST, MAX_OVERHANG = 3000.0, 0.1
"""Cost per edge of overhang, and the overhang at which the cost is capped."""
_COMPLIANCE_COST = 3000.0  # cost per metre of the tool's deflection by the block's friction
_ACCELERATION_STEPS = 25  # time until arm and block have the speed of the push [control steps]
_EXPENSIVE, _TREE_ITERATIONS = 350.0, 1500
"""Cost of a plan above which a tree of reachable configurations is grown to find a cheaper one, and
the number of random configurations of that tree."""


@dataclass(frozen=True, eq=False)
class Plan:
    """A planned push: the path behind the block, and the pose of the tool during the push."""

    path: tuple[Array, ...]  # waypoints, each (dof,); at the last one the tool is behind the block
    rotation: torch.Tensor  # rotation of the tool at the last waypoint, shape (3, 3)
    height: float  # height of the tool at the last waypoint [m]
    offset: float
    """x of the tool minus x of the block with which the tool pushes the block's middle [m]."""
    gap: float  # motion of the tool along y until it touches the block [m]


@dataclass(frozen=True, eq=False)
class Push:
    """A push to plan."""

    q: Array  # configuration of the robot, shape (dof,)
    block: Array  # pose of the block, shape (7,)
    attempt: int = 0  # number of earlier plans in the episode
    steps_left: float = np.inf  # control steps until the time limit


@dataclass(frozen=True, eq=False)
class PreContact:
    """Configurations behind the block that touch it if they move along y; one per row."""

    row: NDArray[np.intp]  # indices of the configurations among the tested ones, shape (n,)
    q: Array  # configurations, shape (n, dof) [rad or m]
    block: Array  # poses of the block, shape (n, 7)
    gap: Array  # motion along y until the robot touches the block, shape (n,) [m]
    offset: Array
    """Offset of the block along x for which the contact is on its middle, shape (n,) [m]."""
    width: Array  # fraction of `OFFSETS` at which the block is touched, shape (n,)

    def take(self, rows: NDArray[np.intp]) -> Self:
        """Return some of the rows."""
        return type(self)(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True, eq=False)
class _Candidates(PreContact):
    """Pre-contacts from which a push may begin."""

    position: Array  # positions of the tool, shape (n, 3) [m]
    rotation: Array  # rotations of the tool, shape (n, 3, 3)
    compliance: Array  # deflection of the tool along y by the block's friction, shape (n,) [m]
    cost: Array
    """Cost of the push, shape (n,) [control steps]; inf if it fails, and a lower bound until it was
    simulated."""
    is_simulated: NDArray[np.bool_]  # whether the push was simulated, shape (n,)
    via: Array  # configurations with the tool above, of those that were simulated, shape (n, dof)


Found: TypeAlias = tuple[float, Path, _Candidates]
"""Cost of a path and the push behind it, the path, and the candidates that it is to one of."""


class ToolKinematics:
    """Kinematics of the tool of one robot of a batch, in NumPy arrays."""

    def __init__(self, tables: RobotTables, robot: int) -> None:
        self._tables, self._robot = tables, robot
        self._dof = tables.robots[robot].dof

    def poses(self, q: Array) -> tuple[Array, Array]:
        """Return positions (n, 3) and rotations (n, 3, 3) of the tool at q (n, dof)."""
        T = frame_pose(self._tables.tool_chain, *self._rows(q)).double().cpu().numpy()
        return T[:, :3, 3], T[:, :3, :3]

    def move_towards(self, q: Array, position: Array, rotation: Array, iterations: int) -> Array:
        """Return q (n, dof) after iterations of ``pose_ik_step`` to poses (n, 3), (n, 3, 3)."""
        robots, rows = self._rows(q)
        goals = torch.from_numpy(position).to(rows)
        rotations = torch.from_numpy(rotation).to(rows)
        limits = self._tables.lower[robots], self._tables.upper[robots]
        for _ in range(iterations):
            target = pose_ik_step(self._tables.tool_chain, robots, rows, goals, rotations, limits)
            rows = rows + (target - rows).clamp(-MAX_STEP, MAX_STEP)
        return rows[:, : self._dof].double().cpu().numpy()

    def _rows(self, q: Array) -> tuple[torch.Tensor, torch.Tensor]:
        """Return robot indices (n,) and configurations padded to the batch's joints, (n, J)."""
        device = self._tables.device
        rows = torch.zeros(len(q), self._tables.max_joints, device=device)
        rows[:, : self._dof] = torch.from_numpy(q).to(rows)
        return torch.full((len(q),), self._robot, device=device), rows


class PushPlanner:
    """Plans pushes of one robot and its block."""

    def __init__(
        self, spec: EnvSpec, scene: Scene, tables: RobotTables, robot: int, rng: np.random.Generator
    ) -> None:
        """Collect free configurations with a low tool in the region of the push."""
        starts, self._robot = spec.goals, spec.robot
        assert isinstance(starts, PushStartSet)
        self._tool = ToolKinematics(tables, robot)
        self._edge, self._line, self._ground = starts.block.size[0], starts.line, starts.ground
        self._friction = starts.block.friction * starts.block.mass * GRAVITY
        self._stiffness = np.array([gain.stiffness for gain in actuation(self._robot)])
        self._idle = ~tables.moves_tool[robot, : self._robot.dof].cpu().numpy()
        self._space = FreeSpace(scene)
        step = tables.max_step[robot, : self._robot.dof].double().cpu().numpy()
        self._planner = PathPlanner(self._space, step, int(rng.integers(2**63)))
        edge, first, last = self._edge, starts.blocks.min(axis=0), starts.blocks.max(axis=0)
        low = np.array([first[0] - edge, first[1] - 2.5 * edge, self._ground])
        high = np.array([last[0] + edge, self._line + edge, self._ground + 1.5 * edge])
        self._bank, self._bank_tools = sample_tools_in_box(self._space, low, high, rng)

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Return whether configurations (n, dof) are free of collisions without the block, (n,)."""
        return self._space.free(q)

    def plan(self, pushes: Sequence[Push]) -> list[Plan | None]:
        """Return the cheapest plan of each push.

        It is None if there is no plan, or too little time to push the block across the line.
        """
        plans: list[Plan | None] = [None] * len(pushes)
        in_time = [
            i
            for i, push in enumerate(pushes)
            if push.steps_left >= (self._line - push.block[1]) / SPEED
        ]
        starts = [self._retreat(pushes[i].q, pushes[i].block) for i in in_time]
        straight = self._plan_straight([pushes[i] for i in in_time], starts) if in_time else []
        for i, start, option in zip(in_time, starts, straight, strict=True):
            options = [option]
            if option is None or option[0] > _EXPENSIVE:
                options.append(self._plan_along_tree(pushes[i], start))
            valid = [each for each in options if each is not None]
            if valid:
                _, path, candidates = min(valid, key=lambda each: each[0])
                if start is not pushes[i].q:
                    path = Path((start, *path.waypoints), path.goal)
                plans[i] = self._chosen(path, candidates)
        return plans

    def _plan_straight(self, pushes: Sequence[Push], starts: Sequence[Array]) -> list[Found | None]:
        """Return the cheapest straight path of each push, if any.

        Pushes are simulated in the order of the lower bounds of their costs, until no other can be
        cheaper than the path.
        """
        results: list[Found | None] = [None] * len(pushes)
        candidates, push_of = self._candidates_near(pushes)
        pending = [*range(len(pushes))]
        while pending:
            to_simulate = []
            at_once = -(-_SIMULATED_AT_ONCE // len(pending))
            for i in [*pending]:
                rows = np.flatnonzero((push_of == i) & np.isfinite(candidates.cost))
                cost = self._path_cost(pushes[i], candidates.take(rows))
                values = cost.of(self._planner.steps(starts[i], candidates.q[rows]))
                order = np.argsort(values, kind="stable")[:_CANDIDATES]
                is_simulated = candidates.is_simulated[rows[order]]
                others = order[~is_simulated]
                results[i] = self._cheapest(
                    pushes[i],
                    starts[i],
                    candidates.take(rows[order[is_simulated]]),
                    limit=values[others[0]] if len(others) else np.inf,
                )
                if results[i] is None and len(others):
                    to_simulate.append(rows[others[:at_once]])
                else:
                    pending.remove(i)
            if to_simulate:
                self._simulate(candidates, np.concatenate(to_simulate))
        return results

    def _plan_along_tree(self, push: Push, start: Array) -> Found | None:
        """Return the cheapest path along a tree of reachable configurations, if any."""
        # Self-collisions may divide free space: the pre-contacts are near the tree.
        no_goals = np.zeros((0, len(start)))
        _, tree = self._planner.plan_rrt(
            start, no_goals, block=push.block, attempt=push.attempt, iterations=_TREE_ITERATIONS
        )
        nodes = np.array(tree.nodes)
        tools, _ = self._tool.poses(nodes)
        starts, goals = self._behind(nodes, tools, push.block, np.zeros(0, dtype=np.intp))
        q, _ = self._solve(starts, goals, np.tile(push.block, (len(starts), 1)))
        candidates = self._candidates(q, np.tile(push.block, (len(q), 1)))
        self._simulate(candidates, np.arange(len(candidates.q)))
        candidates = candidates.take(np.flatnonzero(np.isfinite(candidates.cost)))
        return self._cheapest(push, start, candidates, tree=tree)

    def _path_cost(self, push: Push, candidates: _Candidates) -> PathCost:
        """Return the cost of paths to candidates."""
        steps = (candidates.gap + self._line - push.block[1]) / SPEED + _ACCELERATION_STEPS
        return PathCost(candidates.cost, push.steps_left - steps)

    def _cheapest(
        self,
        push: Push,
        start: Array,
        candidates: _Candidates,
        *,
        tree: Tree | None = None,
        limit: float = np.inf,
    ) -> Found | None:
        """Return the cheapest free path to candidates, if any costs less than the limit."""
        cost = self._path_cost(push, candidates)
        path = self._planner.plan_straight(
            start,
            candidates.q,
            vias=candidates.via,
            cost=cost,
            block=push.block,
            tree=tree,
            limit=limit,
        )
        if path is None:
            return None
        value = float(cost.of(self._planner.length(start, path), path.goal))
        return value, path, candidates

    def _chosen(self, path: Path, candidates: _Candidates) -> Plan:
        """Return the plan of a path to one of the candidates."""
        i = path.goal
        x, _, height = candidates.position[i].tolist()
        return Plan(
            path=path.waypoints,
            rotation=torch.from_numpy(candidates.rotation[i]).float(),
            height=height,
            offset=float(x - candidates.block[i, 0] - candidates.offset[i]),
            gap=float(candidates.gap[i]),
        )

    def _candidates_near(self, pushes: Sequence[Push]) -> tuple[_Candidates, NDArray[np.intp]]:
        """Return candidates from random free configurations, and the index of each push (n,)."""
        parts = []
        for push in pushes:
            bank = unwrap_joints(self._robot, push.q, self._bank)
            quickest = np.argsort(self._planner.steps(push.q, bank), kind="stable")[:_QUICKEST]
            starts, goals = self._behind(bank, self._bank_tools, push.block, quickest)
            starts[::2, self._idle] = push.q[self._idle]
            starts[1::2, self._idle] = np.array(self._robot.home)[self._idle]
            parts.append((starts, goals))
        starts, goals = (np.concatenate(each) for each in zip(*parts, strict=True))
        push_of = np.repeat(np.arange(len(pushes)), [len(each) for each, _ in parts])
        blocks = np.array([push.block for push in pushes])
        q, rows = self._solve(starts, goals, blocks[push_of])
        push_of = push_of[rows]
        now = np.array([push.q for push in pushes])[push_of]
        candidates = self._candidates(unwrap_joints(self._robot, now, q), blocks[push_of])
        return candidates, push_of[candidates.row]

    def _behind(
        self, q: Array, tools: Array, block: Array, also: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Return starts of inverse kinematics (n, dof) and goals behind the block (n, 3).

        Starts are those of k configurations q whose tools (k, 3) are near, and the rows ``also``.
        """
        edge, yaw = self._edge, 2 * np.arctan2(block[6], block[3])
        hindmost = block[1] - edge / 2 * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
        starts, goals = [], []
        for distance in _DISTANCES:
            xy = np.array([block[0], hindmost - distance * edge])
            apart = np.linalg.norm(tools[:, :2] - xy, axis=1)
            apart += np.maximum(tools[:, 2] - self._ground - edge, 0)
            near = np.concatenate([np.argsort(apart, kind="stable")[:_NEAREST], also])
            height = np.clip(tools[near, 2] - self._ground, _MIN_HEIGHT * edge, _MAX_HEIGHT * edge)
            goals.append(np.column_stack([np.tile(xy, (len(near), 1)), self._ground + height]))
            starts.append(q[near])
        return np.concatenate(starts), np.concatenate(goals)

    def _solve(self, starts: Array, goals: Array, blocks: Array) -> tuple[Array, NDArray[np.intp]]:
        """Return the collision-free solutions (k, dof) for goals of the tool (n, 3), k <= n.

        The second result is their rows among the goals, shape (k,).
        """
        q, error = solve_position_ik(self._robot, starts, goals)
        good = (np.abs(error[:, :2]) < _TOLERANCE * self._edge).all(axis=1)
        good &= np.abs(error[:, 2]) < self._edge / 2
        good[good] = self._space.free(q[good], blocks[good])
        return q[good], np.flatnonzero(good)

    def _candidates(self, q: Array, blocks: Array) -> _Candidates:
        """Return those configurations behind their blocks (n, dof) that touch them along y."""
        contacts = find_contacts(self._space, q, blocks, self._edge)
        position, rotation = self._tool.poses(contacts.q)
        _, J = frame_jacobian(self._robot, contacts.q)
        compliance = self._friction * (J[:, 1] ** 2 / self._stiffness).sum(axis=1)
        candidates = _Candidates(
            **vars(contacts),
            position=position,
            rotation=rotation,
            compliance=compliance,
            cost=np.zeros(len(position)),
            is_simulated=np.zeros(len(position), dtype=np.bool_),
            via=contacts.q.copy(),
        )
        candidates.cost[:] = _push_cost(candidates, np.ones(len(position)), np.zeros(len(position)))
        return candidates

    def _simulate(self, candidates: _Candidates, chosen: NDArray[np.intp]) -> None:
        """Simulate the pushes of some candidates, without dynamics, for their costs.

        At each point the arm must be free of collisions, and stay in contact: it must touch a block
        slightly nearer than the pushed one, and not touch one slightly farther.
        """
        each, edge = candidates.take(chosen), self._edge
        q, block, gap = each.q, each.block, each.gap
        length = gap + self._line - block[:, 1] + 0.1 * edge
        good, finished = np.ones(len(q), dtype=np.bool_), np.zeros(len(q))
        centred = block.copy()
        centred[:, 0] += each.offset
        over = overhang(self._space, q, centred, edge)
        goal = each.position.copy()
        # In this order: plans, and the data sets of them, depend on the last bits.
        goal[:, 0] = block[:, 0] + (each.position[:, 0] - block[:, 0] - each.offset)
        for i in range(1, _SIMULATED + 1):
            ahead = length * i / _SIMULATED
            goal[:, 1] = each.position[:, 1] + ahead
            q = self._tool.move_towards(q, goal, each.rotation, 4)
            error = np.abs(self._tool.poses(q)[0][:, :2] - goal[:, :2]).max(axis=1)
            good &= error < _TOLERANCE * edge + 0.002
            good[good] = self._space.free(q[good])
            moved = np.maximum(ahead - gap, 0)
            touching = np.flatnonzero(good & (ahead >= gap))
            shifts = moved[touching, None] + np.array([-_NEARER, _FARTHER]) * edge
            nearer, farther = touches(
                self._space, q[touching], block[touching], np.zeros(1), shifts
            ).T
            good[touching] = nearer & ~farther
            finished[good] = i / _SIMULATED
            if i % _OVERHANG_EVERY == 0:
                rows = np.flatnonzero(good & (over < MAX_OVERHANG))
                ahead_of = block[rows]
                ahead_of[:, 1] += moved[rows] + _FARTHER * edge
                over[rows] = np.maximum(over[rows], overhang(self._space, q[rows], ahead_of, edge))
        begun = finished * length > gap + 0.1 * edge
        cost = _push_cost(each, finished, over)
        candidates.cost[chosen] = np.where(begun, cost, np.inf)
        candidates.is_simulated[chosen] = True
        candidates.via[chosen] = self._lift(each)

    def _lift(self, candidates: _Candidates) -> Array:
        """Return configurations (n, dof) with the tool above the candidates, if possible."""
        goal, q = candidates.position.copy(), candidates.q
        for _ in range(5):
            goal[:, 2] += _LIFT * self._edge / 5
            q = self._tool.move_towards(q, goal, candidates.rotation, 3)
        return q

    def _retreat(self, q: Array, block: Array) -> Array:
        """Return q if it is free of the block, else a free one near it, else q."""
        if self._space.free(q[None], block[None])[0]:
            return q
        position, rotation = self._tool.poses(q[None])
        for direction in _RETREAT_DIRECTIONS:
            goal, retreated = position.copy(), q[None]
            for _ in range(_RETREAT_STEPS):
                goal += _RETREAT_STEP * self._edge * np.array(direction)
                retreated = self._tool.move_towards(retreated, goal, rotation, 3)
                if self._space.free(retreated, block[None])[0]:
                    return np.asarray(retreated[0])
        return q


# Lengths of the next constants are in edges of the block.
SHIFTS = np.arange(0.05, 2.0, 0.1)
"""Distances that the block is moved towards the robot to find their contact."""
BISECTIONS = 5  # bisections of the interval between two of these shifts
OFFSETS = np.linspace(-1.0, 1.0, 9)
"""Offsets of the block along x at which the width of the contact is tested."""
BELOW, ABOVE = -0.5, 0.15
"""Shifts of the block along z: a block lowered by half an edge is touched only below its middle; a
raised one also slightly above it."""
PRESSED = 0.1  # distance that the block is pressed against the robot when the width is tested


def _push_cost(candidates: _Candidates, finished: Array, over: Array) -> Array:
    """Return the cost of pushes (n,) by the fraction that they finish and their overhang, (n,)."""
    cost = _UNFINISHED_COST * (1 - finished) + _NARROW_COST * (1 - candidates.width)
    cost += _OVERHANG_COST * over + candidates.gap / SPEED
    return np.asarray(cost + _COMPLIANCE_COST * candidates.compliance)


def find_contacts(space: FreeSpace, q: Array, blocks: Array, edge: float) -> PreContact:
    """Return those configurations (n, dof), free of blocks (n, 7), that touch these along y."""
    first, rows = np.full(len(q), len(SHIFTS)), np.arange(len(q))
    for k, shift in enumerate(SHIFTS * edge):
        hit = touches(space, q[rows], blocks[rows], np.zeros(1), np.array([-shift]))[:, 0]
        first[rows[hit]], rows = k, rows[~hit]
    row = np.flatnonzero(first < len(SHIFTS))
    q, blocks = q[row], blocks[row]
    gap = _gaps(space, q, blocks, edge, first[row])
    pressed = (gap + PRESSED * edge)[:, None]
    touched = touches(space, q, blocks, OFFSETS * edge, -pressed)
    count = np.maximum(touched.sum(axis=1), 1)
    offset = (touched * OFFSETS).sum(axis=1) / count * edge
    return PreContact(row, q, blocks, gap, offset, count / len(OFFSETS))


def overhang(space: FreeSpace, q: Array, blocks: Array, edge: float) -> Array:
    """Return the overhang of a robot over the block that it touches if it moves along y.

    It is the lead along y with which the robot touches the block (n, 7) above its middle before it
    touches it below, shape (n,), 0 to `MAX_OVERHANG` edges. With overhang, a push presses the block
    to the ground or tips it over. The configurations (n, dof) are free of the block.
    """
    below, above = np.full((2, len(q)), len(SHIFTS))
    rows = np.arange(len(q))
    for k, shift in enumerate(SHIFTS * edge):
        for touched, dz in ((above, ABOVE), (below, BELOW)):
            new = rows[touched[rows] > k]
            hit = touches(space, q[new], blocks[new], np.zeros(1), np.array([-shift]), dz * edge)
            touched[new[hit[:, 0]]] = k
        # Below first: no overhang. Above first by more than a shift: the largest overhang.
        rows = rows[(below[rows] > k) & (above[rows] >= k)]
    lead = np.where(below - above > 1, MAX_OVERHANG, 0.0)
    close = np.flatnonzero((below - above == 0) | (below - above == 1))
    ends = [
        _gaps(space, q[close], blocks[close], edge, touched[close], dz * edge)
        for touched, dz in ((below, BELOW), (above, ABOVE))
    ]
    lead[close] = np.clip((ends[0] - ends[1]) / edge, 0.0, MAX_OVERHANG)
    return lead


def touches(
    space: FreeSpace, q: Array, block: Array, dx: Array, dy: Array, dz: float = 0.0
) -> NDArray[np.bool_]:
    """Return whether configurations (n, dof) touch the shifted block, (7,) or (n, 7), shape (n, k).

    ``dx`` and ``dy`` are shifts that broadcast to (n, k), ``dz`` is one for all [m].
    """
    n, k = len(q), max(dx.shape[-1], dy.shape[-1])
    blocks = np.broadcast_to(block.reshape(-1, 1, 7), (n, k, 7)).copy()
    blocks[..., 0] += dx
    blocks[..., 1] += dy
    blocks[..., 2] += dz
    free = space.free(np.repeat(q, k, axis=0), blocks.reshape(-1, 7))
    return ~free.reshape(n, k)


def _gaps(
    space: FreeSpace, q: Array, blocks: Array, edge: float, first: NDArray[np.intp], dz: float = 0.0
) -> Array:
    """Return how far blocks (n, 7), shifted by ``dz``, are along y from the robot, (n,) [m].

    ``first`` is the first of ``SHIFTS`` that touches, (n,); without any, the gap is the largest.
    """
    shifts = np.array([0.0, *SHIFTS, SHIFTS[-1]]) * edge
    low, high = shifts[first], shifts[first + 1]
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        hit = touches(space, q, blocks, np.zeros(1), -middle[:, None], dz)[:, 0]
        low, high = np.where(hit, low, middle), np.where(hit, middle, high)
    return high


MAX_PLANS = 8  # maximum number of plans per episode
MAX_FAILED = 2
"""Number of plans of an episode at drawer, door or dial that may find no path: each takes seconds,
and after two, none was seen to find one."""
GAIN = 0.2
"""Fraction of the lateral error between tool and block that is corrected in a control step."""
LEAD, LEAD_STEP, MAX_LEAD = 0.05, 0.004, 0.3
"""Lead of the commanded tool before the actual one: initial value, growth per control step in which
the block does not move, and maximum [m]. A slender arm needs it to build up force."""
MOVING = 0.03  # speed of the block from which it counts as moving [m/s]
ARRIVED, SETTLE_STEPS = 0.02, 15
"""A push begins when the joints are ``ARRIVED`` from their targets [rad or m], or ``SETTLE_STEPS``
control steps after the last waypoint."""
PATIENCE = 40
"""Time in which the block must move by ``PROGRESS``; else a new plan is made [control steps]."""
PROGRESS = MOVING * PATIENCE * CONTROL_PERIOD
"""Distance that the block must move within ``PATIENCE`` [m]."""
LOST, ASTRAY = 0.7, 1.5
"""Lateral distances that lead to a new plan: of the tool from the block, and of the block from its
position at the start of the push [edges of the block]."""
MIN_PUSH_STEPS = 10
"""Time of a push before its block can count as lost or its arm as stuck [control steps]."""
RISE = 0.003
"""Rise of the tool in a control step in which the arm collides with anything but the block [m]."""


class ScriptedController(ABC):
    """Follows a planned path behind an object, moves the object in closed loop, and plans again.

    Environments of other tasks stand still.

    Attributes:
        pushing: Whether the path of the plan is done, and the tool pushes, shape (n,), bool.
    """

    def __init__(self, seed: int) -> None:
        """Set up; plans depend on the seed, the robot, its starts and the state of the episode."""
        self._seed = seed
        self._specs: Sequence[EnvSpec] = ()
        self._planners: dict[tuple[int, int], Any] = {}
        self._task: TaskBatch | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return a step along the path behind the object, or of the push; shape (n, L)."""
        if self._specs is not task.specs:
            self._specs, self._planners = task.specs, {}
        if self._task is not task:
            self._begin(task)
        ours = self._ours & ~task.is_idle
        self._active &= ours
        new = ours & (task.episode_step == 0)
        self._num_plans[new], self._num_failed[new] = 0, 0
        failed = self._advance(task) | (ours & ~self._active)
        left = (self._num_plans < MAX_PLANS) & (self._num_failed < MAX_FAILED)
        self.pushing &= ~new
        for key, envs in envs_by_planner(task, new | (failed & left)):
            self._plan(task, key, envs)
        targets = torch.where(self.pushing[:, None], self._push(task), self._follower.waypoint)
        targets = torch.where(self._active[:, None], targets, task.targets)
        return encode_actions(fractions_towards(task, targets), task.action_kind)

    def _begin(self, task: TaskBatch) -> None:
        """Allocate the state of a batch: a row per environment, without plans."""
        self._task, self._follower = task, PathFollower(task)
        n, device = task.num_envs, task.device
        # Environments with such an object; those with an active plan.
        self._ours, self._active, self.pushing = torch.zeros(3, n, dtype=torch.bool, device=device)
        # Plans in the episode, and those without a path; control steps since the end of the path,
        # and since the object made progress.
        self._num_plans, self._num_failed, self._settling, self._still = torch.zeros(
            4, n, dtype=torch.int64, device=device
        )

    @abstractmethod
    def _advance(self, task: TaskBatch) -> torch.Tensor:
        """Go on along the plans; return where pushes failed, (n,), bool."""

    @abstractmethod
    def _plan(self, task: TaskBatch, key: tuple[int, int], envs: Sequence[int]) -> None:
        """Make plans in environments of a robot and layout."""

    @abstractmethod
    def _push(self, task: TaskBatch) -> torch.Tensor:
        """Return the targets of joints that push, shape (n, J)."""

    def _follow_paths(self, task: TaskBatch) -> None:
        """Switch to the next waypoints, and to pushing where joints have arrived at the last."""
        at_end = self._active & ~self.pushing & self._follower.advance()
        self._settling = torch.where(at_end, self._settling + 1, self._settling)
        arrived = (task.q - task.targets).abs().amax(dim=1) < ARRIVED
        self.pushing = self.pushing | (at_end & (arrived | (self._settling > SETTLE_STEPS)))


class ScriptedPush(ScriptedController):
    """Moves behind the block, pushes it along y, and plans again where that fails.

    ``PushPlanner`` plans from collision tests and kinematics alone. The push is closed-loop: the
    tool moves along y with a constant rotation, follows the block along x, and rises where the arm
    has no room.
    """

    def _begin(self, task: TaskBatch) -> None:
        super()._begin(task)
        self._ours = task.task_mask("push")
        n, device = task.num_envs, task.device
        starts = [task.specs[i].goals for i in task.env_robot_index.tolist()]
        edges = [
            start.block.size[0] if isinstance(start, PushStartSet) else 1.0 for start in starts
        ]
        self._edge = torch.tensor(edges, device=device)
        self._stuck = torch.zeros_like(self._still)  # steps in which the arm could not move on
        # The farthest y of the block; its x before the push; how far the commanded tool may lead;
        # height, offset and gap of the plan.
        self._best, self._begun, self._lead, self._height, self._offset, self._gap = torch.zeros(
            6, n, device=device
        )
        self._rotation = torch.zeros(n, 3, 3, device=device)

    def _plan(self, task: TaskBatch, key: tuple[int, int], envs: Sequence[int]) -> None:
        robot, block = key[0], task.simulation.object_pose
        if key not in self._planners:
            rng = np.random.default_rng([self._seed, robot])
            scene = task.layouts.scene(envs[0])
            self._planners[key] = PushPlanner(
                task.specs[robot], scene, task.robot_tables, robot, rng
            )
        dof = task.specs[robot].robot.dof
        pushes = [
            Push(
                q=task.targets[env, :dof].double().cpu().numpy(),
                block=block[env].double().cpu().numpy(),
                attempt=int(self._num_plans[env]),
                steps_left=int(task.max_episode_steps[env] - task.episode_step[env]),
            )
            for env in envs
        ]
        self._num_plans[envs] += 1
        self._active[envs] = self.pushing[envs] = False
        for env, plan in zip(envs, self._planners[key].plan(pushes), strict=True):
            if plan is None:
                continue
            self._follower.follow(env, plan.path)
            self._active[env] = True
            self._rotation[env], self._height[env] = plan.rotation, plan.height
            self._offset[env], self._gap[env] = plan.offset, plan.gap
            self._begun[env], self._best[env], self._lead[env] = *block[env, :2], LEAD
            self._settling[env], self._still[env], self._stuck[env] = 0, 0, 0

    def _advance(self, task: TaskBatch) -> torch.Tensor:
        block = task.simulation.object_pose
        self._tool = tool = _tools(task, task.q)
        self._follow_paths(task)
        progress = block[:, 1] > self._best + PROGRESS
        self._best = torch.where(progress, block[:, 1], self._best)
        self._still = torch.where(progress | ~self.pushing, 0, self._still + 1)
        error = (tool[:, 0] - block[:, 0] - self._offset).abs()
        lost = (error > LOST * self._edge) & (self._still > MIN_PUSH_STEPS)
        slow = self._still > PATIENCE + self._gap / SPEED
        astray = (block[:, 0] - self._begun).abs() > ASTRAY * self._edge
        failed = slow | lost | astray | (self._stuck > MIN_PUSH_STEPS)
        failing: torch.Tensor = failed & self._active & self.pushing
        return failing

    def _blocked(self, task: TaskBatch) -> torch.Tensor:
        """Return where a pushing arm's targets collide with anything but the block, (n,), bool."""
        blocked = torch.zeros_like(self._active)
        for key, envs in envs_by_planner(task, self._active & self.pushing):
            q = task.targets[envs, : task.specs[key[0]].robot.dof].double().cpu().numpy()
            free = self._planners[key].free(q)
            blocked[envs] = ~torch.from_numpy(free).to(blocked.device)
        return blocked

    def _push(self, task: TaskBatch) -> torch.Tensor:
        """Return targets (n, J) with the tool farther along y, and nearer to the block along x."""
        self._height += torch.where(self._blocked(task), RISE, 0.0)
        block, tool, goal = task.simulation.object_pose, self._tool, _tools(task, task.targets)
        tables, robots = task.robot_tables, task.env_robot_index
        lead = goal[:, 1] - tool[:, 1]
        stands = task.simulation.object_velocity[:, 1] < MOVING
        grow = self.pushing & stands & (lead > self._lead - SPEED)
        self._lead = torch.where(grow, self._lead + LEAD_STEP, self._lead).clamp(max=MAX_LEAD)
        dx = GAIN * (block[:, 0] + self._offset - tool[:, 0])
        dy = torch.where(lead < self._lead, SPEED, 0.0)
        goal += torch.stack([dx.clamp(-SPEED, SPEED), dy, torch.zeros_like(dy)], dim=1)
        goal[:, 2] = self._height
        targets = pose_ik_step(
            tables.tool_chain,
            robots,
            task.targets,
            goal,
            self._rotation,
            (tables.lower[robots], tables.upper[robots]),
            rotation_budget=tables.max_step[robots],
        )
        short = goal[:, 1] - _tools(task, targets)[:, 1]
        stuck = self.pushing & (dy > 0) & (short > 0.8 * SPEED)
        self._stuck = torch.where(stuck, self._stuck + 1, 0)
        return targets


def _tools(task: TaskBatch, q: torch.Tensor) -> torch.Tensor:
    """Return the positions of the tools (n, 3) at joint positions (n, J)."""
    return frame_positions(task.robot_tables.tool_chain, task.env_robot_index, q)


def envs_by_planner(
    task: TaskBatch, mask: torch.Tensor
) -> Iterable[tuple[tuple[int, int], list[int]]]:
    """Return the environments of a mask (n,) by the indices of their robot and layout."""
    envs_of = defaultdict[tuple[int, int], list[int]](list)
    for env in torch.nonzero(mask)[:, 0].tolist():
        key = int(task.env_robot_index[env]), int(task.layouts.current[env])
        envs_of[key].append(env)
    return envs_of.items()

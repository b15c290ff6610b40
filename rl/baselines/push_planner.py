"""Plans of a push: a configuration behind the block, a free way there, and how to go on."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.dynamics import actuation
from morphgen.model.inverse_kinematics import solve_position_ik
from morphgen.model.kinematics import frame_jacobian, unwrap_joints
from morphgen.rl.baselines.cartesian import OneTool
from morphgen.rl.baselines.path_planner import FreeWays, Price, Way
from morphgen.rl.baselines.push_contacts import Poised, leaning, poised, touches
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push.feasibility import sample_tools_in_box
from morphgen.tasks.push.starts import PushStartSet
from morphgen.tasks.robot_tables import RobotTables
from morphgen.tasks.sim.base import GRAVITY
from morphgen.tasks.task import EnvSpec
from morphgen.typing import Array

SPEED = 0.006
"""Largest way of the tool in a control step while it pushes, metres: 0.3 m/s."""

_BEHIND = (0.1, 0.4, 0.8, 1.3)
"""Distances of the tool behind the block's hindmost point that are tried, in its edges."""
_NEAREST, _QUICKEST = 24, 36
"""Configurations from which each of them is tried: where the tool is near it, and those to which
the joints get soonest."""
_LOW, _HIGH = 0.2, 0.45
"""Heights of the tool that are aimed at, in edges: pushed above its middle, a block with a friction
of 1 tips over."""
_KEPT = 24
"""Configurations behind the block to which simple ways are looked for."""
_POINTS, _LOOKED = 12, 3
"""Of a push, at which it is tried out, and every how many of them it is looked how far it leans."""
_REACHED = 0.02
"""Distance from a point that counts as there, in edges."""
_TOLERANCE = (0.3, 0.4)
"""How much nearer the block has to touch, and how much farther be free, further on; in edges."""
_LIFT = 1.4
"""How far above its place the tool comes down, in edges."""
_PARTING = 0.15, 8
"""Way of the tool in a step away from the block, in edges, and how many steps there may be."""
_AWAY = ((0.0, -1.0, 0.0), (0.0, -0.7, 0.7), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0))
_UNFINISHED, _NARROW = 400.0, 120.0
"""Control steps that it is worth to get all the way, and on a broad front."""
_OVER, _MOST = 3000.0, 0.1
"""Control steps that an edge is worth by which the robot leans over the block, and edges from which
more of it is no worse."""
_SOFT = 3000.0
"""Control steps that a metre is worth by which the tool gives way to the block's friction."""
_SETTLED = 25
"""Control steps that a push takes besides those of its way, until arm and block are at speed."""
_DEAR, _GROWN = 350.0, 1500
"""Control steps that a plan takes, or is worth, from which a tree is grown for others, and how many
times it is."""


@dataclass(frozen=True, eq=False)
class _Ends:
    """Configurations behind the block from which a push begins, a row each."""

    q: Array
    """Shape (n, dof)."""
    position: Array
    """Of the tool, shape (n, 3), metres."""
    rotation: Array
    """Of the tool, shape (n, 3, 3)."""
    aside: Array
    """x of the tool less x of the block when it pushes, shape (n,), metres."""
    gap: Array
    """How far the tool goes until it touches, shape (n,), metres."""
    cost: Array
    """What a push from there is worth, in control steps, shape (n,)."""
    steps: Array
    """Control steps that it takes, shape (n,)."""

    def price(self, left: float) -> Price:
        """Of ways to them, if the push is to be over in so many control steps."""
        return Price(self.cost, left - self.steps)

    def taken(self, rows: NDArray[np.intp]) -> _Ends:
        """Some of the rows."""
        return _Ends(*(getattr(self, each.name)[rows] for each in fields(self)))


@dataclass(frozen=True, eq=False)
class _Found:
    """A way to one of some ends."""

    ends: _Ends
    way: Way
    cost: float
    """Of the way and of what comes after it, control steps."""


@dataclass(frozen=True, eq=False)
class Plan:
    """How to push."""

    way: tuple[Array, ...]
    """Configurations to go through, each (dof,); at the last the tool is behind the block."""
    rotation: torch.Tensor
    """How the tool is turned there, shape (3, 3)."""
    height: float
    """Of the tool there, metres."""
    aside: float
    """x of the tool less x of the block, so that it pushes the middle, metres."""
    gap: float
    """How far the tool goes until it touches, metres."""


class PushPlanner:
    """Plans for one robot and its block."""

    def __init__(
        self, spec: EnvSpec, robot_tables: RobotTables, index: int, rng: np.random.Generator
    ) -> None:
        """Collect free configurations that are low and where the block is pushed.

        Args:
            spec: A robot that pushes.
            robot_tables: Robots.
            index: Which of them the specification is of.
            rng: Where configurations come from.

        Raises:
            ValueError: If the robot does not push.
        """
        pushes, robot = spec.goals, spec.robot
        if not isinstance(pushes, PushStartSet):
            raise ValueError(f"{robot.name} does not push")
        self._robot, self._tool = robot, OneTool(robot_tables, index)
        self._edge, self._line, self._ground = pushes.block.size[0], pushes.line, pushes.ground
        self._friction = pushes.block.friction * pushes.block.mass * GRAVITY
        self._stiffness = np.array([gain.stiffness for gain in actuation(robot)])
        self._others = ~robot_tables.moves_tool[index, : robot.dof].cpu().numpy()
        self._space = FreeSpace(spec.scene)
        step = robot_tables.max_step[index, : robot.dof].double().cpu().numpy()
        self._ways = FreeWays(self._space, step, rng)
        edge, first, last = self._edge, pushes.blocks.min(axis=0), pushes.blocks.max(axis=0)
        low = np.array([first[0] - edge, first[1] - 2.5 * edge, self._ground])
        high = np.array([last[0] + edge, self._line + edge, self._ground + 1.5 * edge])
        self._bank, self._tools = sample_tools_in_box(self._space, low, high, rng)

    def plan(self, q: Array, block: Array, attempt: int = 0, left: float = np.inf) -> Plan | None:
        """Look for a way to push.

        Args:
            q: Where the joints are, shape (dof,).
            block: Pose of the block, shape (7,).
            attempt: How many plans were made before; each goes by way of other configurations.
            left: Control steps until the episode ends. Plans that take longer come last.

        Returns:
            The plan that takes the least time, or gets farthest; None if there is none, or no
            block gets as far in the time that is left.
        """
        if left < (self._line - block[1]) / SPEED:
            return None
        start = self._parted(q, block)
        found = self._by_stops(start, q, block, attempt, left)
        if found is None or found.cost > _DEAR:
            other = self._along_a_tree(start, block, attempt, left)
            if found is None or (other and other.cost < found.cost):
                found = other
        if found is None:
            return None
        ends, i, points = found.ends, found.way.end, found.way.points
        return Plan(
            way=points if start is q else (start, *points),
            rotation=torch.from_numpy(ends.rotation[i]).float(),
            height=float(ends.position[i, 2]),
            aside=float(ends.aside[i]),
            gap=float(ends.gap[i]),
        )

    def free(self, q: Array) -> NDArray[np.bool_]:
        """Whether configurations (n, dof) are free of all but the block, shape (n,)."""
        return self._space.free(q)

    def _by_stops(
        self, start: Array, q: Array, block: Array, attempt: int, left: float
    ) -> _Found | None:
        """The cheapest simple way to the ends that are known."""
        ends = self._judged(self._behind(q, block), block)
        order = np.argsort(ends.price(left).of(self._ways.steps(q, ends.q)), kind="stable")
        ends = ends.taken(order[:_KEPT])
        price, vias = ends.price(left), self._lifted(ends)
        way = self._ways.find(start, ends.q, vias=vias, price=price, block=block, attempt=attempt)
        return None if way is None else self._found(start, ends, way, price)

    def _along_a_tree(self, start: Array, block: Array, attempt: int, left: float) -> _Found | None:
        """A way to ends near configurations that the robot gets to from where it is.

        Others may be out of its reach: links that are in each other's way divide what is free.
        """
        tree = self._ways.explored(start, _GROWN, block=block, attempt=attempt)
        nodes = np.array(tree.nodes)
        tools, _ = self._tool.poses(nodes)
        none = np.zeros(0, dtype=np.intp)
        behind = self._free_behind(*self._near_behind(nodes, tools, block, none), block)
        ends = self._judged(behind, block)
        price, vias = ends.price(left), self._lifted(ends)
        way = self._ways.find_along(tree, ends.q, vias=vias, price=price, block=block)
        return None if way is None else self._found(start, ends, way, price)

    def _found(self, start: Array, ends: _Ends, way: Way, price: Price) -> _Found:
        return _Found(ends, way, float(price.of(self._ways.length(start, way), way.end)))

    def _judged(self, q: Array, block: Array) -> _Ends:
        """From which configurations behind the block a push begins, and what it costs."""
        found = poised(self._space, q, block, self._edge)
        position, rotation = self._tool.poses(found.q)
        aside = position[:, 0] - block[0] - found.middle
        share, over = self._tried_out(found, position, rotation, aside, block)
        cost = _UNFINISHED * (1 - share) + _NARROW * (1 - found.width)
        cost += _OVER * np.minimum(over, _MOST) + found.gap / SPEED
        cost += _SOFT * self._given_way(found.q)
        steps = (found.gap + self._line - block[1]) / SPEED + _SETTLED
        ends = _Ends(found.q, position, rotation, aside, found.gap, cost, steps)
        return ends.taken(np.flatnonzero(share > 0))

    def _behind(self, q: Array, block: Array) -> Array:
        """Free configurations with the tool behind the block, shape (n, dof)."""
        bank = unwrap_joints(self._robot, q, self._bank)
        quick = np.argsort(self._ways.steps(q, bank), kind="stable")[:_QUICKEST]
        start, goal = self._near_behind(bank, self._tools, block, quick)
        start[::2, self._others] = q[self._others]
        start[1::2, self._others] = np.array(self._robot.home)[self._others]
        return unwrap_joints(self._robot, q, self._free_behind(start, goal, block))

    def _near_behind(
        self, q: Array, tools: Array, block: Array, more: NDArray[np.intp]
    ) -> tuple[Array, Array]:
        """Configurations with the tool near places behind the block, and those places.

        Taken from all (n, dof), whose tools are at (n, 3), and more of them for each place.
        """
        edge = self._edge
        yaw = 2 * np.arctan2(block[6], block[3])
        hindmost = block[1] - edge / 2 * (abs(np.cos(yaw)) + abs(np.sin(yaw)))
        goals, starts = [], []
        for distance in _BEHIND:
            place = np.array([block[0], hindmost - distance * edge])
            apart = np.linalg.norm(tools[:, :2] - place, axis=1)
            apart += np.maximum(tools[:, 2] - self._ground - edge, 0)
            near = np.concatenate([np.argsort(apart, kind="stable")[:_NEAREST], more])
            height = np.clip(tools[near, 2] - self._ground, _LOW * edge, _HIGH * edge)
            goals.append(np.column_stack([np.tile(place, (len(near), 1)), self._ground + height]))
            starts.append(q[near])
        return np.concatenate(starts), np.concatenate(goals)

    def _free_behind(self, start: Array, goal: Array, block: Array) -> Array:
        """Configurations that are free with the tool at goals (n, 3), near others (n, dof)."""
        found, error = solve_position_ik(self._robot, start, goal)
        there = (np.abs(error[:, :2]) < _REACHED * self._edge).all(axis=1)
        found = found[there & (np.abs(error[:, 2]) < self._edge / 2)]
        return found[self._space.free(found, np.tile(block, (len(found), 1)))]

    def _given_way(self, q: Array) -> Array:
        """How far tools give way along y where the block's friction pushes back, (n,), metres."""
        _, J = frame_jacobian(self._robot, q)
        return np.asarray(self._friction * (J[:, 1] ** 2 / self._stiffness).sum(axis=1))

    def _tried_out(
        self, found: Poised, position: Array, rotation: Array, aside: Array, block: Array
    ) -> tuple[Array, Array]:
        """Which share of the push configurations get through, and how far they lean over, (n,).

        The tool is taken along its way as it will be; where the block then is, it is to be near,
        and not in the way.
        """
        edge, q = self._edge, found.q
        through = found.gap + self._line - block[1] + 0.1 * edge
        good, share = np.ones(len(q), dtype=np.bool_), np.zeros(len(q))
        over = found.over.copy()
        for i in range(1, _POINTS + 1):
            ahead = through * i / _POINTS
            goal = position.copy()
            goal[:, 0] = block[0] + aside
            goal[:, 1] += ahead
            q = self._tool.brought(q, goal, rotation, 4)
            off = np.abs(self._tool.poses(q)[0][:, :2] - goal[:, :2]).max(axis=1)
            good &= (off < _REACHED * edge + 0.002) & self._space.free(q)
            moved = np.maximum(ahead - found.gap, 0)[:, None]
            shifts = moved + np.array([-_TOLERANCE[0], _TOLERANCE[1]]) * edge
            near, far = touches(self._space, q, block, np.zeros(1), shifts).T
            good &= (near & ~far) | (ahead < found.gap)
            share[good] = i / _POINTS
            if i % _LOOKED == 0:
                at = np.flatnonzero(good)
                blocks = np.tile(block, (len(at), 1))
                blocks[:, 1] += moved[at, 0] + _TOLERANCE[1] * edge
                over[at] = np.maximum(over[at], leaning(self._space, q[at], blocks, edge))
        begun = share * through > found.gap + 0.1 * edge
        return np.where(begun, share, 0.0), over

    def _lifted(self, ends: _Ends) -> Array:
        """Configurations with the tool above, or as high as it gets, shape (n, dof)."""
        goal, q = ends.position.copy(), ends.q
        for _ in range(5):
            goal[:, 2] += _LIFT * self._edge / 5
            q = self._tool.brought(q, goal, ends.rotation, 3)
        return q

    def _parted(self, q: Array, block: Array) -> Array:
        """The configuration itself if it is free of the block, or one near it that is."""
        if self._space.free(q[None], block[None])[0]:
            return q
        position, rotation = self._tool.poses(q[None])
        stride, steps = _PARTING
        for direction in _AWAY:
            goal, found = position.copy(), q[None]
            for _ in range(steps):
                goal += stride * self._edge * np.array(direction)
                found = self._tool.brought(found, goal, rotation, 3)
                if self._space.free(found, block[None])[0]:
                    return np.asarray(found[0])
        return q

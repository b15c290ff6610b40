"""The baseline ``scripted`` of drawer, door and dial: get behind the object, and follow its path.

A robot moves the joint of its object from behind. A *track* is a sequence of configurations whose
tool is at one distance behind the object as this moves to its goal and a little farther; it is
found by inverse kinematics and tests of collisions, without dynamics.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from operator import attrgetter

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.kinematics import unwrap_joints
from morphgen.rl.baselines.path_planner import Path, PathCost, PathPlanner
from morphgen.rl.baselines.scripted_push import LEAD_STEP, SPEED, ScriptedController, ScriptedPush
from morphgen.tasks.articulated.envs import ArticulatedEnvs
from morphgen.tasks.articulated.task import ArticulatedStartSet, PathFinder, points_behind
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.push.task import BEHIND
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import EnvSpec
from morphgen.typing import Array

TRACK = 16  # configurations of a track

# Lengths are in sizes of the object (the edge of push's block); costs in control steps.
_NEAREST, _QUICKEST = 16, 16
"""Starts of inverse kinematics per distance: those nearest in space, and nearest in joint space."""
_BEYOND = 2.5  # length of a track beyond the goal
_DEPTH = 0.1  # how far below the object's top the robot must touch it
_PARTS, _MOVE, _MOVES = 4, 0.05, 5
"""Parts of a track's step in which robots touch the object; how far it moves at a time until they
do not, and the largest number of such motions in a part."""
_SURPLUS = 0.1  # motion beyond the goal that a track has to make
_LEAST_PART = 0.3  # part of the motion that a track has to make
_UNFINISHED_COST = 400.0  # cost of a track that makes no part of the motion
_CANDIDATES = 24  # tracks, the cheapest first, to which straight paths are tried
_TREE_ITERATIONS = 1500  # random configurations of a tree where no straight path is free
_RESOLUTION = 0.01
"""Largest change of a joint between tested configurations of a path [rad or m]: in steps of 5 cm a
stick passes through a panel."""

LEAD, MAX_LEAD = 0.03, 0.25
"""Initial and largest lead of the commanded tool before the object [m], which grows as in a push.
"""
MOVING = 0.02  # speed of the contact point from which the object counts as moving [m/s]
PATIENCE = 50  # control steps in which the object must move by ``PROGRESS``; else plan again
PROGRESS = MOVING * PATIENCE * CONTROL_PERIOD  # [m]


@dataclass(frozen=True, eq=False)
class Motion:
    """A motion of the object to plan."""

    q: Array  # configuration of the robot, shape (dof,)
    position: float  # of the object's joint [rad or m]
    goal: float  # of the object's joint [rad or m]
    attempt: int  # number of earlier plans in the episode
    steps_left: float  # control steps until the time limit


@dataclass(frozen=True, eq=False)
class Plan:
    """A path to the first configuration of a track, and the track."""

    path: tuple[Array, ...]  # waypoints, each (dof,)
    track: Array  # configurations, shape (TRACK, dof)
    moves: Array  # motions of the object that its configurations make, shape (TRACK,) [m]
    step: float  # motion of the contact point between two of them [m]
    length: float  # motion of the contact point up to the last sound one [m]


class MotionPlanner:
    """Plans how a robot moves its object."""

    def __init__(
        self, spec: EnvSpec, tables: RobotTables, robot: int, rng: np.random.Generator
    ) -> None:
        """Collect free configurations with the tool near the object's contact point."""
        starts, self._robot = spec.goals, spec.robot
        assert isinstance(starts, ArticulatedStartSet)
        thing = starts.thing
        self._thing, self._edge = thing, starts.edge
        ends = np.concatenate([starts.start, starts.goal])
        points = thing.placed_joint.poses(ends)[:, :3]
        low, high = points.min(axis=0) - 2 * self._edge, points.max(axis=0) + 2 * self._edge
        low[2] = starts.ground
        self._finder = PathFinder(self._robot, self._edge, low, high, rng)
        self._finder.stand(thing)
        self._space = self._finder.space
        step = tables.max_step[robot, : self._robot.dof].double().cpu().numpy()
        self._planner = PathPlanner(
            self._space, step, int(rng.integers(2**63)), resolution=_RESOLUTION
        )

    def plan(self, motions: Sequence[Motion]) -> list[Plan | None]:
        """Return the cheapest plan of each motion, if any."""
        every, moves, motion_of = self._tracks(motions)
        plans = []
        for i, motion in enumerate(motions):
            rows = np.flatnonzero(motion_of == i)
            plans.append(self._plan(motion, every[rows], moves[rows]) if len(rows) else None)
        return plans

    def _plan(self, motion: Motion, tracks: Array, moves: Array) -> Plan | None:
        """Return the cheapest plan along one of the tracks (n, TRACK, dof), if any."""
        q, to_go = motion.q, self._to_go(motion)
        step = (to_go + _BEYOND * self._edge) / (TRACK - 1)
        pose = self._thing.placed_joint.poses(np.array([motion.position]))[0]
        wanted = to_go + _SURPLUS * self._edge
        parts = np.minimum(np.nanmax(moves, axis=1) / wanted, 1.0)
        steps = np.maximum(self._planner.steps(tracks[:, :-1], tracks[:, 1:]), step / SPEED)
        length = np.nansum(np.where(moves[:, :-1] < wanted, steps, 0.0), axis=1)
        cost = PathCost(length + _UNFINISHED_COST * (1 - parts), motion.steps_left - length)
        order = np.argsort(cost.of(self._planner.steps(q, tracks[:, 0])), kind="stable")
        order = order[:_CANDIDATES]
        ends, chosen = tracks[order, 0], PathCost(cost.goal_cost[order], cost.deadline[order])
        path: Path | None
        path = self._planner.plan_straight(q, ends, cost=chosen, block=pose)
        if path is None:
            path, tree = self._planner.plan_rrt(
                q, ends, block=pose, attempt=motion.attempt, iterations=_TREE_ITERATIONS
            )
            path = path or self._planner.plan_straight(q, ends, cost=chosen, block=pose, tree=tree)
        if path is None:
            return None
        best = order[path.goal]
        track = tracks[best]
        last = int(np.isfinite(moves[best]).sum()) - 1
        track[last + 1 :], moves[best, last + 1 :] = track[last], moves[best, last]
        return Plan(path.waypoints, track, moves[best], step, last * step)

    def _to_go(self, motion: Motion) -> float:
        """Return the distance of the contact point from its goal, along its path [m]."""
        return abs(motion.goal - motion.position) * self._thing.lever

    def _tracks(self, motions: Sequence[Motion]) -> tuple[Array, Array, NDArray[np.intp]]:
        """Return tracks (n, TRACK, dof), how far they move the object (n, TRACK), and whose (n,).

        The first two are NaN from where a track is not sound.
        """
        edge, finder = self._edge, self._finder
        position, to_go = (
            np.array([each(motion) for motion in motions])
            for each in (attrgetter("position"), self._to_go)
        )
        sign = np.array([1.0 if motion.goal > motion.position else -1.0 for motion in motions])
        ends = position, position + sign * (to_go + _BEYOND * edge) / self._thing.lever
        quickest = []
        for motion in motions:
            bank = unwrap_joints(self._robot, motion.q, finder.bank)
            order = np.argsort(self._planner.steps(motion.q, bank), kind="stable")
            quickest.append(order[motion.attempt * _QUICKEST :][:_QUICKEST])
        starts, goals, owners = [], [], []
        for distance in BEHIND:
            poses = finder.motions(*ends, distance, TRACK)
            behind = points_behind(self._thing, poses[0], sign, distance * edge)
            nearest = finder.nearest(behind[:, 0])
            for i, motion in enumerate(motions):
                begin = motion.attempt * _NEAREST
                rows = np.concatenate([nearest[i, begin : begin + _NEAREST], quickest[i]])
                starts.append(rows)
                owners.append(np.full(len(rows), i))
            counts = [len(rows) for rows in starts[-len(motions) :]]
            goals.append([each.repeat(counts, axis=0) for each in (behind, *poses)])
        joined = (np.concatenate(each) for each in zip(*goals, strict=True))
        tracks, owner = finder.follow(np.concatenate(starts), *joined), np.concatenate(owners)
        is_begun = np.isfinite(tracks[:, 0, 0])
        tracks, owner = tracks[is_begun], owner[is_begun]
        now = np.array([motion.q for motion in motions])[owner]
        tracks = unwrap_joints(self._robot, now[:, None], tracks)
        moves = self._moves(tracks, position[owner], sign[owner])
        good = np.nanmax(moves, axis=1) >= _LEAST_PART * to_go[owner]
        return tracks[good], moves[good], owner[good]

    def _moves(self, tracks: Array, position: Array, sign: Array) -> Array:
        """Return how far robots on tracks (n, TRACK, dof) move the object, (n, TRACK) [m].

        It moves on from its positions (n,) where they touch it, as if it stopped at once; NaN is
        from where it cannot get out of their way.
        """
        moves = np.full(tracks.shape[:2], np.nan)
        moves[:, 0], edge = 0.0, self._edge
        for point in range(TRACK - 1):
            moved = moves[:, point].copy()
            for part in np.linspace(0, 1, _PARTS + 1)[1:]:
                q = tracks[:, point] + part * (tracks[:, point + 1] - tracks[:, point])
                moved = np.where(np.isfinite(q[:, 0]), moved, np.nan)
                rows, tries = np.flatnonzero(np.isfinite(moved)), 0
                while len(rows):
                    change = sign[rows] * moved[rows] / self._thing.lever
                    poses = self._thing.placed_joint.poses(position[rows] + change)
                    poses[:, 2] -= _DEPTH * edge  # robots that graze its top slip over it
                    rows = rows[~self._finder.links.free(q[rows], poses)]
                    moved[rows] += _MOVE * edge if tries < _MOVES else np.nan
                    tries += 1
                    rows = rows[np.isfinite(moved[rows])]
            moves[:, point + 1] = moved
        return moves

    def retreat(self, q: Array, track: Array, along: float, position: float) -> Array:
        """Return a configuration free of collisions: q, or that of a track behind the object."""
        pose = self._thing.placed_joint.poses(np.array([position]))
        return q if self._space.free([q], pose)[0] else track[min(max(int(along), 0), TRACK - 1)]


class ScriptedArticulated(ScriptedController):
    """Gets behind the object, follows its path in closed loop, and plans again where that fails."""

    def _begin(self, task: TaskBatch) -> None:
        super()._begin(task)
        n, device = task.num_envs, task.device
        names = {spec.task for spec in task.specs}
        self._groups = [
            (torch.nonzero(task.task_mask(name))[:, 0], envs)
            for name in sorted(names)
            if isinstance(envs := task.groups[name], ArticulatedEnvs)
        ]
        for rows, _ in self._groups:
            self._ours[rows] = True
        self._track = task.targets[:, None].repeat(1, TRACK, 1)
        self._moves = torch.zeros(n, TRACK, device=device)
        self._step, self._length = torch.zeros(2, n, device=device)  # of the track
        # Lead and place of the commanded tool; the object's best motion, its position when the plan
        # began, and its lever with the sign of the motion.
        self._lead, self._along, self._best, self._begun, self._lever = torch.zeros(
            5, n, device=device
        )

    def _positions(self, task: TaskBatch) -> tuple[torch.Tensor, torch.Tensor]:
        """Return positions and goals of the objects' joints, shape (n,) each."""
        position = torch.zeros(task.num_envs, device=task.device)
        goal = torch.zeros_like(position)
        for rows, envs in self._groups:
            formulas = envs.formulas
            position[rows] = formulas.position(task.simulation.object_pose[rows])
            goal[rows] = formulas.goal
        return position, goal

    def _plan(self, task: TaskBatch, key: tuple[int, int], envs: Sequence[int]) -> None:
        robot, (position, goal) = key[0], self._positions(task)
        spec = task.specs[robot]
        if key not in self._planners:
            rng = np.random.default_rng([self._seed, robot])
            self._planners[key] = MotionPlanner(spec, task.robot_tables, robot, rng)
        planner, dof = self._planners[key], spec.robot.dof
        now = [task.targets[env, :dof].double().cpu().numpy() for env in envs]
        motions = []
        for env, q in zip(envs, now, strict=True):
            start, at = q, float(position[env])
            if self.pushing[env]:
                moved = float((position[env] - self._begun[env]) * self._lever[env])
                track = self._track[env, :, :dof].double().cpu().numpy()
                start = planner.retreat(q, track, moved / float(self._step[env]), at)
            steps_left = int(task.max_episode_steps[env] - task.episode_step[env])
            motions.append(
                Motion(start, at, float(goal[env]), int(self._num_plans[env]), steps_left)
            )
        self._num_plans[envs] += 1
        self._active[envs] = self.pushing[envs] = False
        lever = spec.goals.thing.lever  # type: ignore[attr-defined]  # a set of this task
        for env, q, motion, plan in zip(envs, now, motions, planner.plan(motions), strict=True):
            if plan is None:
                self._num_failed[env] += 1
                continue
            self._active[env] = True
            self._follower.follow(env, plan.path if motion.q is q else (motion.q, *plan.path))
            self._track[env, :, :dof] = torch.from_numpy(plan.track).to(self._track)
            self._moves[env] = torch.from_numpy(plan.moves).to(self._moves)
            self._step[env], self._length[env] = plan.step, plan.length
            self._lever[env] = lever if motion.goal > motion.position else -lever
            self._begun[env], self._best[env], self._along[env] = motion.position, 0.0, 0.0
            self._lead[env], self._settling[env], self._still[env] = LEAD, 0, 0

    def _advance(self, task: TaskBatch) -> torch.Tensor:
        self._follow_paths(task)
        moved = (self._positions(task)[0] - self._begun) * self._lever
        progress = moved > self._best + PROGRESS
        self._best = torch.where(progress, moved, self._best)
        expected = self._on_track(self._moves)
        self._still = torch.where(progress | (expected == 0), 0, self._still + 1)
        ahead = expected - moved
        grow = self.pushing & (self._still > 2) & (ahead > self._lead - SPEED)
        self._lead = torch.where(grow, self._lead + LEAD_STEP, self._lead).clamp(max=MAX_LEAD)
        go = self.pushing & (ahead < self._lead)
        self._along = torch.minimum(self._along + torch.where(go, SPEED, 0.0), self._length)
        stuck = self.pushing & (self._still > PATIENCE)
        failed: torch.Tensor = self._active & (stuck | (moved < -PROGRESS))
        return failed

    def _push(self, task: TaskBatch) -> torch.Tensor:
        return self._on_track(self._track)

    def _on_track(self, values: torch.Tensor) -> torch.Tensor:
        """Return values along tracks (n, TRACK, ...) where the commanded tools are, (n, ...)."""
        at = (self._along / self._step.clamp(min=1e-9)).clamp(0, TRACK - 1)
        low = at.floor().long().clamp(max=TRACK - 2)
        envs = torch.arange(len(at), device=at.device)
        part = (at - low).view(-1, *(1,) * (values.ndim - 2))
        there: torch.Tensor = torch.lerp(values[envs, low], values[envs, low + 1], part)
        return there


class Scripted:
    """The scripted controllers of all tasks that have one, each for its own environments."""

    def __init__(self, seed: int) -> None:
        self._push, self._articulated = ScriptedPush(seed), ScriptedArticulated(seed)

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions of all environments, shape (n, L)."""
        if not any(isinstance(spec.goals, ArticulatedStartSet) for spec in task.specs):
            return self._push.act(task)
        actions = self._articulated.act(task)
        pushes = task.task_mask("push")
        if not bool(pushes.any()):
            return actions
        return torch.where(pushes[:, None], self._push.act(task), actions)

"""Baselines of reach, ``jacobian`` and ``ik``; and those of all tasks, ``zero`` and ``random``.

``jacobian`` moves each joint along its own column of the tool's Jacobian. Joints do not know of
each other; a policy that transfers to unseen robots must beat it. ``ik`` is inverse kinematics, and
a collision-free path to its solution.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from morphgen.model.kinematics_torch import frame_jacobian, pose_task, solve_ik
from morphgen.rl.baselines.path_planner import (
    Path,
    PathFollower,
    PathPlanner,
    Tree,
    fractions_towards,
)
from morphgen.tasks.actions import BINS, encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.observation import LinkJoints
from morphgen.tasks.task import EnvSpec
from morphgen.typing import Array


class Zero:
    """Keeps all joint targets where they are."""

    def __init__(self, seed: int = 0) -> None:
        """Ignore the seed: nothing is random."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions that change no target, shape (n, L)."""
        mask = task.action_mask
        return encode_actions(torch.zeros(mask.shape, device=mask.device), task.action_kind)


class Random:
    """Draws every action from a uniform distribution."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions (n, L), uniform over [-1, 1] or over the bins."""
        if task.action_kind == "discrete":
            actions = torch.randint(len(BINS), task.action_mask.shape, generator=self._generator)
        else:
            actions = 2 * torch.rand(task.action_mask.shape, generator=self._generator) - 1
        return actions.to(task.action_mask.device)


def reach_goals(task: TaskBatch) -> tuple[torch.Tensor, torch.Tensor | None, float]:
    """Return the goals of a batch whose environments reach, in the root frames.

    They are positions (n, 3) [m], rotations (n, 3, 3) or None for goals of positions, and
    ``ReachConfig.metres_per_radian``.
    """
    config = next(spec.config for spec in task.specs if isinstance(spec.config, ReachConfig))
    rotations = task.groups.tool_targets(task.simulation.object_pose).rotations
    return task.field("goal")[:, :3], rotations, config.metres_per_radian


GAIN = 0.3
"""Fraction of the error that a joint would remove in one control step if it acted alone. All joints
act at once and lag behind their targets, so that 1 overshoots; tuned on arm3 and Panda."""
MIN_COLUMN = 1e-4  # Jacobian columns shorter than this do not move the tool [m per rad or m per m]


class JacobianColumns:
    """Moves each joint j by a_j = GAIN (J_j . e) / (|J_j|^2 s_j), clipped to [-1, 1].

    J_j is the joint's column of the Jacobian, e the error from tool to goal, and s_j the joint's
    largest step. Jacobian and error are those of the measured joint positions. They have 3 rows, or
    6 for goals that are poses, where ``ReachConfig.metres_per_radian`` converts rotations.
    """

    def __init__(self, seed: int = 0) -> None:
        """Ignore the seed: nothing is random."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions, shape (n, L)."""
        tables, robots = task.robot_tables, task.env_robot_index
        T_root_tool, J_root_tool = frame_jacobian(tables.tool_chain, robots, task.q)
        positions, rotations, weight = reach_goals(task)
        if rotations is None:
            J, error = J_root_tool[:, :3], positions - T_root_tool[:, :3, 3]
        else:
            J, error = pose_task(T_root_tool, J_root_tool, positions, rotations, weight)
        steps = column_steps(J, error)
        fractions = (GAIN * steps / tables.max_step[robots].clamp(min=1e-9)).clamp(-1, 1)
        return encode_actions(LinkJoints(tables, robots)(fractions), task.action_kind)


def column_steps(J: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Return the change of each joint that alone reduces the error (n, m) most, shape (n, J).

    It is the projection on the joint's column of J (n, m, J); 0 for columns below ``MIN_COLUMN``.
    """
    squares = J.square().sum(dim=1)
    steps = (J * error[..., None]).sum(dim=1) / squares.clamp(min=MIN_COLUMN**2)
    return torch.where(squares < MIN_COLUMN**2, torch.zeros_like(steps), steps)


STARTS = 16  # number of start configurations of inverse kinematics per goal
ATTEMPTS = 4  # maximum number of attempts per goal, each with other starts
TREE_ITERATIONS = 200
"""Number of random configurations of a tree, grown if inverse kinematics has no solution."""
ITERATIONS = 60  # iterations of inverse kinematics
CLOSE = 0.003  # distance of tool and goal that counts as solved [m]; angles count as above


class InverseKinematics:
    """Plans a path to a configuration with the tool at the goal at the start of each episode.

    Inverse kinematics is damped least squares (Wampler 1986) from several starts. The robot goes to
    the nearest solution with a collision-free path; without such a path, straight to the nearest.
    """

    def __init__(self, seed: int) -> None:
        self._seed, self._generator = seed, torch.Generator().manual_seed(seed)
        self._specs: Sequence[EnvSpec] = ()
        self._planners: dict[tuple[int, int], PathPlanner] = {}
        self._task: TaskBatch | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return a step along the paths, shape (n, L); all joints move in proportion."""
        if self._specs is not task.specs:
            self._specs = task.specs
            self._planners = {}
        if self._task is not task:
            self._task, self._follower = task, PathFollower(task)
        new = torch.nonzero((task.episode_step == 0) & ~task.is_idle)[:, 0]
        if len(new):
            self._plan(task, new)
        self._follower.advance()
        return encode_actions(fractions_towards(task, self._follower.waypoint), task.action_kind)

    def _planner(self, task: TaskBatch, env: int) -> PathPlanner:
        """Return the planner of an environment's robot among its obstacles."""
        robot = int(task.env_robot_index[env])
        key = robot, int(task.layouts.current[env])
        if key not in self._planners:
            joints = slice(0, task.specs[robot].robot.dof)
            step = task.robot_tables.max_step[robot, joints]
            movable = task.robot_tables.moves_tool[robot, joints].cpu().numpy()
            seed = int(np.random.SeedSequence([self._seed, robot]).generate_state(1)[0])
            space = FreeSpace(task.layouts.scene(env))
            self._planners[key] = PathPlanner(space, _array(step), seed, movable)
        return self._planners[key]

    def _plan(self, task: TaskBatch, envs: torch.Tensor) -> None:
        """Plan a path in some environments."""
        trees: dict[int, Tree | None] = {}
        for attempt in range(ATTEMPTS):
            solutions = self._solve(task, envs, trees)
            failed = []
            for i, (env, goals) in enumerate(zip(envs.tolist(), solutions, strict=True)):
                path, trees[env] = self._path(task, env, goals, attempt)
                if path is None:
                    failed.append(i)
                if path or attempt == 0:
                    self._follower.follow(env, path.waypoints if path else (goals[0],))
            envs = envs[failed]
            if not len(envs):
                break

    def _solve(
        self, task: TaskBatch, envs: torch.Tensor, trees: dict[int, Tree | None]
    ) -> list[Array]:
        """Return solutions of each environment, nearest first, or the attempt with the least error.

        In environments with a tree of reachable configurations, its nodes are the starts.
        """
        robots, now = task.env_robot_index[envs], task.targets[envs]
        starts = random_starts(task, envs, self._generator)
        for i, env in enumerate(envs.tolist()):
            if tree := trees.get(env):
                nodes = np.array(tree.nodes)
                rows = torch.randint(len(nodes), (STARTS,), generator=self._generator)
                starts[:, i, : nodes.shape[1]] = torch.from_numpy(nodes[rows.numpy()])
        tables, (positions, rotations, metres_per_radian) = task.robot_tables, reach_goals(task)
        q, error = solve_ik(
            tables.tool_chain,
            robots,
            starts,
            positions[envs],
            None if rotations is None else rotations[envs],
            (tables.lower[robots], tables.upper[robots]),
            rotation_weight=metres_per_radian,
            iterations=ITERATIONS,
        )
        # [m]; from a goal that is a pose, the larger one of position and rotation.
        distance = torch.linalg.vector_norm(error.view(*error.shape[:2], -1, 3), dim=3).amax(dim=2)
        # A joint of two turns reaches a pose in two ways, of which one may outlast the episode.
        q = tables.nearest_turns(robots, q, now)
        steps = ((q - now) / tables.max_step[robots].clamp(min=1e-9)).abs().amax(dim=2)
        # Solutions come before all others, by control steps; others by their distance.
        order = torch.where(distance < CLOSE, steps, 1e9 * (1 + distance)).argsort(dim=0)
        count = (distance < CLOSE).sum(dim=0).clamp(min=1).tolist()
        return [
            _array(q[order[: count[i], i], i, : task.specs[robot].robot.dof])
            for i, robot in enumerate(robots.tolist())
        ]

    def _path(
        self, task: TaskBatch, env: int, goals: Array, attempt: int
    ) -> tuple[Path | None, Tree | None]:
        """Return a free path to one of the goals or None, and the tree of RRT-Connect if it ran."""
        robot, planner = int(task.env_robot_index[env]), self._planner(task, env)
        goals = goals[planner.space.free(goals)]
        start = _array(task.targets[env, : task.specs[robot].robot.dof])
        path = planner.plan_straight(start, goals)
        if path:
            return path, None
        if len(goals):
            return planner.plan_rrt(start, goals, attempt=attempt)
        return planner.plan_rrt(start, goals, attempt=attempt, iterations=TREE_ITERATIONS)


def random_starts(task: TaskBatch, envs: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    """Return starts of inverse kinematics, shape (STARTS, n, J): joint targets and random ones.

    Joints that do not move the tool, such as fingers, keep their targets.
    """
    robots, now = task.env_robot_index[envs], task.targets[envs]
    lower, upper = task.robot_tables.lower[robots], task.robot_tables.upper[robots]
    random = torch.rand(STARTS - 1, *now.shape, generator=generator).to(now.device)
    starts = torch.cat([now[None], lower + (upper - lower) * random])
    return torch.where(task.robot_tables.moves_tool[robots], starts, now)


def _array(values: torch.Tensor) -> Array:
    return values.double().cpu().numpy()

"""Controllers that learn nothing: they show that a task can be done, and policies beside them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from morphgen.model.inverse_kinematics_torch import solve_position_ik
from morphgen.rl.baselines.path_planner import FreeWays, Routes, Way, shares_to
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.robot_tables import RobotTables
from morphgen.tasks.task import EnvSpec
from morphgen.typing import Array

STARTS = 16
"""Configurations from which inverse kinematics is tried for every goal."""
ROUNDS = 4
"""Times that these are others, as long as no free way is found."""
ITERATIONS = 60
DAMPING = 0.05
"""Damping of the least squares [joint units per metre]."""
MAX_STEP = 0.5
"""Largest change of a joint in one iteration, rad or m."""
CLOSE = 0.003
"""Distance from a goal that counts as solved, metres."""


class InverseKinematics:
    """Finds a configuration whose tool is at the goal when an episode begins, and goes there.

    Damped least squares (Wampler 1986) from several starts within the joints' limits; the nearest
    that arrives is taken to which a way is free, as ``FreeWays`` finds them; only if there is none,
    the nearest.
    """

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)
        self._seed = seed
        self._specs: Sequence[EnvSpec] = ()
        self._spaces: list[FreeSpace] = []
        self._ways: dict[int, FreeWays] = {}
        self._task: TaskBatch | None = None

    def act(self, task: TaskBatch) -> torch.Tensor:
        """A step along the way, all joints in proportion."""
        if self._specs is not task.specs:
            self._specs, self._ways = task.specs, {}
            self._spaces = [FreeSpace(spec.scene) for spec in task.specs]
        if self._task is not task:
            self._task, self._routes = task, Routes(task)
        new = torch.nonzero(task.episode_step == 0)[:, 0]
        if len(new):
            self._plan(task, new)
        self._routes.go_on()
        return encode_actions(shares_to(task, self._routes.wanted), task.action_kind)

    def _plan(self, task: TaskBatch, envs: torch.Tensor) -> None:
        for attempt in range(ROUNDS):
            found = self._solved(task, envs, attempt)
            missed = []
            for i, (env, ends) in enumerate(zip(envs.tolist(), found, strict=True)):
                way = self._way(task, env, ends, attempt)
                if way is None:
                    missed.append(i)
                if way or attempt == 0:
                    self._routes.take(env, way.points if way else (ends[0],))
            envs = envs[missed]
            if not len(envs):
                break

    def _solved(self, task: TaskBatch, envs: torch.Tensor, attempt: int) -> list[Array]:
        """Of each environment those configurations that arrive, nearest first; or the best."""
        body, starts = task.env_robot_index[envs], task.targets[envs]
        tried = random_starts(task.robot_tables, body, starts, self._generator)
        if attempt:
            for i, robot in enumerate(body.tolist()):
                ways, q = self._ways_of(task, robot, starts[i])
                nodes = ways.reached(q, STARTS, attempt=attempt)
                tried[:, i, : len(q)] = torch.from_numpy(nodes)
        rows = body.repeat(STARTS)
        found, error = solve_position_ik(
            task.robot_tables.tool_chain,
            rows,
            tried.flatten(0, 1),
            task.field("goal")[envs, :3].repeat(STARTS, 1),
            (task.robot_tables.lower[rows], task.robot_tables.upper[rows]),
            iterations=ITERATIONS,
            damping=DAMPING,
            max_step=MAX_STEP,
        )
        found = found.view_as(tried)
        left = torch.linalg.vector_norm(error, dim=1).view(STARTS, -1)
        step = task.robot_tables.max_step[body].clamp(min=1e-9)
        far = ((found - starts) / step).abs().amax(dim=2)
        order = torch.where(left < CLOSE, far, 1e9 * (1 + left)).argsort(dim=0)
        count = (left < CLOSE).sum(dim=0).clamp(min=1).tolist()
        return [
            _numbers(found[some[:k], i, : task.specs[robot].robot.dof])
            for i, (some, k, robot) in enumerate(zip(order.T, count, body.tolist(), strict=True))
        ]

    def _way(self, task: TaskBatch, env: int, ends: Array, attempt: int) -> Way | None:
        """A free way to one of the ends."""
        robot = int(task.env_robot_index[env])
        ends = ends[self._spaces[robot].free(ends)]
        if not len(ends):
            return None
        ways, start = self._ways_of(task, robot, task.targets[env])
        return ways.find(start, ends, attempt=attempt) or ways.find_round_about(
            start, ends, attempt=attempt
        )

    def _ways_of(self, task: TaskBatch, robot: int, q: torch.Tensor) -> tuple[FreeWays, Array]:
        """The ways of a robot, and where its joints are, from (J,) to (dof,)."""
        dof = task.specs[robot].robot.dof
        if robot not in self._ways:
            step, moves = (
                task.robot_tables.max_step[robot, :dof],
                task.robot_tables.moves_tool[robot, :dof],
            )
            rng = np.random.default_rng([self._seed, robot])
            space = self._spaces[robot]
            self._ways[robot] = FreeWays(space, _numbers(step), rng, moves.cpu().numpy())
        return self._ways[robot], _numbers(q[:dof])


def random_starts(
    robot_tables: RobotTables, body: torch.Tensor, near: torch.Tensor, generator: torch.Generator
) -> torch.Tensor:
    """Configurations to start from, shape (STARTS, n, J): those given (n, J), and random ones."""
    lower, upper = robot_tables.lower[body], robot_tables.upper[body]
    drawn = torch.rand(STARTS - 1, *near.shape, generator=generator).to(near.device)
    starts = torch.cat([near[None], lower + (upper - lower) * drawn])
    return torch.where(robot_tables.moves_tool[body], starts, near)


def _numbers(values: torch.Tensor) -> Array:
    return values.double().cpu().numpy()

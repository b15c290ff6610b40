"""The task reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.workspace import shoulder
from morphgen.model.robot import Robot
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.goals import ReachGoalSet, certify_goals, sample_goals
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.task import GOAL, EnvSpec, Marker, Task

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.reach.envs import ReachEnvs

MAX_DISTANCE = 3.0
"""Bound on the distance between tool and goal in reaches: each is within one, and a reach is an
estimate."""
_ROUNDING = 1e-6
"""Rounding of a distance that is computed with single precision [m]."""


class Reach(Task[ReachConfig, ReachGoalSet]):
    """Bring the tool to a goal and keep it there, within 6 s."""

    name = "reach"
    config_type = ReachConfig
    goal_set_type = ReachGoalSet
    goal_format = 5
    cache_folder = "goals-5"
    fields = (GOAL,)
    discrete_actions = True
    reset_options: Mapping[str, tuple[int, ...]] = {"goal": (3, 7)}
    goal_field = "goal"
    goal_files_readme = """\
- reach: `q` (n, dof) are configurations free of collisions without obstacles, and `poses` (n, 7) of
  the tool at them are the goals; `q` are the starts of episodes, too
"""

    def check(self, robot: Robot, config: ReachConfig) -> None:
        """Refuse a robot whose tool does not move."""
        shoulder(robot)

    def sample(
        self,
        robot: Robot,
        config: ReachConfig,
        *,
        obstacles: bool,
        ground: float,
        seeds: np.random.SeedSequence,
        identity: Mapping[str, Any],
    ) -> ReachGoalSet:
        """Sample free configurations; see ``sample_goals``."""
        return sample_goals(
            robot, config, obstacles=obstacles, ground=ground, seeds=seeds, identity=identity
        )

    def certify(self, goals: ReachGoalSet, robot: Robot, scene: Scene) -> list[str]:
        """Test every configuration; see ``certify_goals``."""
        return certify_goals(goals, robot, scene)

    def make_envs(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> ReachEnvs:
        """Make the environments of a batch that reach."""
        from morphgen.tasks.reach.envs import ReachEnvs

        return ReachEnvs(specs, env_spec_index, num_joints)

    def achieved_goal(
        self, config: ReachConfig, tool_pose: NDArray[np.float32], block_pose: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        """Return the position of the tool, or its pose if goals are poses."""
        return tool_pose if config.goal == "pose" else tool_pose[:3]

    def goal_reward(
        self, config: ReachConfig, achieved: torch.Tensor, desired: torch.Tensor
    ) -> torch.Tensor:
        """Return the terms ``distance`` and ``near``, and ``rotation`` if goals are poses."""
        from morphgen.tasks.reach.envs import goal_terms

        return goal_terms(config, achieved, desired)

    def score_range(self, config: ReachConfig, reach: float) -> tuple[float, float]:
        """Return the score at the farthest distance from a goal, and the score near it."""
        return -config.score_square * (MAX_DISTANCE * reach) ** 2, config.score_near

    def outcome_fault(
        self, config: ReachConfig, success: bool, score: float, distance: float
    ) -> str:
        """Compare success with the final distance."""
        if success and distance > config.near + _ROUNDING:
            return f"success at a distance of {distance:g} m; a success is within {config.near:g} m"
        if not success and config.goal == "position" and distance < config.near - _ROUNDING:
            return f"no success at a distance of {distance:g} m, which is within {config.near:g} m"
        return ""

    def markers(self, config: ReachConfig, goals: ReachGoalSet) -> tuple[Marker, ...]:
        """Return a ball with the radius of success, and axes of the goal pose."""
        return (Marker("goal", "frame", (2 * config.near,) * 3),)


REACH = Reach()

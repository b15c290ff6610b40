"""The task reach."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from morphgen.benchmark.workspace import shoulder
from morphgen.model.robot import Robot
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.goals import ReachGoalSet, certify_goals, sample_goals
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.task import GOAL, EnvSpec, Marker, Task

if TYPE_CHECKING:
    import torch

    from morphgen.tasks.reach.envs import ReachEnvs


class Reach(Task[ReachConfig, ReachGoalSet]):
    """Bring the tool to a goal and keep it there, within 6 s."""

    name = "reach"
    config_type = ReachConfig
    goal_set_type = ReachGoalSet
    goal_format = 5
    cache_folder = "goals-5"
    fields = (GOAL,)
    discrete_actions = True
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

    def markers(self, config: ReachConfig, goals: ReachGoalSet) -> tuple[Marker, ...]:
        """Return a ball with the radius of success, and axes of the goal pose."""
        return (Marker("goal", "frame", (2 * config.near,) * 3),)


REACH = Reach()

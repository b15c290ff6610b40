"""A task with its own goal sets: reach for points at the height of a table top.

Prints how many configurations were tested for how many goals, the range of the goals' heights, and
the faults that the certificate finds: none, and one for a goal that is moved up.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.reach.task import Reach, ReachGoalSet
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import env_spec, load_robot
from morphgen.tasks.sim.base import Scene


# %%
# Constants that the goals depend on belong to their key, so that stored sets are never mixed up.
@dataclass(frozen=True)
class TableConfig(ReachConfig):
    """Constants of the task, besides those of reach."""

    task: ClassVar[str] = "table"
    num_goals: int = 20
    heights: tuple[float, float] = (0.1, 0.3)
    """Range of the goals' heights above the ground [m]."""


# %%
# Configurations are sampled until enough of them have the tool in the range. Each is the proof that
# its goal can be reached, and a start of episodes.
class TableReach(Reach):
    """Reach for goals at the height of a table top."""

    name, config_type, goal_format, cache_folder = "table", TableConfig, 1, "table-1"

    def key_parts(self, config):
        """Return the constants that goal sets depend on."""
        return [*super().key_parts(config), *config.heights]

    def sample(self, robot, config, *, obstacles, ground, seeds, identity):
        """Sample free configurations with the tool in the range of heights."""
        low, high = config.heights

        def is_level(q):
            return low <= frame_pose(robot, q)[2, 3] - ground <= high

        space, rng = FreeSpace(Scene(robot, ground=ground)), np.random.default_rng(seeds)
        q, tried = space.sample(config.num_goals, rng, is_level)
        tools = [Pose.from_matrix(T) for T in frame_pose(robot, q)]
        poses = np.array([[*tool.position, *tool.quaternion] for tool in tools])
        no_layouts = {"layouts": np.zeros((0, 0, 7)), "usable": np.zeros((0, len(q)), bool)}
        counts = {"tried": tried, "accepted": len(q)}
        return ReachGoalSet(q=q, poses=poses, obstacles=(), **no_layouts, **counts, **identity)


# %%
# A registered task works everywhere: `morphgen.make_env("table", ...)`, training, the viewer.
task = TASKS.register(TableReach())
spec = env_spec(load_robot("arm3-stick"), "table")
goals = spec.goals
print(f"{goals.accepted} goals of {goals.tried} tested configurations")
print(f"heights {goals.poses[:, 2].min():.2f} to {goals.poses[:, 2].max():.2f} m")
print("faults:", task.certify(goals, spec.robot, spec.scene))
poses = goals.poses.copy()
poses[0, 2] += 0.1
print("faults:", task.certify(replace(goals, poses=poses), spec.robot, spec.scene))

"""A task of your own, follow a moving goal, with which the script runs the command line.

    python examples/09_custom_task.py train ur5-stick task=follow --out runs/1
    python examples/09_custom_task.py play follow ur5-stick --policy runs/1 --out 1.mp4

Prints what the command prints. Goal sets are sampled as reach does; see also `11_goal_set.py`.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch

from morphgen.cli import main
from morphgen.tasks import task as interface
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.random_numbers import Stream
from morphgen.tasks.reach.task import REACH, ReachGoalSet
from morphgen.tasks.registry import TASKS
from morphgen.tasks.rows import GoalChoices, choose, namespace_of, padded_rows, row_norms
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import GOAL, ObservationField


@dataclass(frozen=True)
class FollowConfig(interface.TaskConfig):
    """Constants of the task."""

    task: ClassVar[str] = "follow"
    max_episode_steps: int = 200
    num_goals: int = 100  # of a robot's goal set
    near: float = 0.05  # distance of the tool from the goal that is a success [m]
    radius: float = 0.05  # of the horizontal circle on which the goal moves [m]
    period: float = 4.0  # duration of a turn of the goal [s]


class FollowFormulas(interface.StepFormulas):
    """Formulas for tensors of k environments, and for the NumPy values of one, without that axis.

    Their tensors are the state of the episodes, which changes in place.
    """

    def __init__(self, config, k, device):
        self.config = config
        self.first, self.goal = torch.zeros(2, k, 7, device=device)  # poses of the goals
        self.time = torch.zeros(k, 1, device=device)  # since the episode began [s]

    def evaluate(self, state):
        """Move the goals on, and compare the tools with them."""
        self.time += CONTROL_PERIOD
        angle = self.time[..., 0] * (2 * math.pi / self.config.period)
        functions, radius = namespace_of(angle), self.config.radius
        self.goal[..., 0] = self.first[..., 0] + radius * (functions.cos(angle) - 1)
        self.goal[..., 1] = self.first[..., 1] + radius * functions.sin(angle)
        distance = row_norms(state.tool - self.goal[..., :3])
        success = (distance < self.config.near) & ~state.diverged
        terms = {"distance": -distance, "near": choose(success, 0.1)}
        never, score = success & ~success, choose(success, 1.0)
        return interface.StepResult(success, never, distance, score, terms)

    def observe(self, object_pose):
        """Return the goal, in the field that policies know from reach, and the time."""
        return {"goal": self.goal, "time": self.time}


class FollowEnvs(interface.TaskEnvs):
    """The k environments of a batch that follow a goal."""

    def __init__(self, specs, env_spec_index, num_joints):
        sets, device = [spec.goals for spec in specs], env_spec_index.device
        self.choices, self.index = GoalChoices(sets, 1, env_spec_index), env_spec_index
        self.q = padded_rows([goals.q for goals in sets], num_joints, device)
        self.poses = padded_rows([goals.poses for goals in sets], 7, device)
        self.formulas = FollowFormulas(specs[0].config, len(env_spec_index), device)

    def begin(self, mask, random, layout):
        """Begin episodes where the mask is set; circles begin at goals of the robots' sets."""
        count = self.choices.count(layout)[:, None].expand(-1, 2)
        start, first = self.choices.goals(layout, random.integers(Stream.START, count)).T
        state, poses, rows = self.formulas, self.poses[self.index, first], mask[:, None]
        for tensor, value in ((state.first, poses), (state.goal, poses), (state.time, 0.0)):
            tensor.copy_(torch.where(rows, value, tensor))
        return self.q[self.index, start], torch.zeros_like(poses)  # there is no block

    def target_points(self, object_pose):
        """Return the goal, to which observations such as ``jacobian`` lead the tool."""
        return self.formulas.goal[:, None, :3]

    def marker_poses(self, row):
        """Return the pose of the goal for viewer and films."""
        return {"goal": self.formulas.goal[row].cpu().numpy().copy()}


class Follow(interface.Task):
    """Follow a moving goal with the tool."""

    name, config_type, goal_set_type = "follow", FollowConfig, ReachGoalSet
    goal_format, cache_folder = 1, "follow-1"
    fields = (GOAL, ObservationField("time", 1, GOAL.mask))  # an input [s] of this task alone

    def sample(self, robot, config, **options):
        """Sample configurations, which are starts, and their tool poses, which are goals."""
        return REACH.sample(robot, ReachConfig(num_goals=config.num_goals), **options)

    def certify(self, goals, robot, scene):
        """Return the faults of a goal set."""
        return REACH.certify(goals, robot, scene)

    def make_envs(self, specs, env_spec_index, num_joints):
        """Make the environments of a batch."""
        return FollowEnvs(specs, env_spec_index, num_joints)

    def markers(self, config, goals):
        """Return a ball with the radius of success."""
        return (interface.Marker("goal", "frame", (2 * config.near,) * 3),)


TASKS.register(Follow())

if __name__ == "__main__":
    raise SystemExit(main())

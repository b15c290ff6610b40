"""A task of your own, follow a moving goal, with which the script runs the command line.

    python examples/09_custom_task.py train ur5-stick task=follow --out runs/1
    python examples/09_custom_task.py play follow ur5-stick --policy runs/1 --out 1.mp4

Prints what the command prints. Goal sets are those of reach; `11_goal_set.py` samples its own.
"""

from dataclasses import dataclass

import torch

from morphgen.cli import main
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.envs import ReachEnvs
from morphgen.tasks.reach.task import Reach
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import GOAL, ObservationField, StepResult


@dataclass(frozen=True)
class FollowConfig(ReachConfig):
    """Constants of the task, besides those of reach."""

    task = "follow"
    max_episode_steps: int = 200
    near: float = 0.05
    radius: float = 0.05  # of the horizontal circle on which the goal moves [m]
    period: float = 4.0  # duration of a turn of the goal [s]


class FollowEnvs(ReachEnvs):
    """The k environments of a batch that follow a goal; every tensor has k rows."""

    def __init__(self, specs, env_spec_index, num_joints):
        super().__init__(specs, env_spec_index, num_joints)
        self.config = specs[0].config
        self.first, self.time = torch.zeros_like(self.goal), torch.zeros_like(self.goal[:, 0])

    def begin(self, mask, random, layout):
        """Begin episodes where the mask is set; circles begin at goals of the robots' sets."""
        begun = super().begin(mask, random, layout)
        self.first, self.time = self.goal.where(mask[:, None], self.first), self.time * ~mask
        return begun

    def evaluate(self, state):
        """Move the goals on, and compare the tools with them."""
        self.time += CONTROL_PERIOD
        angle = 2 * torch.pi * self.time / self.config.period
        circle = torch.stack([torch.cos(angle) - 1, torch.sin(angle)], dim=1)
        self.goal[:, :2] = self.first[:, :2] + self.config.radius * circle
        distance = (state.tool - self.goal[:, :3]).norm(dim=1)
        success = (distance < self.config.near) & ~state.diverged
        terms = {"distance": -distance, "near": 0.1 * success.float()}
        return StepResult(success, torch.zeros_like(success), distance, success.float(), terms)

    def observe(self, block_pose):
        """Return the goal, in the field that policies know from reach, and the time."""
        return {"goal": self.goal, "time": self.time[:, None]}


class Follow(Reach):
    """Follow a moving goal with the tool."""

    name, config_type, cache_folder = "follow", FollowConfig, "follow-1"
    fields = (GOAL, ObservationField("time", 1, GOAL.mask))  # an input [s] of this task alone

    def make_envs(self, specs, env_spec_index, num_joints):
        """Make the environments of a batch."""
        return FollowEnvs(specs, env_spec_index, num_joints)


TASKS.register(Follow())

if __name__ == "__main__":
    raise SystemExit(main())

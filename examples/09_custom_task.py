"""A task outside of morphgen: follow a goal that moves on a circle with the tool.

The script registers the task and runs the command line, so that every command knows the task:

    python examples/custom_task.py train ur5-stick task=follow --sim mujoco --steps 2e5 --out runs/1
    python examples/custom_task.py eval runs/1
    python examples/custom_task.py play follow ur5-stick --policy runs/1 --sim mujoco --out 1.mp4
    python examples/custom_task.py view
"""

import sys
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import torch

from morphgen.model.kinematics import frame_pose
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.registry import TASKS
from morphgen.tasks.rows import padded_rows, row_norms
from morphgen.tasks.sim.base import CONTROL_PERIOD, Block, Scene
from morphgen.tasks.task import GOAL, Marker, ObservationField, StepResult, Task, TaskEnvs

TIME = ObservationField("time", 1, GOAL.mask)  # an input [s] that only this task has


@dataclass(frozen=True)
class FollowConfig:
    """Constants of the task."""

    task: ClassVar[str] = "follow"
    max_episode_steps: int = 200
    """Duration of an episode [control steps]."""
    num_goals: int = 20
    """Number of starts in a robot's goal set."""
    radius: float = 0.05
    """Radius of the horizontal circle on which the goal moves [m]."""
    period: float = 4.0
    """Duration of a turn of the goal [s]."""
    near: float = 0.05
    """Distance between tool and goal that counts as success [m]."""
    obstacles: int = 0
    obstacle_size: tuple[float, float] = (0.06, 0.15)
    train_layouts: int = 1
    eval_layouts: int = 1


@dataclass(frozen=True, eq=False)
class FollowSet:
    """Starts of a robot: free configurations, and the tool poses where its circles begin."""

    start_belongs_to_goal: ClassVar[bool] = False
    not_compared: ClassVar[frozenset[str]] = frozenset(("robot",))

    robot: str
    key: str
    q: np.ndarray
    goal_poses: np.ndarray
    tried: int
    accepted: int
    seed: int
    obstacles: tuple[Block, ...] = ()
    layouts: np.ndarray = field(default_factory=lambda: np.zeros((0, 0, 7)))
    usable: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), bool))


class FollowEnvs(TaskEnvs):
    """Environments that follow a goal."""

    def __init__(self, specs, spec, num_joints):
        self.config, self.spec = specs[0].config, spec
        self.count = [len(each.goals.q) for each in specs]
        self.q = padded_rows([each.goals.q for each in specs], num_joints, spec.device)
        self.poses = padded_rows([each.goals.goal_poses for each in specs], 7, spec.device)
        self.first = torch.zeros(len(spec), 7, device=spec.device)
        self.time = torch.zeros(len(spec), device=spec.device)

    def begin(self, rows, random, layouts):
        """Begin at a start of the robot's set, the tool at the goal."""
        spec = self.spec[rows]
        pairs = zip(random, spec.tolist(), strict=True)
        start = torch.tensor([stream.integers(self.count[i]) for stream, i in pairs])
        self.first[rows], self.time[rows] = self.poses[spec, start], 0.0
        return self.q[spec, start], torch.zeros(len(rows), 7, device=spec.device)

    @property
    def goal(self):
        """Pose of the goal now, shape (k, 7)."""
        goal, angle = self.first.clone(), 2 * np.pi * self.time / self.config.period
        circle = torch.stack([torch.cos(angle) - 1, torch.sin(angle)], dim=1)
        goal[:, :2] += self.config.radius * circle
        return goal

    def evaluate(self, state):
        """Move the goal on, and compare the tool with it."""
        self.time += CONTROL_PERIOD
        distance = row_norms(state.tool - self.goal[:, :3])
        success = (distance < self.config.near) & ~state.diverged
        terms = {"distance": -distance, "near": 0.1 * success.float()}
        return StepResult(success, torch.zeros_like(success), distance, success.float(), terms)

    def observe(self, block_pose):
        """Return the goal, in the field that policies know from reach."""
        return {"goal": self.goal, "time": self.time[:, None]}

    def target_points(self, block_pose):
        """Return the goal's position, for the kinematic channels of observations."""
        return self.goal[:, None, :3]

    def marker_poses(self, row):
        """Return the pose of the goal."""
        return {"goal": self.goal[row].cpu().numpy()}


class Follow(Task):
    """Follow a moving goal with the tool."""

    name, config_type, goal_set_type = "follow", FollowConfig, FollowSet
    goal_format, cache_folder, fields = 1, "follow-1", (GOAL, TIME)

    def sample(self, robot, config, *, obstacles, ground, seeds, identity):
        """Sample free configurations."""
        space, rng = FreeSpace(Scene(robot, ground=ground)), np.random.default_rng(seeds)
        q, tried = space.sample(config.num_goals, rng)
        poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (len(q), 1))
        poses[:, :3] = frame_pose(robot, q)[:, :3, 3]
        return FollowSet(q=q, goal_poses=poses, tried=tried, accepted=len(q), **identity)

    def certify(self, goals, robot, scene):
        """Test that the starts are free of collisions."""
        hits = np.flatnonzero(~FreeSpace(scene).free(goals.q))
        return [f"goal {i}: its configuration is in collision" for i in hits]

    def make_envs(self, specs, spec, num_joints):
        """Make the environments of a batch."""
        return FollowEnvs(specs, spec, num_joints)

    def markers(self, config, goals):
        """Return a ball with the radius of success."""
        return (Marker("goal", "frame", (2 * config.near,) * 3),)


TASKS.register(Follow())

if __name__ == "__main__":
    from morphgen.cli import main

    sys.exit(main())

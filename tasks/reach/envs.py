"""Environments of reach as tensors: goals, rewards and scores of every step."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.kinematics_torch import matrix_from_quaternion
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.random_numbers import EpisodeRandom, Stream
from morphgen.tasks.rows import GoalChoices, angles_between, choose, padded_rows, row_norms
from morphgen.tasks.task import A, EnvSpec, StepFormulas, StepResult, TaskEnvs, TaskState


class ReachFormulas(StepFormulas[A]):
    """Compares tools with goals: poses (k, 7), and rotations (k, 3, 3) if these count."""

    def __init__(self, config: ReachConfig, goal: A, goal_rotation: A | None) -> None:
        self._config = config
        self._goal: A = goal
        self._goal_rotation: A | None = goal_rotation

    def evaluate(self, state: TaskState[A]) -> StepResult[A]:
        """Compare the tools with their goals (paper; ``rotation`` is ours)."""
        config = self._config
        distance, angle = row_norms(state.tool - self._goal[..., :3]), None
        near = distance < config.near
        terms = {
            "joint_limits": -config.joint_limit_weight * state.limit_violation,
            "joint_acceleration": -config.joint_acceleration_weight * state.acceleration,
            "distance": -config.distance_weight * distance,
        }
        if state.tool_rotation is not None and self._goal_rotation is not None:
            angle = angles_between(state.tool_rotation, self._goal_rotation)
            near = near & (angle < config.near_angle)
        terms["near"] = choose(near, config.near_weight)
        if angle is not None:
            terms["rotation"] = -config.rotation_weight * config.metres_per_radian * angle
        far = -config.score_square * (distance * distance)
        return StepResult(
            success=near & ~state.diverged,
            terminated=state.diverged & ~state.diverged,  # never: an episode lasts until its limit
            distance=distance,
            score=choose(near, config.score_near, far),
            terms=terms,
            angle=angle,
        )

    def observe(self, object_pose: A) -> dict[str, A]:
        """Return the goals."""
        return {"goal": self._goal}


class ReachEnvs(TaskEnvs):
    """Environments that reach for goals of their robots' goal sets."""

    def __init__(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> None:
        """Set up; arguments as of ``Task.make_envs``."""
        self._config: ReachConfig = specs[0].config  # type: ignore[assignment]  # its own type
        self._env_spec_index = env_spec_index
        sets = [spec.goals for spec in specs]
        device = env_spec_index.device
        self._choices = GoalChoices(sets, 2, env_spec_index)
        # Numbers of the goals that a start and a goal cannot be: none, and the start.
        self._excluded = torch.tensor([0, 1], device=device)
        self._q = padded_rows([goals.q for goals in sets], num_joints, device)
        self._poses = padded_rows([goals.goal_poses for goals in sets], 7, device)
        self.goal = torch.zeros(len(env_spec_index), 7, device=device)
        """Goal pose of the tool, shape (k, 7)."""
        self.goal_configuration = torch.zeros(len(env_spec_index), num_joints, device=device)
        """Joint positions that bring the tool to its goal, shape (k, J)."""
        self.needs_tool_rotation = self._config.goal == "pose"
        self._goal_rotation = torch.eye(3, device=device).repeat(len(env_spec_index), 1, 1)
        self.formulas = ReachFormulas(self._config, self.goal, self.target_rotations())

    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, layout: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw a start and another goal of each robot's set that the layout leaves free."""
        count = self._choices.count(layout)[:, None]
        # The second number counts on from the first: it is never the same, modulo the count.
        numbers = random.integers(Stream.START, count - self._excluded)
        numbers[:, 1] += numbers[:, 0] + 1  # drawn below count - 1
        pair = self._choices.goals(layout, numbers % count)
        q = self._q[self._env_spec_index[:, None], pair]
        pose = self._poses[self._env_spec_index, pair[:, 1]]
        rows = mask[:, None]
        self.goal_configuration.copy_(torch.where(rows, q[:, 1], self.goal_configuration))
        self.goal.copy_(torch.where(rows, pose, self.goal))
        if self.needs_tool_rotation:
            rotation = matrix_from_quaternion(self.goal[:, 3:])
            self._goal_rotation.copy_(torch.where(rows[..., None], rotation, self._goal_rotation))
        return q[:, 0], torch.zeros_like(self.goal)

    def target_rotations(self) -> torch.Tensor | None:
        """Return the goals' rotation matrices, shape (k, 3, 3); None for goals of positions."""
        return self._goal_rotation if self.needs_tool_rotation else None

    def target_points(self, object_pose: torch.Tensor) -> torch.Tensor:
        """Return the position of the goal."""
        return self.goal[:, None, :3]

    def marker_poses(self, row: int) -> dict[str, NDArray[np.float32]]:
        """Return the pose of the goal."""
        return {"goal": np.array(self.goal[row].cpu().numpy())}

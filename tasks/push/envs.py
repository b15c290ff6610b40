"""Environments of push as tensors: starts, curriculum, rewards and scores of every step."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.tasks.configs import PushConfig
from morphgen.tasks.observation import box_tokens
from morphgen.tasks.random_numbers import EpisodeRandom, Stream
from morphgen.tasks.rows import (
    GoalChoices,
    choose,
    namespace_of,
    padded_rows,
    positive_part,
    row_norms,
)
from morphgen.tasks.task import (
    A,
    EnvSpec,
    ObjectTaskConfig,
    StepFormulas,
    StepResult,
    TaskEnvs,
    TaskState,
)

GAP = 0.05
"""Distance from a face of an object to the point before contact [m], tuned on arm3 and ee-arm."""


class PushFormulas(StepFormulas[A]):
    """Compares blocks with lines, y (k,) [m], which they must cross; blocks have tokens (k, 13)."""

    def __init__(self, config: PushConfig, line: A, tokens: A) -> None:
        self._config = config
        self._line: A = line
        self._shape: A = tokens[..., 7:]

    def evaluate(self, state: TaskState[A]) -> StepResult[A]:
        """Compare the blocks with their lines."""
        y = state.object_pose[..., 1]
        to_go = positive_part(self._line - y)
        return moving_result(self._config, state, to_go, y > self._line, state.object_pose[..., :3])

    def observe(self, object_pose: A) -> dict[str, A]:
        """Return the blocks and their lines."""
        block = namespace_of(object_pose).concatenate([object_pose, self._shape], -1)
        return {"object": block, "line": self._line[..., None]}


class PushEnvs(TaskEnvs):
    """Environments that push the blocks of their robots' push sets."""

    def __init__(
        self, specs: Sequence[EnvSpec], env_spec_index: torch.Tensor, num_joints: int
    ) -> None:
        """Set up with the line at its final position; arguments as of ``Task.make_envs``."""
        self._config: PushConfig = specs[0].config  # type: ignore[assignment]  # its own type
        sets: list[Any] = [spec.goals for spec in specs]  # each a PushStartSet
        device = env_spec_index.device
        self._env_spec_index = env_spec_index
        self._choices = GoalChoices(sets, 1, env_spec_index)
        self._q = padded_rows([pushes.q for pushes in sets], num_joints, device)
        self._blocks = padded_rows([pushes.blocks for pushes in sets], 7, device)
        self._final_line = torch.tensor([pushes.line for pushes in sets], device=device)[
            env_spec_index
        ]
        self._size = torch.tensor([pushes.block.size for pushes in sets], device=device)[
            env_spec_index
        ]
        # Centre of the line along x, and height of the ground, of each set [m].
        self._line_centres = [
            (np.ptp(pushes.blocks[:, 0]) / 2 + pushes.blocks[:, 0].min(), pushes.ground)
            for pushes in sets
        ]
        self.line = self._final_line.clone()  # current y that the block must cross, shape (k,) [m]
        tokens = box_tokens(self._size.new_zeros(len(self._size), 7), self._size)
        self.formulas = PushFormulas(self._config, self.line, tokens)

    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, layout: torch.Tensor | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw starts of the robots' sets that the layout leaves possible."""
        number = random.integers(Stream.START, self._choices.count(layout))
        start = self._choices.goals(layout, number[:, None])[:, 0]
        return self._q[self._env_spec_index, start], self._blocks[self._env_spec_index, start]

    def target_points(self, object_pose: torch.Tensor) -> torch.Tensor:
        """Return a point behind the block, its centre, and its centre beyond the line."""
        centre = object_pose[:, :3]
        behind, beyond = centre.clone(), centre.clone()
        behind[:, 1] -= self._size[:, 1] / 2 + GAP
        beyond[:, 1] = self.line + GAP
        return torch.stack([behind, centre, beyond], dim=1)

    def marker_poses(self, row: int) -> dict[str, NDArray[np.float32]]:
        """Return the pose of the line."""
        x, ground = self._line_centres[int(self._env_spec_index[row])]
        pose = (x, float(self.line[row]), ground, 1.0, 0.0, 0.0, 0.0)
        return {"line": np.array(pose, dtype=np.float32)}

    def advance(self, progress: float) -> None:
        """Move the line according to the curriculum."""
        self.line.copy_(self._final_line * curriculum_part(self._config, progress))

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Return the position of the line."""
        return {"line": self.line.clone()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Restore the position of the line."""
        self.line.copy_(state["line"])


def moving_result(
    config: ObjectTaskConfig, state: TaskState[A], to_go: A, has_arrived: A, point: A
) -> StepResult[A]:
    """Return the result of a step of moving an object, with the reward terms of push (paper).

    They depend on the distances of the object from its goal, (k,), and of the tool from a point of
    the object, (k, 3) [m].
    """
    success = has_arrived & ~state.diverged
    return StepResult(
        success=success,
        terminated=success & ~state.diverged,
        distance=to_go,
        score=choose(success, 1.0),
        terms={
            "joint_limits": -config.joint_limit_weight * state.limit_violation,
            "distance": -config.distance_weight * to_go,
            "approach": -config.approach_weight * row_norms(state.tool - point),
            "success": choose(success, config.success_weight),
        },
    )


def curriculum_part(config: ObjectTaskConfig, progress: float) -> float:
    """Return the part of the way that is a success at a progress of the training, 0 to 1."""
    steps = config.curriculum_steps
    # Twice: during the first half. The summand keeps k / steps from being rounded down.
    reached = min(math.floor(2 * progress * steps + 1e-9), steps) / steps
    return config.curriculum_start + (1 - config.curriculum_start) * reached

"""The state of a batch after a step, and its evaluation by a task."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # tasks are also used by processes that need no torch, which is slow to load
    import torch


@dataclass(frozen=True, eq=False)
class TaskState:
    """State after a step for its evaluation: rows of k environments; positions in root frames."""

    tool: torch.Tensor
    """Position of the tool, shape (k, 3) [m]."""
    block_pose: torch.Tensor
    """Pose of the block, shape (k, 7); zeros if there is none."""
    limit_violation: torch.Tensor
    """Sum over joints of their distance outside of the limits, shape (k,) [rad and m]."""
    acceleration: torch.Tensor
    """Sum over joints of the absolute mean acceleration in the step, shape (k,)."""
    diverged: torch.Tensor
    """Whether the simulation diverged, shape (k,), bool; such a step is never a success."""
    tool_rotation: torch.Tensor | None = None
    """Rotation matrix of the tool, shape (k, 3, 3); None if no task ``needs_tool_rotation``."""


@dataclass(frozen=True, eq=False)
class StepResult:
    """Result of a step: rows of k environments."""

    success: torch.Tensor
    """Whether the task is fulfilled, shape (k,), bool."""
    terminated: torch.Tensor
    """Whether the task ends the episode, shape (k,), bool."""
    distance: torch.Tensor
    """Distance from success, shape (k,) [m]."""
    score: torch.Tensor
    """Score of the step, shape (k,); see ``Task.episode_score``."""
    terms: dict[str, torch.Tensor]
    """Weighted reward terms by name, each of shape (k,); the reward is their sum."""
    angle: torch.Tensor | None = None
    """Angle from success, shape (k,) [rad]; None if the task wants no orientation."""


@dataclass(frozen=True, eq=False)
class NumpyRow:
    """The formulas of one environment of a task in NumPy."""

    evaluate: Callable[[TaskState], StepResult]
    """``TaskEnvs.evaluate`` of a state whose values are vectors and bools of NumPy and numbers:
    those of ``TaskState`` without the axis of rows. The result has numbers, too."""
    observe: Callable[[NDArray[np.float32]], dict[str, NDArray[np.float32]]]
    """``TaskEnvs.observe`` of the pose of the block, shape (7,), in arrays that the caller owns."""

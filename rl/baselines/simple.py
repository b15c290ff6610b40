"""Baselines that ignore the observation: zero and random actions."""

from __future__ import annotations

import torch

from morphgen.tasks.actions import BINS, encode_actions
from morphgen.tasks.batch import TaskBatch


class Zero:
    """Keeps all joint targets where they are."""

    def __init__(self, seed: int = 0) -> None:
        """Ignore the seed: nothing is random."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions that change no target, shape (n, L)."""
        mask = task.action_mask
        return encode_actions(torch.zeros(mask.shape, device=mask.device), task.action_kind)


class Random:
    """Draws every action from a uniform distribution."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions (n, L), uniform over [-1, 1] or over the bins."""
        if task.action_kind == "discrete":
            actions = torch.randint(len(BINS), task.action_mask.shape, generator=self._generator)
        else:
            actions = 2 * torch.rand(task.action_mask.shape, generator=self._generator) - 1
        return actions.to(task.action_mask.device)

"""The baselines that do not look at anything: no action, and random actions."""

from __future__ import annotations

import torch

from morphgen.tasks.actions import actions_of
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.config import BINS


class Zero:
    """Does nothing."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions that change no target, shape (n, L)."""
        return actions_of(torch.zeros(task.mask.shape, device=task.mask.device), task.kind)


class Random:
    """Draws every action uniformly, from a random stream of its own."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions (n, L), uniform over [-1, 1] or over the bins."""
        if task.kind == "discrete":
            drawn = torch.randint(len(BINS), task.mask.shape, generator=self._generator)
        else:
            drawn = 2 * torch.rand(task.mask.shape, generator=self._generator) - 1
        return drawn.to(task.mask.device)

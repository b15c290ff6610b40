"""The baselines that ignore the observation: no action, and random actions."""

from __future__ import annotations

import torch

from morphgen.tasks.actions import actions_of
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.config import BINS


class Zero:
    """Keeps all joint targets where they are."""

    def __init__(self, seed: int = 0) -> None:
        """Ignore the seed: nothing is random."""

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
            actions = torch.randint(len(BINS), task.mask.shape, generator=self._generator)
        else:
            actions = 2 * torch.rand(task.mask.shape, generator=self._generator) - 1
        return actions.to(task.mask.device)

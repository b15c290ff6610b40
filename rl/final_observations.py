"""The last observations of the episodes that were truncated in a rollout."""

from __future__ import annotations

import torch

from morphgen.tasks.host import is_host
from morphgen.tasks.observation import Observation


class FinalObservations:
    """Collects observations step by step, and returns the rows of truncated episodes at the end.

    On a GPU nothing is read before the end, so that a rollout never waits for it; until then the
    observations of all environments stay in memory.
    """

    def __init__(self) -> None:
        self._observations: list[Observation] = []
        self._truncated: list[torch.Tensor] = []

    def add(self, observation: Observation, truncated: torch.Tensor) -> None:
        """Add a step.

        Args:
            observation: Observation after the action, tensors (n, ...), which are copied.
            truncated: Whether the episode was truncated, shape (n,), bool.
        """
        reads = is_host(truncated.device)
        self._observations.append(
            {n: value[truncated] if reads else value.clone() for n, value in observation.items()}
        )
        self._truncated.append(truncated.clone())

    def gather(self) -> Observation:
        """Return the rows of the k truncated episodes, tensors (k, ...) in the order of steps."""
        steps = self._observations
        if is_host(self._truncated[0].device):
            return {name: torch.cat([step[name] for step in steps]) for name in steps[0]}
        truncated = torch.stack(self._truncated)
        counts = truncated.sum(dim=1).tolist()
        rows = torch.split(torch.nonzero(truncated)[:, 1], counts)
        return {
            name: torch.cat([step[name][row] for step, row in zip(steps, rows, strict=True)])
            for name in steps[0]
        }

"""A trained actor as a controller."""

from __future__ import annotations

from typing import Any, Literal

import torch

from morphgen.rl.config import PolicyConfig
from morphgen.rl.policies import (
    layout_from,
    layout_of,
    make_networks,
    require_layout,
    rows_needed,
    with_all_rows,
    with_rows,
)
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.observation import Observation

Mode = Literal["deterministic", "stochastic"]
MODES: tuple[Mode, ...] = ("deterministic", "stochastic")
"""A policy acts by the mean of its actions, or draws."""


class Policy:
    """A trained actor as a controller."""

    def __init__(
        self, checkpoint: dict[str, Any], mode: Mode, seed: int, device: str = "cpu"
    ) -> None:
        """Prepare.

        Args:
            checkpoint: What a learner was.
            mode: Whether it acts by the mean of its actions, or draws.
            seed: Of what it draws.
            device: Where the network is.
        """
        self._layout = layout_from(checkpoint["layout"])
        self._device = torch.device(device)
        self._config = PolicyConfig(**checkpoint["policy"])
        actor, _ = make_networks(self._config, self._layout, 0)
        actor.load_state_dict(checkpoint["actor"])
        self._actor = actor.to(self._device).eval()
        self._steady = mode == "deterministic"
        self._generator = torch.Generator(self._device).manual_seed(seed)

    def require(self, observation: Observation) -> None:
        """Require observations as those that it was trained with.

        Raises:
            TaskError: If they are others.
        """
        require_layout(self._layout, layout_of(observation), "the checkpoint")

    @torch.no_grad()
    def act(self, task: TaskBatch) -> torch.Tensor:
        """Actions, shape (n, L).

        Raises:
            TaskError: If the batch has other observations than the policy was made for.
        """
        seen = task.observe()
        self.require(seen)
        needed = with_rows(seen, rows_needed(self._config, seen))
        head = self._actor.distribution({k: v.to(self._device) for k, v in needed.items()})
        chosen = head.middle() if self._steady else head.sample(self._generator)
        return with_all_rows(chosen, self._layout.links).to(task.device)

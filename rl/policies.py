"""Actor and critic: an agent's networks with distributions of actions, and with values."""

from __future__ import annotations

import numpy as np
import torch
from torch import nn

from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS
from morphgen.rl.agents.encoder import Network
from morphgen.rl.config import PolicyConfig
from morphgen.rl.heads import Head, MaskedGaussian, MaskedMultiDiscrete, bounded_log_std
from morphgen.rl.observation_layout import Layout, last_link
from morphgen.tasks.actions import BINS
from morphgen.tasks.observation import Observation


class Actor(nn.Module):
    """The policy: a distribution of actions for each observation."""

    def __init__(self, config: PolicyConfig, layout: Layout) -> None:
        super().__init__()
        self.discrete = config.discrete
        self.network: Network = AGENTS[config.agent].network(
            config, layout, len(BINS) if config.discrete else 1, per_link=True
        )
        self.scale = self.network.logit_scale if config.discrete else 1.0
        with torch.no_grad():
            self.network.last.weight.div_(self.scale)
        if not config.discrete:
            self.raw_log_std = nn.Parameter(
                torch.zeros(layout.links), requires_grad=not config.fixed_std
            )

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return numbers for ``head``: (n, L, 11) for discrete actions, else (n, L, 1), float32."""
        numbers: torch.Tensor = self.scale * self.network(observation).float()
        return torch.where(observation["actions"][..., None], numbers, 0.0)

    def head(self, numbers: torch.Tensor, mask: torch.Tensor) -> Head:
        """Return the distribution of actions, from ``forward`` and the movable links (n, L)."""
        if self.discrete:
            return MaskedMultiDiscrete(numbers, mask)
        log_std = bounded_log_std(self.raw_log_std[: mask.shape[1]])
        return MaskedGaussian(numbers[..., 0], log_std, mask)

    def distribution(self, observation: Observation) -> Head:
        """Return the distribution of actions."""
        return self.head(self(observation), observation["actions"])


class Critic(nn.Module):
    """The value function: the expected return of each observation, on one scale for all robots."""

    def __init__(self, config: PolicyConfig, layout: Layout) -> None:
        super().__init__()
        self.network: Network = AGENTS[config.agent].network(config, layout, 1, per_link=False)

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return values, shape (n,), float32."""
        values: torch.Tensor = self.network(observation).float()
        return values[:, 0]


def make_networks(config: PolicyConfig, layout: Layout, seed: int) -> tuple[Actor, Critic]:
    """Build an actor and a critic on the CPU; the same seed gives the same weights.

    Raises:
        TaskError: If the config asks for the tool's position and the observations lack it, or the
            other way round.
    """
    if config.tool_position != layout.tool:
        shown = "show" if layout.tool else "do not show"
        raise TaskError(f"tool_position {config.tool_position}: the environments {shown} it")
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(
            int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1)
        )
        return Actor(config, layout), Critic(config, layout)


def rows_needed(config: PolicyConfig, observation: Observation) -> int:
    """Return how many rows of links the networks need.

    A network that does not need all links gets those up to the last one that some robot has: the
    others would not change its outputs, and would take time.
    """
    network: type[Network] = AGENTS[config.agent].network
    if network.needs_all_links:
        return observation["links"].shape[1]
    return last_link(observation)

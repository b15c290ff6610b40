"""The agents ``se`` and ``me-mlp``: all entities in one vector, through residual layers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import nn

from morphgen.rl.agents import NetworkConfig, encoder
from morphgen.rl.observation_layout import Layout
from morphgen.tasks.observation import Observation

if TYPE_CHECKING:
    from morphgen.rl.config import PolicyConfig


@dataclass(frozen=True)
class Config(NetworkConfig):
    """Sizes of the MLP; the paper gives none, these are those of its released code."""

    mlp_features: int = 16  # width of an encoded entity
    mlp_width: int = 192  # width of the residual layers
    mlp_layers: int = 3  # number of residual layers


class Network(encoder.Network):
    """An MLP with residual layers over the concatenated entities."""

    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        super().__init__(config, layout, outputs, per_link)
        sizes = config.network
        assert isinstance(sizes, Config)
        width = sizes.mlp_width
        self.entities = encoder.Entities(
            layout, sizes.mlp_features, proprioceptive_only=config.hides_morphology
        )
        self.enter = nn.Linear(self.entities.count * sizes.mlp_features, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU())
            for _ in range(sizes.mlp_layers)
        )
        self.norm = nn.LayerNorm(width)
        self.shape = (layout.links, outputs) if per_link else (outputs,)
        self.leave = encoder.last_layer(width, layout.links * outputs if per_link else outputs)

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return numbers of shape (n, L, outputs) per link, else (n, outputs)."""
        x = self.enter(self.entities(observation)[0].flatten(1))
        for layer in self.layers:
            x = x + layer(x)
        numbers: torch.Tensor = self.leave(self.norm(x))
        return numbers.reshape(-1, *self.shape)

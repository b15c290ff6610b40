"""The agent ``me-tf``: a transformer over the entities, decoded link by link."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from morphgen.errors import TaskError
from morphgen.rl.agents import NetworkConfig, encoder
from morphgen.rl.observation_layout import Layout
from morphgen.tasks.observation import Observation

if TYPE_CHECKING:
    from morphgen.rl.config import PolicyConfig


@dataclass(frozen=True)
class Config(NetworkConfig):
    """Sizes of the transformer; unless said otherwise those of the paper's released code."""

    features: int = 64  # width of an encoded entity
    layers: int = 4  # number of transformer layers
    heads: int = 4  # attention heads per layer; they divide `features`
    feedforward: int = 512  # hidden width of a layer's feedforward part
    decoder: int = 64
    """Hidden width of the MLP from a link's features to its action, and to the value (ours)."""
    logit_scale: float = 64.0
    """Factor on the logits of discrete actions (ours): one optimiser step moves probabilities by as
    much more. The MLP learns less with it and has none."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.features % self.heads:
            raise TaskError(f"features {self.features}: expected a multiple of heads {self.heads}")


class Network(encoder.Network):
    """Entities attend to each other; a small MLP reads each link, or the mean of all links."""

    needs_all_entries = False

    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        super().__init__(config, layout, outputs, per_link)
        sizes = config.network
        assert isinstance(sizes, Config)
        features = sizes.features
        self.scale = sizes.logit_scale if per_link and config.discrete else 1.0
        self.entities = encoder.Entities(
            layout, features, proprioceptive_only=config.hides_morphology
        )
        self.index = nn.Parameter(0.02 * torch.randn(layout.links, features))
        self.blocks = nn.ModuleList(
            Block(features, sizes.heads, sizes.feedforward) for _ in range(sizes.layers)
        )
        self.decode = nn.Sequential(
            nn.LayerNorm(features),
            nn.Linear(features, sizes.decoder),
            nn.GELU(),
            encoder.last_layer(sizes.decoder, outputs, self.scale),
        )

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return numbers of shape (n, L, outputs) per link, else (n, outputs).

        L may be less than what the network was built for, if no robot uses the links beyond.
        """
        x, mask = self.entities(observation)
        links = observation["links"].shape[1]
        x = x + functional.pad(self.index[:links], (0, 0, 0, x.shape[1] - links))
        for block in self.blocks:
            x = block(x, mask)
        x = x[:, :links]
        if not self.per_link:
            present = mask[:, :links, None]
            x = torch.where(present, x, 0.0).sum(dim=1) / present.sum(dim=1)
        numbers: torch.Tensor = self.scale * self.decode(x)
        return numbers


class Block(nn.Module):
    """A transformer layer, normalised before each half (Xiong et al. 2020)."""

    def __init__(self, features: int, heads: int, feedforward: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(features)
        self.qkv = nn.Linear(features, 3 * features)
        self.merge = nn.Linear(features, features)
        self.feedforward = nn.Sequential(
            nn.LayerNorm(features),
            nn.Linear(features, feedforward),
            nn.GELU(),
            nn.Linear(feedforward, features),
        )

    def forward(self, x: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
        """Mix x (n, T, features); tokens outside of the mask (n, T) are not attended to."""
        qkv = self.qkv(self.norm_attention(x)).unflatten(2, (3, self.heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        mixed = attend(q, k, v, mask)
        x = x + self.merge(mixed.transpose(1, 2).flatten(2))
        mixed_features: torch.Tensor = x + self.feedforward(x)
        return mixed_features


def attend(q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    """Return the attention (Vaswani et al. 2017, equation 1) to the tokens of a mask (n, T).

    Queries, keys and values have the shape (n, heads, T, features of a head); the mask has a token.
    """
    if q.device.type == "cpu":
        return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask[:, None, None])
    return attend_to_few(q, k, v, mask)


def attend_to_few(
    q: torch.Tensor, k: torch.Tensor, v: torch.Tensor, mask: torch.Tensor
) -> torch.Tensor:
    """Return the same as ``attend``, computed with two matrix products.

    Fused attention kernels of GPUs are made for long sequences: for a dozen tokens they take
    several times as long.
    """
    scores = (q @ k.transpose(-2, -1)) / math.sqrt(q.shape[-1])
    weights = torch.where(mask[:, None, None], scores, -torch.inf).softmax(dim=-1)
    return weights.to(v.dtype) @ v

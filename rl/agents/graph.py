"""The agent ``me-graph``: a small transformer with one token per actuated joint.

    description (shape, axis, origin, type) --MLP--+-----------------------------+
    state (channels, joint position) -------MLP----+--> + parent --> [attention] +--> head per joint
    goal, block, line, obstacles ----------linear------------------> [ + tree  ] +--> mean --> value

The description of a joint's link is encoded apart from the joint's state. Attention is biased by
the relation of two joints in the tree: their distance, as in GET-Zero (Patel and Song 2024), and
whether one is above the other. It is also biased by the cosine between their Jacobian columns, so
that joints that move the tool alike can share the work. Nothing depends on the number of a joint or
link, so that the weights fit robots of any size.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from morphgen.encoding.tokens import POSITION
from morphgen.encoding.tokens import TOOL_FLAG as TOOL
from morphgen.errors import TaskError
from morphgen.rl.agents import NetworkConfig, encoder
from morphgen.rl.observation_layout import Layout
from morphgen.tasks.observation import TREE_RELATIONS, Observation

if TYPE_CHECKING:
    from morphgen.rl.config import PolicyConfig

DESCRIPTION = slice(TOOL.start, POSITION.start)
"""Columns of a token that describe a link and its joint, without indices and joint position."""


@dataclass(frozen=True)
class Config(NetworkConfig):
    """Sizes of the graph network; tuned on reach with ten arm3 on two CPU cores."""

    graph_features: int = 32  # width of a joint's token
    graph_layers: int = 2  # number of attention layers
    graph_heads: int = 4  # attention heads per layer; they divide `graph_features`
    graph_hidden: int = 64  # hidden width of a layer's feedforward part and of the head

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.graph_features % self.graph_heads:
            raise TaskError(
                f"graph_features {self.graph_features}: expected a multiple of graph_heads "
                f"{self.graph_heads}"
            )


class Network(encoder.Network):
    """Joints attend to each other and to what is around them; one head reads every joint."""

    needs_all_entries = False
    shares_joints = True

    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        super().__init__(config, layout, outputs, per_link)
        sizes = config.network
        assert isinstance(sizes, Config)
        features, hidden = sizes.graph_features, sizes.graph_hidden
        self.channels = layout.channels
        self.vectors = tuple(name for name, _ in layout.vectors)
        self.hides_morphology = config.hides_morphology
        # The code of joint positions has high frequencies; ``joint`` has the position itself.
        self.reads_code = "joint" not in self.vectors
        size = len(self.channels) + sum(size for _, size in layout.vectors)
        self.state = nn.Linear(size + POSITION.size * self.reads_code, features)
        if self.reads_code:
            encoder.smooth_position_code(self.state, size)
        self.describe = nn.Sequential(
            nn.Linear(DESCRIPTION.stop - DESCRIPTION.start, features), nn.SiLU()
        )
        self.parent = nn.Linear(features, features, bias=False)
        self.context = encoder.Entities(layout, features, proprioceptive_only=False, links=False)
        self.relation = nn.Embedding(TREE_RELATIONS, sizes.graph_heads)
        self.alignment = nn.Parameter(torch.zeros(sizes.graph_heads))
        with torch.no_grad():
            self.relation.weight.zero_()
        self.blocks = nn.ModuleList(
            Block(features, sizes.graph_heads, hidden) for _ in range(sizes.graph_layers)
        )
        self.norm = nn.LayerNorm(features)
        self.head = nn.Sequential(
            nn.Linear(3 * features, hidden), nn.SiLU(), encoder.last_layer(hidden, outputs)
        )

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return numbers of shape (n, L, outputs) per link, else (n, outputs)."""
        joints = observation["joints"]
        exists, links = joints >= 0, joints.clamp(min=0)
        description, state = self._encoded(observation, links)
        x = functional.silu(description + state)
        x = x + self._of_parents(description, observation["joint_parents"])
        context, is_context = self.context(observation)
        tokens = torch.cat([x, context], dim=1)
        bias = self._bias(observation, links, torch.cat([exists, is_context], dim=1))
        for block in self.blocks:
            tokens = block(tokens, bias)
        mixed = self.norm(tokens[:, : joints.shape[1]])
        features = torch.cat([mixed, description, state], dim=-1)
        if not self.per_link:
            present = exists[..., None]
            features = (features * present).sum(dim=1) / present.sum(dim=1).clamp(min=1)
            numbers: torch.Tensor = self.head(features)
            return numbers
        numbers = self.head(features) * exists[..., None]
        rows = observation["links"].shape[1]
        at_links = numbers.new_zeros(len(joints), rows, self.outputs)
        return at_links.scatter_add(1, links[..., None].expand_as(numbers), numbers)

    def _encoded(
        self, observation: Observation, links: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Return encoded descriptions and states (n, K, features) of the joints of links (n, K)."""
        extra = [observation[name][..., None] for name in self.channels]
        extra += [observation[name] for name in self.vectors]
        tokens = observation["tokens"]
        if self.reads_code:
            extra.append(tokens[..., POSITION.columns])
        state = _rows(torch.cat(extra, dim=-1), links)
        description = _rows(tokens[..., DESCRIPTION], links)
        if self.hides_morphology:
            description = torch.zeros_like(description)
        return self.describe(description), self.state(state)

    def _of_parents(self, description: torch.Tensor, parents: torch.Tensor) -> torch.Tensor:
        """Return the projected descriptions of the joints above, zero where there is none."""
        above = _rows(self.parent(description), parents.clamp(min=0))
        return above * (parents >= 0)[..., None]

    def _bias(
        self, observation: Observation, links: torch.Tensor, mask: torch.Tensor
    ) -> torch.Tensor:
        """Return the bias of the attention between all tokens, shape (n, heads, T, T)."""
        K, T = links.shape[1], mask.shape[1]
        bias = self.relation(observation["joint_relations"]).permute(0, 3, 1, 2)
        if "jacobian" in self.vectors:
            columns = _rows(observation["jacobian"][..., :3], links)
            columns = columns / torch.linalg.vector_norm(columns, dim=-1, keepdim=True).clamp(
                min=1e-3
            )
            cosines = columns @ columns.transpose(1, 2)
            bias = bias + self.alignment[:, None, None] * cosines[:, None]
        bias = functional.pad(bias, (0, T - K, 0, T - K))
        return bias.masked_fill(~mask[:, None, None], -torch.inf)


class Block(nn.Module):
    """A transformer layer with a biased attention, normalised before each half."""

    def __init__(self, features: int, heads: int, hidden: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(features)
        self.qkv = nn.Linear(features, 3 * features)
        self.merge = nn.Linear(features, features)
        self.feedforward = nn.Sequential(
            nn.LayerNorm(features),
            nn.Linear(features, hidden),
            nn.SiLU(),
            nn.Linear(hidden, features),
        )

    def forward(self, x: torch.Tensor, bias: torch.Tensor) -> torch.Tensor:
        """Mix tokens x (n, T, features) with a bias of attention (n, heads, T, T)."""
        qkv = self.qkv(self.norm(x)).unflatten(2, (3, self.heads, -1))
        q, k, v = qkv.permute(2, 0, 3, 1, 4)
        scores = q @ k.transpose(-2, -1) / q.shape[-1] ** 0.5 + bias
        mixed = scores.softmax(dim=-1).to(v.dtype) @ v
        x = x + self.merge(mixed.transpose(1, 2).flatten(2))
        mixed_features: torch.Tensor = x + self.feedforward(x)
        return mixed_features


def _rows(values: torch.Tensor, index: torch.Tensor) -> torch.Tensor:
    """Return rows of values (n, L, k) by their numbers (n, K), shape (n, K, k)."""
    return torch.gather(values, 1, index[..., None].expand(-1, -1, values.shape[-1]))

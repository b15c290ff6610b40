"""Networks from observations to actions and values: an MLP and a transformer over tokens.

What a mask hides is replaced by zeros before anything else: it has no influence on an action, a
value or a gradient.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from morphgen.benchmark.token_layout import FREQUENCIES, POSITION
from morphgen.errors import TaskError
from morphgen.rl.attention import Block
from morphgen.rl.config import PolicyConfig
from morphgen.rl.heads import REST, Head, MaskedGaussian, MaskedMultiDiscrete, bounded_log_std
from morphgen.tasks.config import BINS
from morphgen.tasks.observation import Observation

CHANNELS = ("velocity", "previous_action")
"""Numbers of a link that an observation may have beside its token, in order."""
LINK_ROWS = ("tokens", "links", "actions", *CHANNELS)
"""Parts of an observation that have a row for each link."""
ENTITIES = ("links", "goal", "object", "line", "obstacles", "cloud")
"""Kinds of vectors, in the order of the vectors and of the rows of ``Entities.kind``.

Checkpoints have the rows in this order, without the kinds that a layout lacks."""
SMALL = 0.01
"""Scale of the last layer's weights at the start: all actions begin alike, values at zero."""


@dataclass(frozen=True)
class Layout:
    """Sizes and channels of observations that a network is made for."""

    links: int
    """Rows of tokens, L."""
    token: int
    """Numbers of a link's token."""
    obstacles: int
    """Rows of obstacle tokens, O."""
    points: int
    """Points of the cloud, P; 0 for no cloud."""
    channels: tuple[str, ...]
    """Those of ``CHANNELS`` that there are."""
    tool: bool = False
    """Whether the tool's position is seen."""


def layout_of(observation: Observation) -> Layout:
    """The layout of an observation."""
    return Layout(
        links=observation["tokens"].shape[1],
        token=observation["tokens"].shape[2],
        obstacles=observation["obstacles"].shape[1],
        points=observation["points"].shape[1] if "points" in observation else 0,
        channels=tuple(name for name in CHANNELS if name in observation),
        tool="tool" in observation,
    )


def require_layout(found: Layout, wanted: Layout, what: str) -> None:
    """Require that weights fit observations.

    Args:
        found: What the weights were made for.
        wanted: What they are to see.
        what: Where the weights are from, for the message.

    Raises:
        TaskError: If the layouts differ; it says in what.
    """
    theirs, ours = asdict(found), asdict(wanted)
    wrong = [
        f"{name} {theirs[name]}, here {ours[name]}" for name in ours if theirs[name] != ours[name]
    ]
    if wrong:
        raise TaskError(f"{what} is for other observations: {'; '.join(wrong)}")


def rows_needed(config: PolicyConfig, observation: Observation) -> int:
    """How many rows of links networks have to see.

    The transformer needs those up to the last link that some robot has. More would change nothing
    that it says (proved in its tests), and costs time. An MLP is made for all.
    """
    if config.agent != "me-tf":
        return observation["links"].shape[1]
    return int(torch.nonzero(observation["links"].any(dim=0)).max()) + 1


def with_rows(observation: Observation, rows: int) -> Observation:
    """The same with the first rows of links alone; tensors (n, L, ...) become (n, rows, ...)."""
    return {
        name: each[:, :rows] if name in LINK_ROWS else each for name, each in observation.items()
    }


def with_all_rows(actions: torch.Tensor, links: int) -> torch.Tensor:
    """Actions (n, rows) as the batch takes them, (n, L); further links rest."""
    rest = 0 if actions.is_floating_point() else REST
    return functional.pad(actions, (0, links - actions.shape[1]), value=rest)


class Entities(nn.Module):
    """Links, goal, object, line, obstacles and points as vectors of one size, links first.

    The code of a joint position has frequencies so high that a step of the joint is many periods:
    noise to a network that has not learned anything yet. Weights of a frequency begin in inverse
    proportion to it, so that the first policy is smooth.

    The tool's position is beside the goal and beside the object, in one vector with it: how far it
    is to go is then a difference of a vector's own numbers.
    """

    def __init__(self, layout: Layout, features: int, blind: bool) -> None:
        super().__init__()
        self.seen = POSITION.columns if blind else slice(0, layout.token)
        """Columns of the tokens that count."""
        link = self.seen.stop - self.seen.start + len(layout.channels)
        self.tool = layout.tool
        tool = 3 * layout.tool
        sizes = {"links": link, "goal": 7 + tool, "object": 13 + tool, "line": 1}
        if layout.obstacles:
            sizes["obstacles"] = 13
        self.cloud: nn.Module | None = None
        if layout.points:
            self.cloud = nn.Sequential(
                nn.Linear(3, features), nn.SiLU(), nn.Linear(features, features)
            )
            sizes["cloud"] = features
        self.channels = layout.channels
        self.project = nn.ModuleDict(
            {name: nn.Linear(size, features, bias=False) for name, size in sizes.items()}
        )
        smooth = torch.ones(link)
        first = POSITION.start - self.seen.start
        smooth[first : first + POSITION.size] = torch.from_numpy(
            FREQUENCIES[0] / FREQUENCIES
        ).repeat(2)
        with torch.no_grad():
            next(self.project["links"].parameters()).mul_(smooth)
        self.kinds = tuple(name for name in ENTITIES if name in sizes)
        """Name of each row of ``kind``."""
        self.kind = nn.Parameter(0.02 * torch.randn(len(self.kinds), features))
        self.count = layout.links + 3 + layout.obstacles + bool(layout.points)

    def forward(self, observation: Observation) -> tuple[torch.Tensor, torch.Tensor]:
        """Vectors (n, T, features), zeros where there is nothing, and where there is, (n, T)."""
        entries = self._entries(observation)
        vectors, masks = [], []
        for name, kind in zip(self.kinds, self.kind, strict=True):
            values, mask = entries[name]
            shown = torch.where(mask[..., None], values, 0.0)
            vectors.append(torch.where(mask[..., None], self.project[name](shown) + kind, 0.0))
            masks.append(mask)
        return torch.cat(vectors, dim=1), torch.cat(masks, dim=1)

    def _entries(self, seen: Observation) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Values (n, k, size) and masks (n, k) of each kind."""
        extra = [seen[name][..., None] for name in self.channels]
        links = torch.cat([seen["tokens"][..., self.seen], *extra], dim=-1)
        tool = [seen["tool"]] if self.tool else []
        reach, push = seen["goal_mask"][:, None], seen["object_mask"][:, None]
        entries = {
            "links": (links, seen["links"]),
            "goal": (torch.cat([seen["goal"], *tool], dim=-1)[:, None], reach),
            "object": (torch.cat([seen["object"], *tool], dim=-1)[:, None], push),
            "line": (seen["line"][:, None], push),
        }
        if "obstacles" in self.project:
            entries["obstacles"] = (seen["obstacles"], seen["obstacle_mask"])
        if self.cloud is not None:
            entries["cloud"] = _largest(self.cloud, seen["points"], seen["point_mask"])
        return entries


class MLP(nn.Module):
    """All entities in one vector, through residual layers."""

    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        super().__init__()
        width = config.mlp_width
        self.entities = Entities(layout, config.mlp_features, config.blind)
        self.enter = nn.Linear(self.entities.count * config.mlp_features, width)
        self.layers = nn.ModuleList(
            nn.Sequential(nn.LayerNorm(width), nn.Linear(width, width), nn.SiLU())
            for _ in range(config.mlp_layers)
        )
        self.norm = nn.LayerNorm(width)
        self.shape = (layout.links, outputs) if per_link else (outputs,)
        self.leave = _last(width, layout.links * outputs if per_link else outputs)

    @property
    def last(self) -> nn.Linear:
        """The layer that the numbers come from."""
        return self.leave

    def forward(self, observation: Observation) -> torch.Tensor:
        """Shape (n, L, outputs) or (n, outputs)."""
        x = self.enter(self.entities(observation)[0].flatten(1))
        for layer in self.layers:
            x = x + layer(x)
        found: torch.Tensor = self.leave(self.norm(x))
        return found.reshape(-1, *self.shape)


class Transformer(nn.Module):
    """Entities attend to each other; a small MLP reads each link, or the mean of all links."""

    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        super().__init__()
        features = config.features
        self.per_link = per_link
        self.entities = Entities(layout, features, config.blind)
        self.index = nn.Parameter(0.02 * torch.randn(layout.links, features))
        self.blocks = nn.ModuleList(
            Block(features, config.heads, config.feedforward) for _ in range(config.layers)
        )
        self.decode = nn.Sequential(
            nn.LayerNorm(features),
            nn.Linear(features, config.decoder),
            nn.GELU(),
            _last(config.decoder, outputs),
        )

    @property
    def last(self) -> nn.Linear:
        """The layer that the numbers come from."""
        layer = self.decode[-1]
        assert isinstance(layer, nn.Linear)
        return layer

    def forward(self, observation: Observation) -> torch.Tensor:
        """Shape (n, L, outputs) or (n, outputs); L may be less than what it was made for."""
        x, mask = self.entities(observation)
        links = observation["links"].shape[1]
        x = x + functional.pad(self.index[:links], (0, 0, 0, x.shape[1] - links))
        for block in self.blocks:
            x = block(x, mask)
        x = x[:, :links]
        if not self.per_link:
            there = mask[:, :links, None]
            x = torch.where(there, x, 0.0).sum(dim=1) / there.sum(dim=1)
        found: torch.Tensor = self.decode(x)
        return found


class Actor(nn.Module):
    """What a robot is to do, given what it sees."""

    def __init__(self, config: PolicyConfig, layout: Layout) -> None:
        super().__init__()
        self.discrete = config.discrete
        scaled = config.discrete and config.agent == "me-tf"
        self.scale = config.logit_scale if scaled else 1.0
        self.network = _network(config, layout, len(BINS) if config.discrete else 1, True)
        with torch.no_grad():
            self.network.last.weight.div_(self.scale)
        if not config.discrete:
            self.deviation = nn.Parameter(
                torch.zeros(layout.links), requires_grad=not config.fixed_deviation
            )

    def forward(self, observation: Observation) -> torch.Tensor:
        """Numbers of ``head``, shape (n, L, 11) for discrete actions, else (n, L, 1), float32."""
        found: torch.Tensor = self.scale * self.network(observation).float()
        return torch.where(observation["actions"][..., None], found, 0.0)

    def head(self, numbers: torch.Tensor, mask: torch.Tensor) -> Head:
        """The distribution of actions, from ``forward`` and the links that count (n, L)."""
        if self.discrete:
            return MaskedMultiDiscrete(numbers, mask)
        deviation = bounded_log_std(self.deviation[: mask.shape[1]])
        return MaskedGaussian(numbers[..., 0], deviation, mask)

    def distribution(self, observation: Observation) -> Head:
        """The distribution of actions."""
        return self.head(self(observation), observation["actions"])


class Critic(nn.Module):
    """What is to be expected, given what a robot sees; of the robot's whole batch in one scale."""

    def __init__(self, config: PolicyConfig, layout: Layout) -> None:
        super().__init__()
        self.network = _network(config, layout, 1, False)

    def forward(self, observation: Observation) -> torch.Tensor:
        """Values, shape (n,), float32."""
        found: torch.Tensor = self.network(observation).float()
        return found[:, 0]


def make_networks(config: PolicyConfig, layout: Layout, seed: int) -> tuple[Actor, Critic]:
    """An actor and a critic on the CPU; the same seed gives the same weights.

    Raises:
        TaskError: If they are to see the tool's position and the observations lack it, or the
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


def layout_from(stored: dict[str, Any]) -> Layout:
    """The layout that ``dataclasses.asdict`` once took apart."""
    return Layout(**{**stored, "channels": tuple(stored["channels"])})


def _largest(
    each: nn.Module, points: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Largest features of points (n, P, 3), as in PointNet (Qi et al. 2017): (n, 1, features)."""
    features = each(torch.where(mask[..., None], points, 0.0)).float()
    lowest = torch.finfo(features.dtype).min
    top = torch.where(mask[..., None], features, lowest).amax(dim=1, keepdim=True)
    return top, mask.any(dim=1, keepdim=True)


def _network(
    config: PolicyConfig, layout: Layout, outputs: int, per_link: bool
) -> MLP | Transformer:
    made = Transformer if config.agent == "me-tf" else MLP
    return made(config, layout, outputs, per_link)


def _last(inputs: int, outputs: int) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        layer.weight.mul_(SMALL)
        layer.bias.zero_()
    return layer

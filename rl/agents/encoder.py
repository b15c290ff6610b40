"""Encoder of observations and interface that the networks of all agents share.

Padding is replaced by zeros before anything else: it has no influence on actions, values or
gradients.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch
from torch import nn

from morphgen.encoding.tokens import FREQUENCIES, POSITION
from morphgen.rl.observation_layout import Layout
from morphgen.tasks.observation import Observation

if TYPE_CHECKING:
    from morphgen.rl.config import PolicyConfig

ENTITIES = ("links", "goal", "object", "line", "obstacles", "cloud")
"""Kinds of vectors, in the order of the vectors and of the rows of ``Entities.kind``.

Checkpoints have the rows in this order, without the kinds that a layout lacks; fields that tasks of
other packages declare come last."""
LAST_LAYER_SCALE = 0.01
"""Factor on the initial weights of the last layer, so that all actions start out almost equally
likely and values near zero."""


class Network(nn.Module, ABC):
    """A network from observations to numbers: for each link (actor), or one row (critic)."""

    needs_all_entries = True
    """Whether the network needs all rows of links, and goal, object and line for every task;
    otherwise rows and entries that no environment uses are left out."""
    shares_joints = False
    """Whether all joints share the weights of the head, and the standard deviation of actions."""

    @abstractmethod
    def __init__(self, config: PolicyConfig, layout: Layout, outputs: int, per_link: bool) -> None:
        """Build the network; ``outputs`` numbers ``per_link``, or for the whole observation."""
        super().__init__()
        self.outputs, self.per_link = outputs, per_link

    @abstractmethod
    def forward(self, observation: Observation) -> torch.Tensor:
        """Return numbers of shape (n, L, outputs) per link, else (n, outputs)."""


class Entities(nn.Module):
    """Encode links, goal, object, line, obstacles and points as vectors of one size, links first.

    The highest frequencies of the code of joint positions have many periods within one control
    step: noise to an untrained network. The initial weights of a frequency are inversely
    proportional to it, so that the initial policy is smooth.

    The tool's position is part of the goal's and of the object's vector, so that the distance left
    is a difference of numbers within one vector. Without ``links`` only the other entities are
    encoded, for networks that encode links in their own way. Entities that an observation lacks
    are left out.
    """

    def __init__(
        self, layout: Layout, features: int, *, proprioceptive_only: bool, links: bool = True
    ) -> None:
        super().__init__()
        self.columns = POSITION.columns if proprioceptive_only else slice(0, layout.token)
        """Columns of the link tokens that are encoded."""
        vectors = sum(size for _, size in layout.vectors)
        link = self.columns.stop - self.columns.start + len(layout.channels) + vectors
        self.tool = layout.tool
        tool = 3 * layout.tool
        sizes = {"links": link} if links else {}
        sizes |= {"goal": 7 + tool, "object": 13 + tool, "line": 1}
        if layout.obstacles:
            sizes["obstacles"] = 13
        self.cloud: nn.Module | None = None
        if layout.points:
            self.cloud = nn.Sequential(
                nn.Linear(3, features), nn.SiLU(), nn.Linear(features, features)
            )
            sizes["cloud"] = features
        self.channels, self.vectors = layout.channels, tuple(name for name, _ in layout.vectors)
        self.fields = layout.fields
        # Numbered, as the names of fields may be unfit for modules.
        extra = {f"field{i}": size for i, (_, size, _) in enumerate(self.fields)}
        sizes |= extra
        self.project = nn.ModuleDict(
            {name: nn.Linear(size, features, bias=False) for name, size in sizes.items()}
        )
        if links:
            smooth_position_code(self.project["links"], POSITION.start - self.columns.start)
        self.kinds = tuple(name for name in (*ENTITIES, *extra) if name in sizes)
        """Name of each row of ``kind``."""
        self.kind = nn.Parameter(0.02 * torch.randn(len(self.kinds), features))
        self.count = layout.links + 3 + layout.obstacles + bool(layout.points) + len(extra)

    def forward(self, observation: Observation) -> tuple[torch.Tensor, torch.Tensor]:
        """Return vectors (n, T, features), zeros in the padding, and their mask (n, T), bool."""
        entries = self._entries(observation)
        vectors, masks = [], []
        for name, kind in zip(self.kinds, self.kind, strict=True):
            if name not in entries:
                continue
            values, mask = entries[name]
            visible = torch.where(mask[..., None], values, 0.0)
            vectors.append(torch.where(mask[..., None], self.project[name](visible) + kind, 0.0))
            masks.append(mask)
        return torch.cat(vectors, dim=1), torch.cat(masks, dim=1)

    def _entries(self, observation: Observation) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
        """Return values (n, k, size) and masks (n, k) of each kind that the observation has."""
        tool = [observation["tool"]] if self.tool else []
        entries = {
            f"field{i}": (observation[name][:, None], observation[mask][:, None])
            for i, (name, _, mask) in enumerate(self.fields)
        }
        if "goal" in observation:
            goal = torch.cat([observation["goal"], *tool], dim=-1)
            entries["goal"] = (goal[:, None], observation["goal_mask"][:, None])
        if "object" in observation:
            block = torch.cat([observation["object"], *tool], dim=-1)
            entries["object"] = (block[:, None], observation["object_mask"][:, None])
        if "line" in observation:
            entries["line"] = (observation["line"][:, None], observation["object_mask"][:, None])
        if "links" in self.project:
            extra = [observation[name][..., None] for name in self.channels]
            extra += [observation[name] for name in self.vectors]
            links = torch.cat([observation["tokens"][..., self.columns], *extra], dim=-1)
            entries["links"] = (links, observation["links"])
        if "obstacles" in self.project:
            entries["obstacles"] = (observation["obstacles"], observation["obstacle_mask"])
        if self.cloud is not None:
            points, mask = observation["points"], observation["point_mask"]
            entries["cloud"] = _max_pool(self.cloud, points, mask)
        return entries


def smooth_position_code(layer: nn.Module, first: int) -> None:
    """Scale the initial weights of a layer's inputs that are the code of joint positions."""
    scale = torch.from_numpy(FREQUENCIES[0] / FREQUENCIES).float().repeat(2)
    with torch.no_grad():
        next(layer.parameters())[:, first : first + POSITION.size].mul_(scale)


def last_layer(inputs: int, outputs: int, scale: float = 1.0) -> nn.Linear:
    """Return a linear layer whose outputs start near zero, also after the network scales them."""
    layer = nn.Linear(inputs, outputs)
    with torch.no_grad():
        layer.weight.mul_(LAST_LAYER_SCALE).div_(scale)
        layer.bias.zero_()
    return layer


def _max_pool(
    encode: nn.Module, points: torch.Tensor, mask: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the largest features of points (n, P, 3), as PointNet (Qi et al. 2017).

    They have the shape (n, 1, features); with them is returned whether there is any point, (n, 1).
    """
    features = encode(torch.where(mask[..., None], points, 0.0)).float()
    lowest = torch.finfo(features.dtype).min
    top = torch.where(mask[..., None], features, lowest).amax(dim=1, keepdim=True)
    return top, mask.any(dim=1, keepdim=True)

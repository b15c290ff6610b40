"""The layout of observations that networks are built for: sizes, channels, and rows of links."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch.nn import functional

from morphgen.errors import TaskError
from morphgen.rl.heads import REST
from morphgen.tasks.observation import Observation

CHANNELS = ("velocity", "previous_action")
"""Optional channels with one number per link, in the order in which networks concatenate them."""
LINK_ROWS = ("tokens", "links", "actions", *CHANNELS)
"""Channels that have a row for each link."""


@dataclass(frozen=True)
class Layout:
    """Sizes and channels of the observations that a network is built for."""

    links: int
    """Rows of link tokens, L."""
    token: int
    """Numbers per link token."""
    obstacles: int
    """Rows of obstacle tokens, O."""
    points: int
    """Points of the cloud, P; 0 without a cloud."""
    channels: tuple[str, ...]
    """Those of ``CHANNELS`` that the observations have."""
    tool: bool = False
    """Whether the observations have the tool's position."""


def layout_of(observation: Observation) -> Layout:
    """Return the layout of an observation."""
    return Layout(
        links=observation["tokens"].shape[1],
        token=observation["tokens"].shape[2],
        obstacles=observation["obstacles"].shape[1],
        points=observation["points"].shape[1] if "points" in observation else 0,
        channels=tuple(name for name in CHANNELS if name in observation),
        tool="tool" in observation,
    )


def layout_from(stored: dict[str, Any]) -> Layout:
    """Return the layout that ``dataclasses.asdict`` made a dictionary of."""
    return Layout(**{**stored, "channels": tuple(stored["channels"])})


def require_layout(stored: Layout, observed: Layout, what: str) -> None:
    """Require that weights fit observations.

    Args:
        stored: Layout that the weights were made for.
        observed: Layout of the observations.
        what: Origin of the weights, for the message.

    Raises:
        TaskError: If the layouts differ; the message lists the differences.
    """
    theirs, ours = asdict(stored), asdict(observed)
    wrong = [
        f"{name} {theirs[name]}, here {ours[name]}" for name in ours if theirs[name] != ours[name]
    ]
    if wrong:
        raise TaskError(f"{what} is for other observations: {'; '.join(wrong)}")


def last_link(observation: Observation) -> int:
    """Return how many rows of links there are up to the last one that some robot uses."""
    return int(torch.nonzero(observation["links"].any(dim=0)).max()) + 1


def truncate_links(observation: Observation, rows: int) -> Observation:
    """Keep the first rows of links; tensors (n, L, ...) become (n, rows, ...)."""
    return {
        name: value[:, :rows] if name in LINK_ROWS else value for name, value in observation.items()
    }


def pad_links(actions: torch.Tensor, links: int) -> torch.Tensor:
    """Return actions (n, rows) as the batch takes them, (n, L); further links do not move."""
    rest = 0 if actions.is_floating_point() else REST
    return functional.pad(actions, (0, links - actions.shape[1]), value=rest)

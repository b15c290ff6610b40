"""The layout of observations that networks are built for: sizes, channels, and rows of links."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import torch
from msgspec import Meta
from msgspec.structs import asdict
from torch.nn import functional

from morphgen.errors import TaskError
from morphgen.formats.records import Record
from morphgen.rl.config import differences
from morphgen.tasks.actions import BINS
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import KINEMATIC_CHANNELS, TASKS
from morphgen.tasks.task import STANDARD_FIELDS

MIN_LOG_STD, MAX_LOG_STD, INITIAL_LOG_STD = -4.0, 0.5, -0.7
"""Log of the Gaussian's standard deviation: its bounds, and its initial value. The initial
deviation, exp(-0.7) = 0.5, is half of a joint's step per control step."""
REST = BINS.index(0.0)  # the bin that moves nothing


def bounded_log_std(raw: torch.Tensor) -> torch.Tensor:
    """Map any number into (``MIN_LOG_STD``, ``MAX_LOG_STD``), and 0 to ``INITIAL_LOG_STD``.

    It is a sigmoid rather than a clamp, so that it has a gradient everywhere.
    """
    shift = math.log((INITIAL_LOG_STD - MIN_LOG_STD) / (MAX_LOG_STD - INITIAL_LOG_STD))
    return MIN_LOG_STD + (MAX_LOG_STD - MIN_LOG_STD) * torch.sigmoid(raw + shift)


@dataclass(frozen=True, eq=False)
class MaskedGaussian:
    """Independent normal distributions, one per link."""

    mean: torch.Tensor  # means, shape (n, L)
    log_std: torch.Tensor
    """Log of the standard deviations, shape (n, L), or one that broadcasts to it."""
    mask: torch.Tensor  # movable links, shape (n, L), bool

    def mode(self) -> torch.Tensor:
        """Return the mean actions, shape (n, L); 0 for links that do not move."""
        return torch.where(self.mask, self.mean, 0.0)

    def sample(self, generator: torch.Generator) -> torch.Tensor:
        """Draw actions, shape (n, L), unbounded; 0 for links that do not move."""
        noise = torch.empty_like(self.mean).normal_(generator=generator)
        return torch.where(self.mask, self.mean + self.log_std.exp() * noise, 0.0)

    def log_prob(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the log density of actions (n, L), shape (n,)."""
        deviations = torch.where(self.mask, actions - self.mean, 0.0) * torch.exp(-self.log_std)
        log_probs = -0.5 * deviations.square() - self.log_std - 0.5 * math.log(2 * math.pi)
        return _sum(log_probs, self.mask)

    def entropy(self) -> torch.Tensor:
        """Return the differential entropy [nats], shape (n,)."""
        entropies = self.log_std + 0.5 * math.log(2 * math.pi * math.e)
        return _sum(entropies.expand_as(self.mean), self.mask)


@dataclass(frozen=True, eq=False)
class MaskedMultiDiscrete:
    """Independent choices among ``BINS``, one per link."""

    logits: torch.Tensor  # logits of the bins, shape (n, L, 11)
    mask: torch.Tensor  # movable links, shape (n, L), bool

    def mode(self) -> torch.Tensor:
        """Return the bins nearest to the mean actions, shape (n, L), int64.

        Bins are ordered, so that they have a mean, which is as good for them as for numbers: the
        likeliest bin may be the likeliest by little, and far from the others. Links that do not
        move have ``REST``.
        """
        shares = torch.tensor(BINS, device=self.logits.device)
        mean = (self._log_probs().exp() * shares).sum(dim=-1, keepdim=True)
        return torch.where(self.mask, (mean - shares).abs().argmin(dim=-1), REST)

    def sample(self, generator: torch.Generator) -> torch.Tensor:
        """Draw bins, shape (n, L), int64; ``REST`` for links that do not move."""
        exponential = torch.empty_like(self.logits).exponential_(generator=generator)
        # Gumbel-max trick: minus the log of an exponential number is Gumbel noise.
        bins = (self.logits - exponential.log()).argmax(dim=-1)
        return torch.where(self.mask, bins, REST)

    def log_prob(self, actions: torch.Tensor) -> torch.Tensor:
        """Return the log probability of bins (n, L), shape (n,)."""
        chosen = torch.where(self.mask, actions, REST)[..., None]
        return _sum(self._log_probs().gather(-1, chosen)[..., 0], self.mask)

    def entropy(self) -> torch.Tensor:
        """Return the entropy [nats], shape (n,)."""
        log_probs = self._log_probs()
        return _sum(-(log_probs.exp() * log_probs).sum(dim=-1), self.mask)

    def _log_probs(self) -> torch.Tensor:
        return torch.log_softmax(torch.where(self.mask[..., None], self.logits, 0.0), dim=-1)


Head = MaskedGaussian | MaskedMultiDiscrete


def joint_entropy(head: Head) -> torch.Tensor:
    """Return the mean entropy of a joint's action [nats], shape (n,)."""
    return head.entropy() / head.mask.sum(dim=-1).clamp(min=1)


def _sum(per_link: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    return torch.where(mask, per_link, 0.0).sum(dim=-1)


CHANNELS = ("velocity", "previous_action")
"""Optional channels with one number per link, in the order in which networks concatenate them."""
LINK_ROWS = ("tokens", "links", "actions", *CHANNELS, *KINEMATIC_CHANNELS)
"""Channels that have a row for each link."""
TREE = ("joints", "joint_parents", "joint_relations")
"""Entries of ``morphgen.tasks.observation.tree_entries``."""
KNOWN = {
    *(*LINK_ROWS, *TREE, "tool", "points", "point_mask", "obstacles", "obstacle_mask"),
    *(name for field in STANDARD_FIELDS for name in (field.name, field.mask)),
}
"""Entries of observations that networks encode in their own way."""


Rows = Annotated[int, Meta(ge=0, le=100_000)]
"""Number of rows or columns; a layout in a file cannot ask for more memory than there is."""


class Layout(Record, frozen=True):
    """Sizes and channels of the observations that a network is built for."""

    links: Rows  # rows of link tokens, L
    token: Rows  # numbers per link token
    obstacles: Rows  # rows of obstacle tokens, O
    points: Rows  # points of the cloud, P; 0 without a cloud
    channels: tuple[str, ...]  # names of the entries of `CHANNELS` that the observations contain
    tool: bool = False  # whether the observations have the tool's position
    fields: tuple[tuple[str, Rows, str], ...] = ()
    """Name, size and mask of the fields that tasks of other packages declare, by name."""
    vectors: tuple[tuple[str, Rows], ...] = ()
    """Name and size of the kinematic channels, which have a vector per link."""
    tree: bool = False  # whether the observations have the entries of `TREE`

    def as_data(self) -> dict[str, Any]:
        """Return plain data for a checkpoint; without the entries of newer versions if unused."""
        unused = [name for name in ("fields", "vectors", "tree") if not getattr(self, name)]
        return {name: value for name, value in asdict(self).items() if name not in unused}


def layout_of(observation: Observation) -> Layout:
    """Return the layout of an observation."""
    others = observation.keys() - KNOWN  # fields that only tasks of other packages have
    declared = fields_of(TASKS) if others else ()
    return Layout(
        links=observation["tokens"].shape[1],
        token=observation["tokens"].shape[2],
        obstacles=observation["obstacles"].shape[1],
        points=observation["points"].shape[1] if "points" in observation else 0,
        channels=tuple(name for name in CHANNELS if name in observation),
        tool="tool" in observation,
        fields=tuple(sorted(field for field in declared if field[0] in others)),
        vectors=tuple(
            (name, observation[name].shape[2]) for name in KINEMATIC_CHANNELS if name in observation
        ),
        tree=TREE[0] in observation,
    )


def require_layout(stored: Layout, observed: Layout, what: str) -> None:
    """Require that weights fit observations."""
    if wrong := differences(asdict(stored), asdict(observed), ", here "):
        raise TaskError(
            f"{what} is for other observations: {wrong}; these depend on the task, its goals and "
            "obstacles, and the observation channels"
        )


Fields = Sequence[tuple[str, int, str]]
"""Name, size and mask of fields of tasks, as in ``Layout.fields``."""


def fields_of(tasks: Iterable[str]) -> Fields:
    """Return the fields that tasks declare."""
    declared = dict.fromkeys(field for task in sorted(tasks) for field in TASKS[task].fields)
    return tuple((field.name, field.size, field.mask) for field in declared)


def with_fields(observation: Observation, fields: Fields) -> Observation:
    """Return an observation with fields of tasks that no robot of its batch has: zeros, masked."""
    added, links = dict(observation), observation["links"]
    for name, size, mask in fields:
        if name not in added and mask not in observation:
            added[name] = torch.zeros(len(links), size, device=links.device)
            added.setdefault(mask, torch.zeros_like(links[:, 0]))
    return added


def truncate_links(observation: Observation, rows: int) -> Observation:
    """Keep the first rows of links; tensors (n, L, ...) become (n, rows, ...)."""
    return {
        name: value[:, :rows] if name in LINK_ROWS else value for name, value in observation.items()
    }


def pad_links(actions: torch.Tensor, links: int) -> torch.Tensor:
    """Return actions (n, rows) as the batch takes them, (n, L); further links do not move."""
    rest = 0 if actions.is_floating_point() else REST
    return functional.pad(actions, (0, links - actions.shape[1]), value=rest)

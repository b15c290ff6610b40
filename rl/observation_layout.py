"""The layout of observations that networks are built for: sizes, channels, and rows of links."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch.nn import functional

from morphgen.errors import TaskError
from morphgen.rl.heads import REST
from morphgen.tasks.channels import KINEMATIC_CHANNELS
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import STANDARD_FIELDS

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
    """Names of the entries of ``CHANNELS`` that the observations contain."""
    tool: bool = False
    """Whether the observations have the tool's position."""
    fields: tuple[tuple[str, int, str], ...] = ()
    """Name, size and mask of the fields that tasks of other packages declare, by name."""
    vectors: tuple[tuple[str, int], ...] = ()
    """Name and size of the kinematic channels, which have a vector per link."""
    tree: bool = False
    """Whether the observations have the entries of ``TREE``."""

    def as_data(self) -> dict[str, Any]:
        """Return plain data for a checkpoint; without the entries of newer versions if unused."""
        unused = [name for name in ("fields", "vectors", "tree") if not getattr(self, name)]
        return {name: value for name, value in asdict(self).items() if name not in unused}


def layout_of(observation: Observation) -> Layout:
    """Return the layout of an observation.

    Raises:
        TaskError: If an entry is no field of a registered task, or has another size than declared.
    """
    return Layout(
        links=observation["tokens"].shape[1],
        token=observation["tokens"].shape[2],
        obstacles=observation["obstacles"].shape[1],
        points=observation["points"].shape[1] if "points" in observation else 0,
        channels=tuple(name for name in CHANNELS if name in observation),
        tool="tool" in observation,
        fields=_declared_fields(observation),
        vectors=tuple(
            (name, observation[name].shape[2]) for name in KINEMATIC_CHANNELS if name in observation
        ),
        tree=TREE[0] in observation,
    )


def _declared_fields(observation: Observation) -> tuple[tuple[str, int, str], ...]:
    """Return the fields of an observation that only tasks of other packages have."""
    names = sorted(observation.keys() - KNOWN)
    if not names:
        return ()
    declared = {field.name: field for task in TASKS for field in TASKS[task].fields}
    masks = {field.mask for field in declared.values()}
    fields = []
    for name in names:
        if name not in declared and name not in masks:
            raise TaskError(
                f"observation entry {name!r}: networks cannot encode it; expected a field of a "
                "registered task: declare an ObservationField in the task's `fields`"
            )
        if name in declared:
            field, shape = declared[name], tuple(observation[name].shape)
            if shape[1:] != (field.size,) or field.mask not in observation:
                raise TaskError(
                    f"observation field {name!r} has shape {shape}; expected (n, {field.size}), "
                    f"and the entry {field.mask!r}"
                )
            fields.append((name, field.size, field.mask))
    return tuple(fields)


def layout_from(stored: Mapping[str, Any]) -> Layout:
    """Return the layout that ``Layout.as_data`` made a dictionary of."""
    lists = {
        name: tuple(tuple(entry) for entry in stored.get(name, ()))
        for name in ("fields", "vectors")
    }
    return Layout(**{**stored, "channels": tuple(stored["channels"]), **lists})


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
        raise TaskError(
            f"{what} is for other observations: {'; '.join(wrong)}; these depend on the task, its "
            "goals and obstacles, and the observation channels"
        )


def last_link(observation: Observation) -> int:
    """Return how many rows of links there are up to the last one that some robot uses."""
    return int(torch.nonzero(observation["links"].any(dim=0)).max()) + 1


def truncate_links(observation: Observation, rows: int) -> Observation:
    """Keep the first rows of links; tensors (n, L, ...) become (n, rows, ...)."""
    return {
        name: value[:, :rows] if name in LINK_ROWS else value for name, value in observation.items()
    }


def absent_entries(tasks: Collection[str]) -> frozenset[str]:
    """Return the standard entries of observations, and their masks, that no task fills.

    Args:
        tasks: Names of tasks.
    """
    filled = {field for task in tasks for field in TASKS[task].fields}
    present = {name for field in filled for name in (field.name, field.mask)}
    standard = {name for field in STANDARD_FIELDS for name in (field.name, field.mask)}
    return frozenset(standard - present)


def pad_links(actions: torch.Tensor, links: int) -> torch.Tensor:
    """Return actions (n, rows) as the batch takes them, (n, L); further links do not move."""
    rest = 0 if actions.is_floating_point() else REST
    return functional.pad(actions, (0, links - actions.shape[1]), value=rest)

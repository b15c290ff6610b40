"""Actor and critic: an agent's networks with distributions of actions, and with values."""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import torch
from torch import nn

from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS
from morphgen.rl.agents.encoder import Network
from morphgen.rl.config import PolicyConfig
from morphgen.rl.observation_layout import (
    Head,
    Layout,
    MaskedGaussian,
    MaskedMultiDiscrete,
    bounded_log_std,
)
from morphgen.tasks.actions import BINS
from morphgen.tasks.kinematic_channels import IK_SHARE
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import STANDARD_FIELDS

MAX_NORMALIZED = 5.0  # bound of a normalized number [standard deviations]
MIN_VARIANCE = 1e-4
"""Smallest variance to divide by: columns that hardly vary in training stay small elsewhere."""


class RunningNormalizer(nn.Module):
    """Normalize each column of the kinematic channels by its mean and variance so far.

    The statistics are buffers, and so part of a checkpoint; they are over the links that a robot
    has. Gradient steps do not change them, only ``update`` does.
    """

    count: torch.Tensor
    mean: torch.Tensor
    variance: torch.Tensor

    def __init__(self, layout: Layout) -> None:
        super().__init__()
        self.vectors = layout.vectors
        size = sum(size for _, size in layout.vectors)
        self.register_buffer("count", torch.zeros(()))
        self.register_buffer("mean", torch.zeros(size))
        self.register_buffer("variance", torch.ones(size))

    def forward(self, observation: Observation) -> Observation:
        """Return the observation with normalized channels; padding stays zero."""
        normalized, start = dict(observation), 0
        for name, size in self.vectors:
            columns = slice(start, start + size)
            centred = observation[name] - self.mean[columns]
            values = centred / self.variance[columns].clamp(min=MIN_VARIANCE).sqrt()
            values = values.clamp(-MAX_NORMALIZED, MAX_NORMALIZED)
            normalized[name] = values * observation["links"][..., None]
            start += size
        return normalized

    @torch.no_grad()
    def update(self, observation: Observation) -> None:
        """Include observations, tensors (m, ...), in the statistics.

        Chan, Golub and LeVeque, Algorithms for computing the sample variance, 1983: means and
        variances of two sets are merged without their elements.
        """
        if not self.vectors:
            return
        is_link = observation["links"][..., None].float()
        count = is_link.sum()
        means, variances = [], []
        for name, _ in self.vectors:  # one by one, to need less memory
            values, rows = observation[name], (0, 1)
            mean = (values * is_link).sum(dim=rows) / count
            means.append(mean)
            variances.append(((values - mean).square() * is_link).sum(dim=rows) / count)
        variance = torch.cat(variances)
        total, difference = self.count + count, torch.cat(means) - self.mean
        between = difference.square() * self.count * count / total
        self.variance.copy_((self.variance * self.count + variance * count + between) / total)
        self.mean.add_(difference * count / total)
        self.count.copy_(total)


class Actor(nn.Module):
    """The policy: a distribution of actions for each observation."""

    def __init__(self, config: PolicyConfig, layout: Layout) -> None:
        super().__init__()
        self.discrete = config.discrete
        self.network: Network = AGENTS[config.agent].network(
            config, layout, len(BINS) if config.discrete else 1, per_link=True
        )
        if not config.discrete:
            rows = 1 if self.network.shares_joints else layout.links
            self.raw_log_std = nn.Parameter(torch.zeros(rows), requires_grad=not config.fixed_std)
        self.residual = config.residual
        self.normalizer = RunningNormalizer(layout) if config.normalize else None

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return numbers for ``head``: (n, L, 11) for discrete actions, else (n, L, 1), float32."""
        seen = observation if self.normalizer is None else self.normalizer(observation)
        numbers: torch.Tensor = self.network(seen).float()
        if self.residual:
            numbers = numbers + observation["ik"][..., IK_SHARE, None]
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
        self.normalizer = RunningNormalizer(layout) if config.normalize else None

    def forward(self, observation: Observation) -> torch.Tensor:
        """Return values, shape (n,), float32."""
        if self.normalizer is not None:
            observation = self.normalizer(observation)
        values: torch.Tensor = self.network(observation).float()
        return values[:, 0]


def make_networks(config: PolicyConfig, layout: Layout, seed: int) -> tuple[Actor, Critic]:
    """Build an actor and a critic on the CPU; the same seed gives the same weights."""
    if config.tool_position != layout.tool:
        shown = "show" if layout.tool else "do not show"
        raise TaskError(f"tool_position {config.tool_position}: the environments {shown} it")
    observed = {*layout.channels, *(name for name, _ in layout.vectors)}
    observed |= {"tree"} if layout.tree else set()
    missing = sorted(set(config.channels) - {"points", "no_state", "pace"} - observed)
    if missing:
        raise TaskError(f"observation channels {', '.join(missing)}: the environments lack them")
    with torch.random.fork_rng(devices=[]):
        torch.default_generator.manual_seed(
            int(np.random.SeedSequence(seed).generate_state(1, np.uint64)[0] >> 1)
        )
        return Actor(config, layout), Critic(config, layout)


def rows_needed(config: PolicyConfig, observation: Observation) -> int:
    """Return how many rows of links the networks need.

    A network that does not need all entries gets the rows up to the last one that some robot has:
    the others would not change its outputs, and would take time.
    """
    if AGENTS[config.agent].network.needs_all_entries:
        return observation["links"].shape[1]
    return int(torch.nonzero(observation["links"].any(dim=0)).max()) + 1


def entries_unneeded(config: PolicyConfig, tasks: Collection[str]) -> frozenset[str]:
    """Return the entries of observations that the networks do not need, as no task fills them."""
    if AGENTS[config.agent].network.needs_all_entries:
        return frozenset()
    filled = {field for task in tasks for field in TASKS[task].fields}
    present = {name for field in filled for name in (field.name, field.mask)}
    standard = {name for field in STANDARD_FIELDS for name in (field.name, field.mask)}
    return frozenset(standard - present)

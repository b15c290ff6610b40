"""Running normalisation of the kinematic channels of observations."""

from __future__ import annotations

import torch
from torch import nn

from morphgen.rl.distributed import ALONE, ProcessGroup
from morphgen.rl.observation_layout import Layout
from morphgen.tasks.observation import Observation

MAX_NORMALIZED = 5.0
"""Bound of a normalized number [standard deviations]."""
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
    def update(self, observation: Observation, processes: ProcessGroup = ALONE) -> None:
        """Include observations, tensors (m, ...), in the statistics.

        Chan, Golub and LeVeque, Algorithms for computing the sample variance, 1983: means and
        variances of two sets are merged without their elements.

        Args:
            observation: Observations of this process.
            processes: Processes whose observations are all included.
        """
        if not self.vectors:
            return
        is_link = observation["links"][..., None].float()
        own_count = is_link.sum()
        means, variances = [], []
        for name, _ in self.vectors:  # one by one, to need less memory
            values, rows = observation[name], (0, 1)
            mean = (values * is_link).sum(dim=rows) / own_count
            means.append(mean)
            variances.append(((values - mean).square() * is_link).sum(dim=rows) / own_count)
        own = torch.cat([own_count[None], *means, *variances])
        size = len(self.mean)
        for statistics in processes.collect(own):
            count, mean, variance = torch.split(statistics, [1, size, size])
            total, difference = self.count + count, mean - self.mean
            between = difference.square() * self.count * count / total
            merged = (self.variance * self.count + variance * count + between) / total
            self.variance.copy_(merged)
            self.mean.add_(difference * count / total)
            self.count.copy_(total[0])

"""Distributions over the actions of a robot's links, in which only movable links count."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from morphgen.tasks.config import BINS

LOW, HIGH, START = -4.0, 0.5, -0.7
"""Logarithm of the Gaussian's deviation: its bounds, and where it starts: 0.5 of a joint's step."""
REST = BINS.index(0.0)
"""The bin that moves nothing."""


def bounded_log_std(raw: torch.Tensor) -> torch.Tensor:
    """Map any number into (``LOW``, ``HIGH``), zero to ``START``; it has a slope everywhere."""
    shift = math.log((START - LOW) / (HIGH - START))
    return LOW + (HIGH - LOW) * torch.sigmoid(raw + shift)


@dataclass(frozen=True, eq=False)
class MaskedGaussian:
    """Independent normal distributions, one a link."""

    mean: torch.Tensor
    """Shape (n, L)."""
    log_std: torch.Tensor
    """Shape (n, L), or one that broadcasts to it."""
    mask: torch.Tensor
    """Links that count, shape (n, L), bool."""

    def middle(self) -> torch.Tensor:
        """The mean actions, shape (n, L); 0 where no link counts."""
        return torch.where(self.mask, self.mean, 0.0)

    def sample(self, generator: torch.Generator) -> torch.Tensor:
        """Drawn actions, shape (n, L), unbounded; 0 where no link counts."""
        noise = torch.empty_like(self.mean).normal_(generator=generator)
        return torch.where(self.mask, self.mean + self.log_std.exp() * noise, 0.0)

    def log_prob(self, actions: torch.Tensor) -> torch.Tensor:
        """Logarithm of the density of actions (n, L), shape (n,)."""
        away = torch.where(self.mask, actions - self.mean, 0.0) * torch.exp(-self.log_std)
        each = -0.5 * away.square() - self.log_std - 0.5 * math.log(2 * math.pi)
        return _sum(each, self.mask)

    def entropy(self) -> torch.Tensor:
        """Differential entropy, nats, shape (n,)."""
        each = self.log_std + 0.5 * math.log(2 * math.pi * math.e)
        return _sum(each.expand_as(self.mean), self.mask)


@dataclass(frozen=True, eq=False)
class MaskedMultiDiscrete:
    """Independent choices among ``BINS``, one a link."""

    logits: torch.Tensor
    """Shape (n, L, 11)."""
    mask: torch.Tensor
    """Links that count, shape (n, L), bool."""

    def middle(self) -> torch.Tensor:
        """The bins nearest to the mean actions, shape (n, L), int64; ``REST`` where none counts.

        Bins are in an order, so that they have a mean, and it is as good for them as for numbers:
        a bin may be the likeliest by little, and far from the others.
        """
        shares = torch.tensor(BINS, device=self.logits.device)
        mean = (self._logs().exp() * shares).sum(dim=-1, keepdim=True)
        return torch.where(self.mask, (mean - shares).abs().argmin(dim=-1), REST)

    def sample(self, generator: torch.Generator) -> torch.Tensor:
        """Drawn bins, shape (n, L), int64; ``REST`` where no link counts."""
        waits = torch.empty_like(self.logits).exponential_(generator=generator)
        first = (self.logits - waits.log()).argmax(dim=-1)
        return torch.where(self.mask, first, REST)

    def log_prob(self, actions: torch.Tensor) -> torch.Tensor:
        """Logarithm of the probability of bins (n, L), shape (n,)."""
        chosen = torch.where(self.mask, actions, REST)[..., None]
        each = self._logs().gather(-1, chosen)[..., 0]
        return _sum(each, self.mask)

    def entropy(self) -> torch.Tensor:
        """Entropy, nats, shape (n,)."""
        logs = self._logs()
        return _sum(-(logs.exp() * logs).sum(dim=-1), self.mask)

    def _logs(self) -> torch.Tensor:
        return torch.log_softmax(torch.where(self.mask[..., None], self.logits, 0.0), dim=-1)


Head = MaskedGaussian | MaskedMultiDiscrete


def _sum(each: torch.Tensor, mask: torch.Tensor) -> torch.Tensor:
    return torch.where(mask, each, 0.0).sum(dim=-1)

"""Distributions over the actions of a robot's links; only movable links count."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from morphgen.tasks.actions import BINS

MIN_LOG_STD, MAX_LOG_STD, INITIAL_LOG_STD = -4.0, 0.5, -0.7
"""Log of the Gaussian's standard deviation: its bounds, and its initial value. 0.5 is half of a
joint's step per control step."""
REST = BINS.index(0.0)
"""The bin that moves nothing."""


def bounded_log_std(raw: torch.Tensor) -> torch.Tensor:
    """Map any number into (``MIN_LOG_STD``, ``MAX_LOG_STD``), and 0 to ``INITIAL_LOG_STD``.

    It is a sigmoid rather than a clamp, so that it has a gradient everywhere.
    """
    shift = math.log((INITIAL_LOG_STD - MIN_LOG_STD) / (MAX_LOG_STD - INITIAL_LOG_STD))
    return MIN_LOG_STD + (MAX_LOG_STD - MIN_LOG_STD) * torch.sigmoid(raw + shift)


@dataclass(frozen=True, eq=False)
class MaskedGaussian:
    """Independent normal distributions, one per link."""

    mean: torch.Tensor
    """Means, shape (n, L)."""
    log_std: torch.Tensor
    """Log of the standard deviations, shape (n, L), or one that broadcasts to it."""
    mask: torch.Tensor
    """Movable links, shape (n, L), bool."""

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

    logits: torch.Tensor
    """Logits of the bins, shape (n, L, 11)."""
    mask: torch.Tensor
    """Movable links, shape (n, L), bool."""

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

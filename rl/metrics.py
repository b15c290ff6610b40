"""The metrics of an update."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

Metrics = dict[str, Any]
"""Fields of a report by name."""


@dataclass(frozen=True)
class UpdateMetrics:
    """Metrics of one update; means over its transitions unless said otherwise."""

    update: int
    """Number of updates so far, this one included."""
    transitions: int
    """Control steps of all environments so far."""
    reward: float
    """Mean reward of a control step."""
    score: float
    """Mean task score of a control step."""
    scores: tuple[float, ...]
    """Mean score of each robot, or of the robots of each grammar if they are drawn; nan for one
    without an environment."""
    success: float
    """Share of successes among the episodes that ended in the rollout; nan if none did."""
    episodes: int
    """Number of episodes that ended in the rollout."""
    unstable: int
    """Number of episodes that ended because the simulation diverged."""
    terms: dict[str, float]
    """Mean of each reward term."""
    policy_loss: float
    """Clipped policy loss."""
    value_loss: float
    """Half the squared error, or ``matching_loss`` if the critic predicts symlogs."""
    entropy: float
    """Entropy of a robot's action distribution [nats]."""
    kl: float
    """Divergence of the updated policy from the one that acted [nats] (Schulman 2020, k3)."""
    clip_fraction: float
    """Share of the probability ratios outside of the clip range."""
    actor_gradient: float
    """Norm of the actor's gradient before clipping."""
    critic_gradient: float
    """Norm of the critic's gradient before clipping."""
    explained_variance: float
    """Share of the returns' variance that the values before the update explain."""
    learning_rate: float
    """Learning rate of the actor."""
    collect_seconds: float
    """Time to collect the rollout [s]."""
    learn_seconds: float
    """Time to learn from it [s]."""
    steps_per_second: float
    """Transitions per second, collection and learning together."""


def explained_variance(values: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
    """Return 1 if values predict the returns, and 0 if no better than the returns' mean."""
    spread = returns.var()
    return torch.where(spread > 0, 1 - (returns - values).var() / spread.clamp(min=1e-12), 0.0)

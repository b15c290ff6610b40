"""What learning says of itself, an update at a time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

Numbers = dict[str, Any]
"""Fields of a report by name."""


@dataclass(frozen=True)
class Report:
    """An update in numbers; means over its transitions unless said otherwise."""

    update: int
    """How many updates there were, this one among them."""
    transitions: int
    """Of all of these."""
    reward: float
    score: float
    scores: tuple[float, ...]
    """By robot; nan for one without an environment."""
    success: float
    """Share of the episodes that ended here; nan if none did."""
    episodes: int
    """How many ended here."""
    unstable: int
    """How many of them because their simulation became unstable."""
    terms: dict[str, float]
    """Of the reward."""
    policy_loss: float
    value_loss: float
    """Half the squared error, or ``matching_loss`` if the critic predicts symlogs."""
    entropy: float
    """Of a robot's action, nats."""
    kl: float
    """From the policy that acted to the one that is learned (Schulman 2020, estimator k3)."""
    clip_fraction: float
    """Share of the ratios outside of the clip range."""
    actor_gradient: float
    critic_gradient: float
    """Norms before clipping."""
    explained_variance: float
    """Of the returns, by the values before the update."""
    learning_rate: float
    """Of the actor."""
    collect_seconds: float
    learn_seconds: float
    steps_per_second: float
    """Transitions a second, collection and learning together."""


def outcome(tallied: dict[str, torch.Tensor], body: torch.Tensor, bodies: int) -> Numbers:
    """What a report says of a rollout.

    Args:
        tallied: Tensors (T, n) of steps, by the names of ``Step``.
        body: Which robot each environment holds, shape (n,), int64.
        bodies: How many robots there are.
    """
    over = tallied["terminated"] | tallied["truncated"]
    score = tallied["score"].float().mean(dim=0)
    count = torch.bincount(body, minlength=bodies)
    scores = torch.zeros(bodies, device=score.device).index_add_(0, body, score) / count
    return {
        "reward": float(tallied["reward"].mean()),
        "score": float(score.mean()),
        "scores": tuple(scores.tolist()),
        "success": float(tallied["success"][over].float().mean()),
        "episodes": int(over.sum()),
        "unstable": int(tallied["unstable"].sum()),
    }


def explained_variance(values: torch.Tensor, returns: torch.Tensor) -> torch.Tensor:
    """1 if values predict returns, 0 if no better than their mean; 0 if these are all one."""
    spread = returns.var()
    return torch.where(spread > 0, 1 - (returns - values).var() / spread.clamp(min=1e-12), 0.0)

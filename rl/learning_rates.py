"""Learning rates of the updates: a line to zero, and the actor's share of it."""

from __future__ import annotations

from morphgen.rl.config import PPOConfig

KL_FACTOR = 1.2
"""Between the actor's learning rates of two updates, where they follow ``target_kl``."""
LEAST_SHARE = 0.01
"""Least share of the learning rate that the actor keeps, as in rsl_rl (1e-5 of 1e-3).

Without it, a share that fell for long needs as many updates to rise again."""


def learning_rate(config: PPOConfig, update: int, updates: int) -> float:
    """That of an update, counted from 0, of so many: a line that ends at zero after the last."""
    return config.learning_rate * (1 - update / updates)


def next_share(config: PPOConfig, share: float, kl: float) -> float:
    """The actor's share of the learning rate in the next update, ``LEAST_SHARE`` to 1.

    Args:
        config: The algorithm; without a ``target_kl`` it is 1.
        share: In the last update.
        kl: Divergence of the last update, nats, the mean over its gradient steps.
    """
    if not config.target_kl:
        return 1.0
    if kl > config.target_kl:
        return max(share / KL_FACTOR, LEAST_SHARE)
    return min(share * KL_FACTOR, 1.0)

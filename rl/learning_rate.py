"""The actor's learning rate, which follows the change of the policy."""

from __future__ import annotations

from morphgen.rl.config import PPOConfig

KL_FACTOR = 1.2
"""Factor by which the actor's learning rate changes per update to follow ``desired_kl``."""
MIN_ACTOR_LR_SCALE = 0.01
"""Smallest factor on the actor's learning rate, so that it rises again soon (rsl_rl: 1e-5/1e-3)."""
FINETUNING_ACTOR_LR_SCALE = 0.1
"""Factor with which fine-tuning begins if it has a ``desired_kl``."""


def next_actor_lr_scale(config: PPOConfig, scale: float, kl: float) -> float:
    """Return the factor on the actor's learning rate in the next update.

    Args:
        config: The algorithm; without a ``desired_kl`` the factor is 1.
        scale: Factor in the last update.
        kl: Mean divergence of the last update's gradient steps [nats].
    """
    if not config.desired_kl:
        return 1.0
    if kl > config.desired_kl:
        return max(scale / KL_FACTOR, MIN_ACTOR_LR_SCALE)
    return min(scale * KL_FACTOR, 1.0)

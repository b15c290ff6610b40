"""Advantages of a rollout: generalised estimation, and normalisation."""

from __future__ import annotations

import torch


def gae(
    rewards: torch.Tensor,
    values: torch.Tensor,
    next_values: torch.Tensor,
    terminated: torch.Tensor,
    truncated: torch.Tensor,
    *,
    gamma: float,
    gae_lambda: float,
) -> torch.Tensor:
    """Return advantages by generalised estimation (Schulman et al. 2016, equation 16).

    After a termination the return is zero. After a truncation it is the value of the episode's last
    observation (Pardo et al. 2018), and the sum stops there. The critic learns advantages plus
    values. All tensors have the shape (T, n).

    Args:
        rewards: Rewards of T control steps in n environments.
        values: Values of the observations that were acted upon.
        next_values: Values of the observations that the actions led to, before any new episode.
        terminated: Where the task ended the episode, bool.
        truncated: Where the time limit ended the episode, bool.
        gamma: Discount factor.
        gae_lambda: Weight of longer estimates.
    """
    delta = rewards + gamma * torch.where(terminated, 0.0, next_values) - values
    carry = gamma * gae_lambda * (~(terminated | truncated)).to(delta.dtype)
    advantages = torch.empty_like(delta)
    advantage = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        advantage = delta[t] + carry[t] * advantage
        advantages[t] = advantage
    return advantages


def normalized_advantages(
    advantages: torch.Tensor, robots: torch.Tensor | None = None
) -> torch.Tensor:
    """Return advantages with mean 0 and standard deviation 1, over all or robot by robot.

    Args:
        advantages: Advantages, shape (T, n).
        robots: Robot of each advantage, shape (T, n), int64; None to normalize over all of them.
    """
    if robots is None:
        return (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    index, values = robots.flatten(), advantages.flatten()
    count = torch.bincount(index)
    mean = torch.zeros_like(count, dtype=values.dtype).index_add_(0, index, values) / count
    centred = values - mean[index]
    squares = torch.zeros_like(mean).index_add_(0, index, centred.square())
    deviation = (squares / (count - 1).clamp(min=1)).sqrt()
    return (centred / (deviation[index] + 1e-8)).reshape(advantages.shape)

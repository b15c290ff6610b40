"""Advantages by generalised estimation, which tells an episode's end from its time running out."""

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
    lam: float,
) -> torch.Tensor:
    """Generalised advantage estimation (Schulman et al. 2016, equation 16).

    Where the task ended an episode, nothing follows. Where time did, something would have: its
    value is that of the episode's last observation (Pardo et al. 2018), but the sum stops there.

    Args:
        rewards: Of T steps in n environments, shape (T, n).
        values: Of the observations that were acted upon, shape (T, n).
        next_values: Of the observations that the actions led to, before any new episode, (T, n).
        terminated: Whether the task ended the episode, shape (T, n), bool.
        truncated: Whether time did, shape (T, n), bool.
        gamma: Discount.
        lam: Weight of longer estimates.

    Returns:
        Shape (T, n). Advantages plus ``values`` are the returns to learn.
    """
    delta = rewards + gamma * torch.where(terminated, 0.0, next_values) - values
    carry = gamma * lam * (~(terminated | truncated)).to(delta.dtype)
    advantages = torch.empty_like(delta)
    ahead = torch.zeros_like(delta[0])
    for t in reversed(range(len(delta))):
        ahead = delta[t] + carry[t] * ahead
        advantages[t] = ahead
    return advantages


def next_values(
    values: torch.Tensor, last: torch.Tensor, cut: torch.Tensor, final: torch.Tensor
) -> torch.Tensor:
    """Values of the observations that the actions of a rollout led to.

    Args:
        values: Of the observations that were acted upon, shape (T, n).
        last: Of the observations after the rollout, shape (n,).
        cut: Where time ended an episode, shape (T, n), bool.
        final: Of the observations there, before the new episodes, shape (k,), in the order of
            ``torch.nonzero(cut)``.

    Returns:
        Shape (T, n); where the task ended an episode it is the value of the next episode's start,
        which ``gae`` does not look at.
    """
    found = torch.cat([values[1:], last[None]])
    found[cut] = final
    return found

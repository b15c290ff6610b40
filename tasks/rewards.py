"""Rewards of reach and push, term by term (paper, tables of reward terms), over a batch."""

from __future__ import annotations

import math

import torch

from morphgen.tasks.config import PushConfig, ReachConfig

Terms = dict[str, torch.Tensor]
"""Weighted terms by name, each of shape (n,); the reward is their sum."""


def added(values: torch.Tensor) -> torch.Tensor:
    """Sums of rows (n, k), shape (n,), of which no bit depends on padding or on other rows.

    In single precision the order of a sum, and with it the last bit, depends on both.
    """
    return values.sum(dim=1, dtype=torch.float64).float()


def lengths(vectors: torch.Tensor) -> torch.Tensor:
    """Euclidean lengths of rows (n, 3), shape (n,); see ``added``."""
    return vectors.double().square().sum(dim=1).sqrt().float()


def beyond_limits(q: torch.Tensor, lower: torch.Tensor, upper: torch.Tensor) -> torch.Tensor:
    """How far joints are outside of their limits, all together, shape (n,), rad and m."""
    return added(torch.clamp(torch.maximum(q - upper, lower - q), min=0))


def reach_terms(
    config: ReachConfig, distance: torch.Tensor, beyond: torch.Tensor, acceleration: torch.Tensor
) -> Terms:
    """Terms of reach.

    Args:
        config: Weights and the distance that is near.
        distance: Of tool and goal, shape (n,), metres.
        beyond: See ``beyond_limits``.
        acceleration: Mean over the control step, absolute, all joints together, shape (n,).
    """
    return {
        "joint_limits": -config.joint_limit_weight * beyond,
        "joint_acceleration": -config.joint_acceleration_weight * acceleration,
        "distance": -config.distance_weight * distance,
        "near": config.near_weight * (distance < config.near).float(),
    }


def push_terms(
    config: PushConfig,
    to_go: torch.Tensor,
    approach: torch.Tensor,
    beyond: torch.Tensor,
    success: torch.Tensor,
) -> Terms:
    """Terms of push.

    Args:
        config: Weights.
        to_go: Distance of the block from the line, 0 beyond it, shape (n,), metres.
        approach: Distance of tool and block, shape (n,), metres.
        beyond: See ``beyond_limits``.
        success: Whether the block is across, shape (n,), bool.
    """
    return {
        "joint_limits": -config.joint_limit_weight * beyond,
        "distance": -config.distance_weight * to_go,
        "approach": -config.approach_weight * approach,
        "success": config.success_weight * success.float(),
    }


def anybody_score(config: ReachConfig, distance: torch.Tensor) -> torch.Tensor:
    """Score of a step of reach, shape (n,): a bonus where near, else the squared distance."""
    far = -config.score_square * distance.square()
    return torch.where(distance < config.near, torch.full_like(far, config.score_near), far)


def episode_score(pushes: bool, total: float, last: float, steps: int) -> float:
    """Of reach the mean of ``anybody_score`` over its steps; of push 1 for success, else 0.

    Args:
        pushes: Whether it was push.
        total: The sum of its steps' scores.
        last: The score of its last step.
        steps: How many there were.
    """
    return last if pushes else total / steps


def moved_line(config: PushConfig, line: torch.Tensor, progress: float) -> torch.Tensor:
    """Where the line is in a curriculum, shape as ``line``.

    Args:
        config: The curriculum.
        line: Where it ends.
        progress: Of the training, 0 to 1; the line is in its place from 0.5 on.
    """
    steps = config.curriculum_steps
    reached = min(math.floor(2 * progress * steps + 1e-9), steps) / steps
    return line * (config.curriculum_start + (1 - config.curriculum_start) * reached)

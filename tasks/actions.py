"""Actions: decoding to normalized joint steps, encoding back, and integration into targets."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import torch

from morphgen.errors import TaskError

if TYPE_CHECKING:
    from morphgen.tasks.robot_tables import RobotTables

ActionKind = Literal["continuous", "discrete"]

BINS = (-1.0, -1 / 2, -1 / 4, -1 / 8, -1 / 16, 0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Normalized actions that the discrete ones index, exponentially spaced about zero (AnyBody)."""
_TOLERANCE = 1e-6
"""Excess of a bin over the normalized action that it encodes which float32 rounding allows."""


def decode_actions(
    actions: torch.Tensor, kind: ActionKind, shape: tuple[int, int], device: torch.device
) -> torch.Tensor:
    """Return actions as fractions of the largest joint steps, in [-1, 1], shape (n, L).

    Args:
        actions: Continuous: numbers, clipped to [-1, 1]. Discrete: indices into ``BINS``.
        kind: Kind of the actions.
        shape: Expected shape, (n, L).
        device: Device of the result.

    Raises:
        TaskError: If the shape differs, a number is not finite, or an index is out of range.
    """
    if tuple(actions.shape) != shape:
        raise TaskError(f"actions have shape {tuple(actions.shape)}; expected {shape}")
    actions = actions.to(device)
    if kind == "continuous":
        invalid = torch.nonzero(~torch.isfinite(actions))
        if len(invalid):
            env, link = invalid[0].tolist()
            raise TaskError(f"the action of environment {env}, link {link} is not finite")
        return actions.float().clamp(-1, 1)
    invalid = torch.nonzero((actions < 0) | (actions >= len(BINS)))
    if len(invalid) or actions.is_floating_point():
        where = f"environment {invalid[0, 0]}, link {invalid[0, 1]}: " if len(invalid) else ""
        raise TaskError(f"{where}discrete actions are integers from 0 to {len(BINS) - 1}")
    return torch.tensor(BINS, device=device)[actions.long()]


def encode_actions(normalized: torch.Tensor, kind: ActionKind) -> torch.Tensor:
    """Return normalized actions (n, L) as actions of a kind.

    A discrete action is the nearest bin towards zero, so that it never overshoots a target.
    """
    if kind == "continuous":
        return normalized
    bins = torch.tensor(BINS, device=normalized.device)
    size = normalized.abs()[..., None] + _TOLERANCE
    fits = (bins.abs() <= size) & (bins * normalized[..., None] >= 0)
    return torch.where(fits, bins.abs(), -torch.ones_like(bins)).argmax(dim=-1)


class JointTargets:
    """Integrates normalized actions into the joint targets of a batch."""

    def __init__(
        self, tables: RobotTables, env_robot_index: torch.Tensor, action_mask: torch.Tensor
    ) -> None:
        """Gather the tables of every environment.

        Args:
            tables: The robots.
            env_robot_index: Robot of each environment, shape (n,), int64.
            action_mask: Links whose joint obeys actions, shape (n, L), bool.
        """
        self._link = tables.link_of_joint[env_robot_index]
        self._max_step = tables.max_step[env_robot_index] * torch.gather(action_mask, 1, self._link)
        self._lower, self._upper = tables.lower[env_robot_index], tables.upper[env_robot_index]

    def __call__(self, targets: torch.Tensor, normalized: torch.Tensor) -> torch.Tensor:
        """Return the next targets, shape (n, J), within the joint limits.

        They start from the previous targets, not from the measured positions.

        Args:
            targets: Previous targets of the independent joints, shape (n, J) [rad or m].
            normalized: Normalized actions, shape (n, L).
        """
        change = torch.gather(normalized, 1, self._link) * self._max_step
        return torch.clamp(targets + change, self._lower, self._upper)

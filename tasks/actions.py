"""Actions: decoding to normalized joint steps, encoding back, and integration into targets."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Literal

import torch

from morphgen.errors import TaskError
from morphgen.tasks.sim.base import is_host

if TYPE_CHECKING:
    from morphgen.tasks.scenes.robot_tables import RobotTables

ActionKind = Literal["continuous", "discrete"]

BINS = (-1.0, -1 / 2, -1 / 4, -1 / 8, -1 / 16, 0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Normalized actions that the discrete ones index, exponentially spaced about zero (AnyBody)."""
_TOLERANCE = 1e-6
"""Excess of a bin over the normalized action that it encodes which float32 rounding allows."""


def decode_actions(
    actions: torch.Tensor, kind: ActionKind, shape: tuple[int, int], device: torch.device
) -> torch.Tensor:
    """Return actions as fractions of the largest joint steps, in [-1, 1], of a ``shape`` (n, L).

    On a GPU, which is not read here, actions that are not finite or out of range become nan: their
    environments diverge.
    """
    if tuple(actions.shape) != shape:
        raise TaskError(f"actions have shape {tuple(actions.shape)}; expected {shape}")
    actions = actions.to(device)
    is_index = kind == "discrete"
    if is_index and actions.is_floating_point():
        raise TaskError(f"discrete actions are integers from 0 to {len(BINS) - 1}")
    is_valid = (actions >= 0) & (actions < len(BINS)) if is_index else torch.isfinite(actions)
    if is_host(device) and not is_valid.all():
        env, link = torch.nonzero(~is_valid)[0].tolist()
        where = f"environment {env}, link {link}"
        if is_index:
            raise TaskError(f"{where}: discrete actions are integers from 0 to {len(BINS) - 1}")
        raise TaskError(f"the action of {where} is not finite")
    if is_index:
        numbers = _bins(device)[actions.long().clamp(0, len(BINS) - 1)]
    else:
        numbers = actions.float().clamp(-1, 1)
    return numbers if is_host(device) else torch.where(is_valid, numbers, torch.nan)


@lru_cache(maxsize=16)
def _bins(device: torch.device) -> torch.Tensor:
    """Return ``BINS`` on a device."""
    return torch.tensor(BINS, device=device)


def encode_actions(normalized: torch.Tensor, kind: ActionKind) -> torch.Tensor:
    """Return normalized actions (n, L) as actions of a kind.

    A discrete action is the nearest bin towards zero, so that it never overshoots a target.
    """
    if kind == "continuous":
        return normalized
    bins = _bins(normalized.device)
    size = normalized.abs()[..., None] + _TOLERANCE  # so that a bin encodes to itself
    fits = (bins.abs() <= size) & (bins * normalized[..., None] >= 0)
    return torch.where(fits, bins.abs(), -torch.ones_like(bins)).argmax(dim=-1)


class JointTargets:
    """Integrates normalized actions into the joint targets of a batch."""

    def __init__(
        self, tables: RobotTables, env_robot_index: torch.Tensor, action_mask: torch.Tensor
    ) -> None:
        """Gather the tables of the robots (n,); the mask (n, L) has the joints that obey."""
        self._link = tables.link_of_joint[env_robot_index]
        # Joints that do not obey have a step of zero: no mask is needed in a control step.
        self._max_step = tables.max_step[env_robot_index] * torch.gather(action_mask, 1, self._link)
        self._lower, self._upper = tables.lower[env_robot_index], tables.upper[env_robot_index]

    def __call__(self, targets: torch.Tensor, normalized: torch.Tensor) -> torch.Tensor:
        """Return the targets (n, J) after normalized actions (n, L), within the joint limits.

        They start from the previous targets, not from the measured positions: lag adds nothing.
        """
        change = torch.gather(normalized, 1, self._link) * self._max_step
        return torch.clamp(targets + change, self._lower, self._upper)

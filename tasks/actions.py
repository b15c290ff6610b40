"""From actions to targets: a change of every link's joint, clamped to its limits."""

from __future__ import annotations

from typing import Literal

import torch

from morphgen.errors import TaskError
from morphgen.tasks.bodies import Bodies
from morphgen.tasks.config import BINS

ActionKind = Literal["continuous", "discrete"]


def shares_of(
    actions: torch.Tensor, kind: ActionKind, shape: tuple[int, int], device: torch.device
) -> torch.Tensor:
    """Actions as shares of the joints' steps, in [-1, 1], shape (n, L).

    Args:
        actions: Continuous: numbers, clipped to [-1, 1]. Discrete: indices into ``BINS``.
        kind: Which of them.
        shape: (n, L), as expected.
        device: Where the environments are.

    Raises:
        TaskError: If the shape is another, a number is not finite, or an index is out of range.
    """
    if tuple(actions.shape) != shape:
        raise TaskError(f"actions have shape {tuple(actions.shape)}; expected {shape}")
    actions = actions.to(device)
    if kind == "continuous":
        lost = torch.nonzero(~torch.isfinite(actions))
        if len(lost):
            env, link = lost[0].tolist()
            raise TaskError(f"the action of environment {env}, link {link} is not finite")
        return actions.float().clamp(-1, 1)
    wrong = torch.nonzero((actions < 0) | (actions >= len(BINS)))
    if len(wrong) or actions.is_floating_point():
        where = f"environment {wrong[0, 0]}, link {wrong[0, 1]}: " if len(wrong) else ""
        raise TaskError(f"{where}discrete actions are whole numbers from 0 to {len(BINS) - 1}")
    return torch.tensor(BINS, device=device)[actions.long()]


def actions_of(shares: torch.Tensor, kind: ActionKind) -> torch.Tensor:
    """Shares of the joints' steps, (n, L), as actions: themselves, or the next bins towards zero.

    Towards zero, a bin never carries a joint past where it is to be.
    """
    if kind == "continuous":
        return shares
    bins = torch.tensor(BINS, device=shares.device)
    fits = (bins.abs() <= shares[..., None].abs() + 1e-6) & (bins * shares[..., None] >= 0)
    return torch.where(fits, bins.abs(), -torch.ones_like(bins)).argmax(dim=-1)


class Targets:
    """What actions make of the targets of a batch's joints."""

    def __init__(self, bodies: Bodies, body: torch.Tensor, mask: torch.Tensor) -> None:
        """Prepare.

        Args:
            bodies: The robots.
            body: Which robot each row is, shape (n,), int64.
            mask: Links whose action counts, shape (n, L), bool.
        """
        self._link = bodies.link_of_joint[body]
        self._step = bodies.step[body] * torch.gather(mask, 1, self._link)
        self._lower, self._upper = bodies.lower[body], bodies.upper[body]

    def __call__(self, targets: torch.Tensor, shares: torch.Tensor) -> torch.Tensor:
        """Targets after an action: from the targets before, not from where the joints are.

        Args:
            targets: Of the independent joints, shape (n, J).
            shares: Of the joints' steps, shape (n, L).

        Returns:
            Shape (n, J), within limits.
        """
        change = torch.gather(shares, 1, self._link) * self._step
        return torch.clamp(targets + change, self._lower, self._upper)

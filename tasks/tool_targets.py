"""Target points and orientations of a robot's tool, for observations and baselines."""

from __future__ import annotations

from dataclasses import dataclass

import torch


@dataclass(frozen=True, eq=False)
class ToolTargets:
    """Points and orientations that tasks want the tool at, in the root frame: n environments.

    They are for observation channels such as ``jacobian``; evaluation does not depend on them.
    """

    points: torch.Tensor
    """Target points, in the order in which the tool should visit them, shape (n, P, 3) [m]."""
    exists: torch.Tensor
    """Points that an environment's task has, shape (n, P), bool."""
    rotations: torch.Tensor | None = None
    """Orientations for the tool at the first point, shape (n, 3, 3); None if no task wants one."""
    has_rotation: torch.Tensor | None = None
    """Environments whose task wants an orientation, shape (n,), bool; None if none does."""

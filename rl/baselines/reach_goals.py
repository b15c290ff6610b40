"""Goals of reach as the baselines read them from a batch."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.reach.config import ReachConfig


@dataclass(frozen=True, eq=False)
class ReachGoals:
    """Goals of the n environments of a batch, in the root frames."""

    positions: torch.Tensor
    """Goal positions of the tools, shape (n, 3) [m]."""
    rotations: torch.Tensor | None
    """Goal rotations of the tools, shape (n, 3, 3); None for goals of positions."""
    metres_per_radian: float
    """See ``ReachConfig.metres_per_radian``."""


def reach_goals(task: TaskBatch) -> ReachGoals:
    """Return the goals of a batch whose environments reach."""
    config = next(spec.config for spec in task.specs if isinstance(spec.config, ReachConfig))
    rotations = task.groups.tool_targets(task.simulation.block_pose).rotations
    return ReachGoals(task.field("goal")[:, :3], rotations, config.metres_per_radian)

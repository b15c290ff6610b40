"""Baselines without memory: ``zero``, ``random``, and ``jacobian`` of reach.

``jacobian`` moves each joint along its own column of the tool's Jacobian. Joints do not know of
each other; a policy that transfers to unseen robots must beat it.
"""

from __future__ import annotations

import torch

from morphgen.model.kinematics_torch import frame_jacobian, pose_task
from morphgen.tasks.actions import BINS, encode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.observation import LinkJoints


class Zero:
    """Keeps all joint targets where they are."""

    def __init__(self, seed: int = 0) -> None:
        """Ignore the seed: nothing is random."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions that change no target, shape (n, L)."""
        mask = task.action_mask
        return encode_actions(torch.zeros(mask.shape, device=mask.device), task.action_kind)


class Random:
    """Draws every action from a uniform distribution."""

    def __init__(self, seed: int) -> None:
        self._generator = torch.Generator().manual_seed(seed)

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions (n, L), uniform over [-1, 1] or over the bins."""
        if task.action_kind == "discrete":
            actions = torch.randint(len(BINS), task.action_mask.shape, generator=self._generator)
        else:
            actions = 2 * torch.rand(task.action_mask.shape, generator=self._generator) - 1
        return actions.to(task.action_mask.device)


def reach_goals(task: TaskBatch) -> tuple[torch.Tensor, torch.Tensor | None, float]:
    """Return the goals of a batch whose environments reach, in the root frames.

    They are positions (n, 3) [m], rotations (n, 3, 3) or None for goals of positions, and
    ``ReachConfig.metres_per_radian``.
    """
    config = next(spec.config for spec in task.specs if isinstance(spec.config, ReachConfig))
    rotations = task.groups.tool_targets(task.simulation.object_pose).rotations
    return task.field("goal")[:, :3], rotations, config.metres_per_radian


GAIN = 0.3
"""Fraction of the error that a joint would remove in one control step if it acted alone. All joints
act at once and lag behind their targets, so that 1 overshoots; tuned on arm3 and Panda."""
MIN_COLUMN = 1e-4  # Jacobian columns shorter than this do not move the tool [m per rad or m per m]


class JacobianColumns:
    """Moves each joint j by a_j = GAIN (J_j . e) / (|J_j|^2 s_j), clipped to [-1, 1].

    J_j is the joint's column of the Jacobian, e the error from tool to goal, and s_j the joint's
    largest step. Jacobian and error are those of the measured joint positions. They have 3 rows, or
    6 for goals that are poses, where ``ReachConfig.metres_per_radian`` converts rotations.
    """

    def __init__(self, seed: int = 0) -> None:
        """Ignore the seed: nothing is random."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions, shape (n, L)."""
        tables, robots = task.robot_tables, task.env_robot_index
        T_root_tool, J_root_tool = frame_jacobian(tables.tool_chain, robots, task.q)
        positions, rotations, weight = reach_goals(task)
        if rotations is None:
            J, error = J_root_tool[:, :3], positions - T_root_tool[:, :3, 3]
        else:
            J, error = pose_task(T_root_tool, J_root_tool, positions, rotations, weight)
        steps = column_steps(J, error)
        fractions = (GAIN * steps / tables.max_step[robots].clamp(min=1e-9)).clamp(-1, 1)
        return encode_actions(LinkJoints(tables, robots)(fractions), task.action_kind)


def column_steps(J: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
    """Return the change of each joint that alone reduces the error (n, m) most, shape (n, J).

    It is the projection on the joint's column of J (n, m, J); 0 for columns below ``MIN_COLUMN``.
    """
    squares = J.square().sum(dim=1)
    steps = (J * error[..., None]).sum(dim=1) / squares.clamp(min=MIN_COLUMN**2)
    return torch.where(squares < MIN_COLUMN**2, torch.zeros_like(steps), steps)

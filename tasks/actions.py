"""Actions: decoding to normalized joint steps, encoding back, and motion of the joint targets."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any, Generic, Literal

import torch

from morphgen.errors import TaskError
from morphgen.tasks.rows import (
    all_true,
    at,
    clamped,
    flat_index,
    is_integral,
    limit_violation,
    namespace_of,
    row_sums,
)
from morphgen.tasks.sim.base import CONTROL_PERIOD, is_host
from morphgen.tasks.task import A, TaskState

if TYPE_CHECKING:
    from morphgen.tasks.scenes.robot_tables import RobotTables

ActionKind = Literal["continuous", "discrete"]

BINS = (-1.0, -1 / 2, -1 / 4, -1 / 8, -1 / 16, 0.0, 1 / 16, 1 / 8, 1 / 4, 1 / 2, 1.0)
"""Normalized actions that the discrete ones index, exponentially spaced about zero (AnyBody)."""
_INTEGERS = f"discrete actions are integers from 0 to {len(BINS) - 1}"
_TOLERANCE = 1e-6
"""Excess of a bin over the normalized action that it encodes which float32 rounding allows."""


class ActionDecoder(Generic[A]):
    """Decodes actions to fractions of the largest joint steps, in [-1, 1].

    On a GPU, which is not read here, actions that are not finite or out of range become nan: their
    environments diverge.
    """

    def __init__(self, kind: ActionKind, device: torch.device) -> None:
        """Put the constants on a device, so that no step copies them."""
        self._is_index = kind == "discrete"
        self._bins: Any = torch.tensor([BINS], device=device)
        # In NumPy these have no axes: arrays with one number and plain numbers take longer.
        self._lowest: Any = self._bins[:, 0]
        self._highest: Any = self._bins[:, -1]

    def __call__(self, actions: A, shape: tuple[int, ...]) -> A:
        """Return the fractions of actions of a ``shape`` (n, L).

        In NumPy they are those of one environment, a number for each of its joints that obey.
        """
        if actions.shape != shape:
            raise TaskError(f"actions have shape {tuple(actions.shape)}; expected {tuple(shape)}")
        xp, is_index = namespace_of(actions), self._is_index
        if is_index and not is_integral(actions):
            raise TaskError(_INTEGERS)
        is_valid = (actions >= 0) & (actions < len(BINS)) if is_index else xp.isfinite(actions)
        on_host = not isinstance(actions, torch.Tensor) or is_host(actions.device)
        if on_host and not all_true(is_valid):
            *env, link = xp.stack(xp.where(~is_valid))[:, 0].tolist()
            where = f"environment {env[0]}, link {link}" if env else f"joint {link}"
            raise TaskError(
                f"{where}: {_INTEGERS}" if is_index else f"the action of {where} is not finite"
            )
        if is_index:  # torch takes small integers for masks, or refuses them
            index = xp.asarray(xp.where(is_valid, actions, 0), dtype=xp.int64)
            numbers = at(self._bins, index)
        else:
            numbers = xp.asarray(actions, dtype=xp.float32)
            numbers = clamped(numbers, self._lowest, self._highest)
        decoded: A = numbers if on_host else xp.where(is_valid, numbers, xp.nan)
        return decoded


@lru_cache(maxsize=16)
def _bins_on(device: torch.device) -> torch.Tensor:
    return torch.tensor(BINS, device=device)


def encode_actions(normalized: torch.Tensor, kind: ActionKind) -> torch.Tensor:
    """Return normalized actions (n, L) as actions of a kind.

    A discrete action is the nearest bin towards zero, so that it never overshoots a target.
    """
    if kind == "continuous":
        return normalized
    bins = _bins_on(normalized.device)
    size = normalized.abs()[..., None] + _TOLERANCE  # so that a bin encodes to itself
    fits = (bins.abs() <= size) & (bins * normalized[..., None] >= 0)
    return torch.where(fits, bins.abs(), -torch.ones_like(bins)).argmax(dim=-1)


class JointMotion(Generic[A]):
    """The joint targets of a batch, and what its tasks need to know about the joints' motion.

    Attributes:
        targets: Targets of the independent joints, shape (n, J) [rad or m].
        previous_action: Normalized actions of the last step, shape (n, L).
        previous_qd: Velocities of the independent joints after the last step, shape (n, J).
    """

    def __init__(self, tables: RobotTables, env_robot_index: torch.Tensor) -> None:
        link = tables.link_of_joint[env_robot_index]
        self._link: Any = flat_index(link, tables.max_links)
        self._max_step: Any = tables.max_step[env_robot_index]
        self._lower: Any = tables.lower[env_robot_index]
        self._upper: Any = tables.upper[env_robot_index]
        zeros = tables.lower.new_zeros
        self.targets: Any = zeros(self._lower.shape)
        self.previous_qd: Any = zeros(self._lower.shape)
        self.previous_action: Any = zeros(len(link), tables.max_links)

    def act(self, normalized: A) -> None:
        """Advance the targets by normalized actions (n, L), within the joint limits.

        They start from the previous targets, not from the measured positions: lag adds nothing.
        """
        self.previous_action[:] = normalized
        change = at(normalized, self._link) * self._max_step
        self.targets[:] = clamped(self.targets + change, self._lower, self._upper)

    def task_state(self, q: A, qd: A, *, tool: A, object_pose: A, diverged: A) -> TaskState[A]:
        """Return the state after a step that ended at joint positions and velocities (n, J)."""
        acceleration = row_sums(abs(qd - self.previous_qd)) / CONTROL_PERIOD
        self.previous_qd[:] = qd
        violation = limit_violation(q, self._lower, self._upper)
        return TaskState(tool, object_pose, violation, acceleration, diverged)

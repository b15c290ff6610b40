"""Control steps of a batch of one environment in NumPy.

A call of torch takes microseconds however small its tensors are, and a step makes a hundred; a call
of NumPy takes a tenth of that. A step in NumPy equals ``TaskBatch.step`` to the rounding of single
precision. Rewards, scores and observation fields come from the task's own formulas, see
``TaskEnvs.numpy_row``.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.benchmark.tokens import FREQUENCIES, POSITION
from morphgen.model.kinematics import FramePosition
from morphgen.tasks.actions import BINS, decode_actions
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.gym.vector import NumpyObservation
from morphgen.tasks.observation import Observation
from morphgen.tasks.scenes.robot_tables import RobotTables
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.step_result import NumpyRow, TaskState

Float32 = NDArray[np.float32]
EnvStep = tuple[NumpyObservation, float, bool, bool, dict[str, Any]]
"""Observation, reward, whether terminated, whether truncated, and info, as of Gymnasium."""
_BINS = np.array(BINS, np.float32)


def numpy_stepper(
    batch: TaskBatch, unpadded: Callable[[Observation], NumpyObservation]
) -> NumpyStepper | None:
    """Return the stepper of a batch of one environment.

    Returns:
        None if the batch is not on the CPU, or if its task has no formulas in NumPy: its
        ``TaskEnvs`` has no ``numpy_row``, or is of a class that changes ``evaluate`` or ``observe``
        without it.
    """
    envs = batch.groups[batch.specs[0].task]
    depth = {
        name: next(i for i, cls in enumerate(type(envs).__mro__) if name in vars(cls))
        for name in ("numpy_row", "evaluate", "observe")
    }
    if batch.device.type != "cpu" or depth["numpy_row"] > min(depth.values()):
        return None
    row = envs.numpy_row(0)
    return None if row is None else NumpyStepper(batch, row, unpadded)


def pad_action(batch: TaskBatch, action: NDArray[Any]) -> torch.Tensor:
    """Return actions for all links, shape (1, L), from an action for the task's joints."""
    values = torch.from_numpy(action)
    actions = torch.zeros(batch.action_mask.shape, dtype=values.dtype)
    actions[batch.action_mask] = values
    return actions


class NumpyStepper:
    """Steps a batch of one environment.

    It works on views of the tensors of the batch, which is thus always in the same state. Unlike
    the batch it does not begin the next episode where one ends.
    """

    def __init__(
        self,
        batch: TaskBatch,
        row: NumpyRow,
        unpadded: Callable[[Observation], NumpyObservation],
    ) -> None:
        """Take views of the batch's tensors; ``begin`` must follow."""
        self._batch, self._row, self._unpadded = batch, row, unpadded
        tables = batch.robot_tables
        self._discrete = batch.action_kind == "discrete"
        self._links = np.flatnonzero(batch.action_mask[0].numpy())
        self._targets, self._previous_qd = batch.targets[0].numpy(), batch.previous_qd[0].numpy()
        self._previous_action = batch.previous_action[0].numpy()
        self._episode_step = batch.episode_step.numpy()
        self._max_episode_steps = int(batch.max_episode_steps[0])
        self._view_state()
        self._lower, self._upper = tables.lower[0].numpy(), tables.upper[0].numpy()
        self._limits = list(zip(self._lower.tolist(), self._upper.tolist(), strict=True))
        self._link_of_joint = tables.link_of_joint[0].numpy()
        self._max_step = tables.max_step[0].numpy()
        self._tokens, self._tool_position = _Tokens(tables), FramePosition(tables.robots[0])
        joint = tables.joint_of_link[0, : len(tables.robots[0].links)].numpy()
        self._joint_of_link, self._has_joint = np.maximum(joint, 0), joint >= 0
        self._constant: NumpyObservation = {}
        self._requested: Callable[[], NumpyObservation] = dict

    def begin(self, observation: NumpyObservation) -> None:
        """Begin an episode that the batch has begun."""
        requested = self._unpadded(self._batch.requested_entries()).keys()
        changing = {"tokens", *self._row.observe(self._block_pose), *requested}
        self._constant = {k: v.copy() for k, v in observation.items() if k not in changing}
        in_numpy: dict[str, Callable[[], Float32]] = {
            "velocity": lambda: self._qd[self._joint_of_link] * self._has_joint,
            "previous_action": lambda: self._previous_action[self._links],
            "tool": lambda: np.array(self._tool_position(self._q.tolist()), np.float32),
        }
        if requested <= in_numpy.keys():
            self._requested = lambda: {name: in_numpy[name]() for name in requested}
        else:
            self._requested = lambda: self._unpadded(self._batch.requested_entries())

    def step(self, action: NDArray[Any]) -> EnvStep:
        """Act for one control step."""
        self._previous_action[self._links] = self._normalized(action)
        change = self._previous_action[self._link_of_joint] * self._max_step
        np.minimum(np.maximum(self._targets + change, self._lower), self._upper, out=self._targets)
        diverged = self._simulate()
        steps = self._episode_step.item() + 1
        self._episode_step[0] = steps
        result = self._row.evaluate(self._state(diverged))
        self._previous_qd[:] = self._qd
        observation = {"tokens": self._tokens(self._q), **self._row.observe(self._block_pose)}
        for name, values in self._constant.items():
            observation[name] = values.copy()
        observation |= self._requested()
        terms = {name: float(term) for name, term in result.terms.items()}
        terminated = bool(result.terminated)
        info = {
            "success": bool(result.success),
            "is_success": bool(result.success),
            "distance": float(result.distance),
            "score": float(result.score),
            "diverged": diverged,
            "terms": terms,
        }
        if result.angle is not None:
            info["angle"] = float(result.angle)
        truncated = (steps >= self._max_episode_steps or diverged) and not terminated
        return observation, sum(terms.values()), terminated, truncated, info

    def _normalized(self, action: NDArray[Any]) -> Float32:
        """Return an action as fractions of the joints' largest steps; see ``decode_actions``."""
        if not self._discrete:
            if math.isfinite(action.dot(action)):  # all are finite
                return np.minimum(np.maximum(action.astype(np.float32), -1), 1)
        elif action.dtype.kind == "i" and ((action >= 0) & (action < len(BINS))).all():
            return np.asarray(_BINS[action])
        # Unusual or invalid: torch decodes it or says what is wrong.
        actions, kind = pad_action(self._batch, action), self._batch.action_kind
        decoded = decode_actions(actions, kind, (1, actions.shape[1]), self._batch.device)
        return np.asarray(decoded[0, self._links].numpy())

    def _simulate(self) -> bool:
        """Step the simulation, undo the step if it diverged; return whether it did."""
        q, block_pose = self._q.copy(), self._block_pose.copy()
        mask = self._batch.simulation.step(self._batch.targets)
        diverged = bool(mask.item())
        if diverged:
            state = torch.from_numpy(q[None]), torch.from_numpy(block_pose[None])
            self._batch.simulation.reset(mask, *state)
            self._previous_qd[:] = 0
        simulation = self._batch.simulation
        current = simulation.q, simulation.qd, simulation.block_pose
        if not all(map(operator.is_, current, self._tensors)):
            self._view_state()  # a simulator may replace its tensors
        return diverged

    def _view_state(self) -> None:
        """Take views of the simulation's tensors."""
        simulation = self._batch.simulation
        self._tensors = simulation.q, simulation.qd, simulation.block_pose
        self._q, self._qd, self._block_pose = (tensor[0].numpy() for tensor in self._tensors)

    def _state(self, diverged: bool) -> TaskState:
        """Return the state that the task evaluates, in NumPy; see ``NumpyRow``."""
        q, violation = self._q.tolist(), 0.0
        for position, (lower, upper) in zip(q, self._limits, strict=True):
            if position > upper:
                violation += position - upper
            elif position < lower:
                violation += lower - position
        change = np.abs(self._qd - self._previous_qd).tolist()
        values: list[Any] = [
            np.array(self._tool_position(q), np.float32),
            self._block_pose,
            violation,
            sum(change) / CONTROL_PERIOD,
            np.bool_(diverged),
        ]
        return TaskState(*values)


class _Tokens:
    """Tokens of a robot's links; see ``morphgen.tasks.observation.LinkTokens``."""

    def __init__(self, tables: RobotTables) -> None:
        num_links, num_codes = len(tables.robots[0].links), len(FREQUENCIES)
        self._constant = tables.tokens[0, :num_links].numpy()
        links = np.flatnonzero(tables.movable_links[0].numpy())
        gains, offsets = tables.position_gain[0, links].numpy(), tables.position_offset[0, links]
        joint = np.abs(gains).argmax(axis=1)  # each link follows one independent joint
        # Arrays of a number for each link and frequency: NumPy is fastest without broadcasting.
        rows = links, joint, gains[np.arange(len(links)), joint], offsets.numpy()
        link, self._joint, self._gain, self._offset = (np.repeat(row, num_codes) for row in rows)
        self._wraps = np.flatnonzero(tables.wraps[0].numpy()[link])
        self._frequencies = np.tile(FREQUENCIES.astype(np.float32), len(links))
        columns = POSITION.start + np.tile(np.arange(num_codes), len(links))
        self._sines = link * self._constant.shape[1] + columns
        self._cosines = self._sines + num_codes

    def __call__(self, q: Float32) -> Float32:
        """Return the tokens, shape (links, 48), at joint positions, shape (J,)."""
        x = self._gain * q[self._joint] + self._offset
        if len(self._wraps):
            x[self._wraps] -= 2 * np.ceil((x[self._wraps] - 1) / 2)
        angles = x * self._frequencies
        tokens = self._constant.copy()
        flat = tokens.reshape(-1)
        flat[self._sines], flat[self._cosines] = np.sin(angles), np.cos(angles)
        return tokens

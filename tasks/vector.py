"""A task batch as a Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.model.robot import Robot
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.make import make_batch
from morphgen.tasks.observation import Observation
from morphgen.tasks.task import BOUND

_INFO_KEYS = ("success", "distance", "score", "diverged")
"""Fields of a ``Step`` in ``infos``, besides the terms."""


Array = NDArray[Any]
NumpyObservation = dict[str, Array]


def numpy_observation(observation: Observation) -> NumpyObservation:
    """An observation of n environments in NumPy: own memory, float32, masks as int8.

    What has one number or none an environment gets an axis, so that every space is a vector; what
    is empty, such as obstacles where there are none, is left out.
    """
    found = {}
    for name, values in observation.items():
        wide = values.reshape(len(values), -1) if values.dim() == 1 else values
        if wide[0].numel():
            dtype = np.int8 if values.dtype == torch.bool else np.float32
            found[name] = np.array(wide.cpu().numpy(), dtype=dtype)
    return found


def observation_space(observation: NumpyObservation) -> spaces.Dict:
    """The space of one environment of a batch that is observed so: boxes, and masks."""
    made: dict[str, spaces.Space[Any]] = {}
    for name, values in sorted(observation.items()):
        shape = values.shape[1:]
        if values.dtype == np.int8:
            made[name] = spaces.MultiBinary(shape)
        else:
            made[name] = spaces.Box(-BOUND, BOUND, shape, np.float32)
    return spaces.Dict(made)


def action_space(kind: str, actions: int) -> spaces.Box | spaces.MultiDiscrete:
    """The space of one environment's actions: shares of the joints' steps, or indices of bins."""
    if kind == "continuous":
        return spaces.Box(-1.0, 1.0, (actions,), np.float32)
    return spaces.MultiDiscrete([len(BINS)] * actions)


class TaskVector(VectorEnv[NumpyObservation, Array, Array]):
    """A batch in NumPy. It owns the batch: ``close`` frees it.

    Observations are those of ``TaskBatch``, padded, float32; masks are int8, with at least one
    axis; what is empty is left out. An action has a number for every link, (n, L), of which those
    count that ``observation["actions"]`` marks: all bodies of a batch share this one space.

    Where an episode ends, the next begins in the same step (``AutoresetMode.SAME_STEP``):
    ``infos["final_obs"]`` is then an array of observations, and of None where none ended, and
    ``infos["final_info"]`` has the facts of the last step. Every step has ``success``,
    ``distance``, ``score``, ``diverged`` and ``terms`` (see ``Step``), each with its mask, such as
    ``_success``: the environments whose episode goes on, or in ``final_info`` those whose episode
    ended.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, batch: TaskBatch) -> None:
        """Wrap a batch, whose episodes begin anew at ``reset``."""
        self.batch, self.num_envs = batch, batch.num_envs
        seen = numpy_observation(batch.observe())
        self.single_observation_space = observation_space(seen)
        self.single_action_space = action_space(batch.action_kind, batch.robot_tables.max_links)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NumpyObservation, dict[str, Any]]:
        """Begin an episode everywhere.

        Args:
            seed: Of all episodes from now on, as ``make_batch`` has it; by default they go on.
            options: None are known.
        """
        self._require_open()
        super().reset(seed=seed)
        return numpy_observation(self.batch.reset(seed)), {}

    def step(self, actions: Array) -> tuple[NumpyObservation, Array, Array, Array, dict[str, Any]]:
        """Act for one control step.

        Raises:
            TaskError: If the actions are none.
            SimulationError: If the simulator failed.
        """
        self._require_open()
        step = self.batch.step(torch.from_numpy(np.array(actions)))
        terminated, truncated = _numpy(step.terminated), _numpy(step.truncated)
        over = terminated | truncated
        infos = _facts(step, ~over)
        if over.any():
            final = np.full(self.num_envs, None, dtype=object)
            rows = numpy_observation(step.final_observation)
            for env in np.flatnonzero(over):
                final[env] = {name: values[env].copy() for name, values in rows.items()}
            infos |= {"final_obs": final, "_final_obs": over.copy()}
            infos |= {"final_info": _facts(step, over), "_final_info": over.copy()}
        reward = _numpy(step.reward)
        return numpy_observation(step.observation), reward, terminated, truncated, infos

    def close_extras(self, **kwargs: object) -> None:
        """Free the batch."""
        self.batch.close()

    def _require_open(self) -> None:
        if self.closed:
            raise TaskError("these environments are closed")


def task_vector(
    num_envs: int,
    *,
    task: str,
    robot: str | Path | Robot = "ur5-plane",
    robots: Sequence[str | Path | Robot] = (),
    **options: Any,  # noqa: ANN401
) -> TaskVector:
    """Make what ``gymnasium.make_vec("morphgen/Reach-v0", num_envs, robots=[...])`` returns.

    Args:
        num_envs: Number of environments.
        task: Name of the task.
        robot: The robot of all environments, if ``robots`` names none.
        robots: Robots; environment i has robot i modulo their number.
        **options: As of ``make_batch``.
    """
    return TaskVector(make_batch(task, robots or [robot], num_envs, **options))


def _facts(step: Step, where: Array) -> dict[str, Any]:
    """What is known of a step, each with the mask of the environments that it is known of."""
    facts = {name: _numpy(getattr(step, name)) for name in _INFO_KEYS}
    found = _masked(facts, where)
    terms = _masked({name: _numpy(values) for name, values in step.terms.items()}, where)
    return found | {"terms": terms, "_terms": where.copy()}


def _masked(values: dict[str, Array], where: Array) -> dict[str, Any]:
    return values | {f"_{name}": where.copy() for name in values}


def _numpy(values: torch.Tensor) -> Array:
    return np.array(values.cpu().numpy())

"""A task batch as a Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.grammar.robot_source import RobotLike
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.make import make_batch
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import register_gym_envs
from morphgen.tasks.task import BOUND, ObservationField

register_gym_envs()  # morphgen.tasks may have been imported before Gymnasium

_INFO_KEYS = ("success", "distance", "score", "diverged")
"""Fields of a ``Step`` in ``infos``, besides the terms."""


Array = NDArray[Any]
NumpyObservation = dict[str, Array]


def numpy_observation(observation: Observation) -> NumpyObservation:
    """Return the observation of n environments as NumPy copies: float32, masks as int8.

    Entries with one number per environment get an axis, so that every space is at least a vector.
    Empty entries, such as obstacles if there are none, are left out.
    """
    entries = {}
    for name, values in observation.items():
        wide = values.reshape(len(values), -1) if values.dim() == 1 else values
        if wide[0].numel():
            dtype = np.int8 if values.dtype == torch.bool else np.float32
            entries[name] = np.array(wide.cpu().numpy(), dtype=dtype)
    return entries


def observation_space(
    observation: NumpyObservation, fields: Iterable[ObservationField]
) -> spaces.Dict:
    """Return the space of one environment from an observation of a batch: boxes, and masks.

    Args:
        observation: Observation of n environments.
        fields: Observation fields of the tasks, which declare the bounds of their entries.
    """
    bounds = {field.name: (field.low, field.high) for field in fields}
    entries: dict[str, spaces.Space[Any]] = {}
    for name, values in sorted(observation.items()):
        shape = values.shape[1:]
        if values.dtype == np.int8:
            entries[name] = spaces.MultiBinary(shape)
        else:
            low, high = bounds.get(name, (-BOUND, BOUND))
            entries[name] = spaces.Box(low, high, shape, np.float32)
    return spaces.Dict(entries)


def action_space(kind: str, actions: int) -> spaces.Box | spaces.MultiDiscrete:
    """Return the space of one environment's actions: fractions of joint steps, or bin indices."""
    if kind == "continuous":
        return spaces.Box(-1.0, 1.0, (actions,), np.float32)
    return spaces.MultiDiscrete([len(BINS)] * actions)


class TaskVector(VectorEnv[NumpyObservation, Array, Array]):
    """A batch with a NumPy interface. It owns the batch: ``close`` frees it.

    Observations are those of ``TaskBatch``, padded, float32; masks are int8, with at least one
    axis; empty entries are left out. An action has a number for every link, (n, L), of which those
    count that ``observation["actions"]`` marks: all robots of a batch share this one space.

    Where an episode ends, the next begins in the same step (``AutoresetMode.SAME_STEP``):
    ``infos["final_obs"]`` is then an array of observations, with None where no episode ended, and
    ``infos["final_info"]`` has the infos of the last step. Every step has ``success``,
    ``distance``, ``score``, ``diverged``, ``terms`` and, for goals that are poses, ``angle`` (see
    ``Step``), each with its mask, such as ``_success``: the environments whose episode goes on, or
    in ``final_info`` those whose episode ended.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, batch: TaskBatch) -> None:
        """Wrap a batch; ``reset`` begins new episodes."""
        self.batch, self.num_envs = batch, batch.num_envs
        self.single_observation_space = observation_space(
            numpy_observation(batch.observe()), batch.groups.observation_fields
        )
        self.single_action_space = action_space(batch.action_kind, batch.robot_tables.max_links)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NumpyObservation, dict[str, Any]]:
        """Begin an episode everywhere.

        Args:
            seed: Seed of all episodes from now on, as in ``make_batch``; by default the random
                streams continue.
            options: Unused.
        """
        self._require_open()
        super().reset(seed=seed)
        return numpy_observation(self.batch.reset(seed)), {}

    def step(self, actions: Array) -> tuple[NumpyObservation, Array, Array, Array, dict[str, Any]]:
        """Act for one control step.

        Raises:
            TaskError: If the actions are invalid.
            SimulationError: If the simulator failed.
        """
        self._require_open()
        step = self.batch.step(torch.from_numpy(np.array(actions)))
        terminated, truncated = _numpy(step.terminated), _numpy(step.truncated)
        over = terminated | truncated
        infos = _infos(step, ~over)
        if over.any():
            final = np.full(self.num_envs, None, dtype=object)
            rows = numpy_observation(step.final_observation)
            for env in np.flatnonzero(over):
                final[env] = {name: values[env].copy() for name, values in rows.items()}
            infos |= {"final_obs": final, "_final_obs": over.copy()}
            infos |= {"final_info": _infos(step, over), "_final_info": over.copy()}
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
    robot: RobotLike = "ur5-plane",
    robots: Sequence[RobotLike] = (),
    **options: Any,  # noqa: ANN401
) -> TaskVector:
    """Make a vector environment for ``gymnasium.make_vec("morphgen/Reach-v0", num_envs, ...)``.

    Args:
        num_envs: Number of environments.
        task: Name of the task.
        robot: The robot of all environments, if ``robots`` is empty.
        robots: Robots; environment i has robot i modulo their number.
        **options: Arguments of ``make_batch``.
    """
    return TaskVector(make_batch(task, robots or [robot], num_envs, **options))


def _infos(step: Step, where: Array) -> dict[str, Any]:
    """Return the infos of a step, each with the mask of the environments that have it."""
    names = _INFO_KEYS if step.angle is None else (*_INFO_KEYS, "angle")
    infos = _masked({name: _numpy(getattr(step, name)) for name in names}, where)
    terms = _masked({name: _numpy(values) for name, values in step.terms.items()}, where)
    return infos | {"terms": terms, "_terms": where.copy()}


def _masked(values: dict[str, Array], where: Array) -> dict[str, Any]:
    return values | {f"_{name}": where.copy() for name in values}


def _numpy(values: torch.Tensor) -> Array:
    return np.array(values.cpu().numpy())

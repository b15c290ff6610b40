"""A task batch as a Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from inspect import signature
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from morphgen.errors import TaskError, nearest, whole_number
from morphgen.grammar.robot_source import RobotLike
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import KINEMATIC_CHANNELS, TASKS, register_gym_envs
from morphgen.tasks.scenes.env_specs import task_configs
from morphgen.tasks.scenes.make import BatchOptions, make_batch
from morphgen.tasks.task import BOUND, TaskConfig

register_gym_envs()  # morphgen.tasks may have been imported before Gymnasium

LINK_ENTRIES = ("tokens", "velocity", *KINEMATIC_CHANNELS)
"""Entries of observations with a row for each link."""
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


def observation_space(observation: NumpyObservation) -> spaces.Dict:
    """Return the space of one environment from an observation of a batch: boxes, and masks."""
    entries: dict[str, spaces.Space[Any]] = {}
    for name, values in sorted(observation.items()):
        shape = values.shape[1:]
        if values.dtype == np.int8:
            entries[name] = spaces.MultiBinary(shape)
        else:
            entries[name] = spaces.Box(-BOUND, BOUND, shape, np.float32)
    return spaces.Dict(entries)


def action_space(kind: str, actions: int) -> spaces.Box | spaces.MultiDiscrete:
    """Return the space of one environment's actions: fractions of joint steps, or bin indices."""
    if kind == "continuous":
        return spaces.Box(-1.0, 1.0, (actions,), np.float32)
    return spaces.MultiDiscrete([len(BINS)] * actions)


OPTIONS = frozenset(
    {*signature(make_batch).parameters, *BatchOptions.__optional_keys__}
    - {"task", "robots", "num_envs", "options"}
)
"""Keyword arguments of ``make_batch`` that vector environments take."""


def batch_options(
    what: str,
    task: str,
    config: TaskConfig | Mapping[str, Any] | None,
    options: Mapping[str, Any],
    valid: frozenset[str],
) -> dict[str, Any]:
    """Return keyword arguments of ``make_batch``: options, and a ``config``, also as in JSON."""
    for name in options:
        if name not in valid:
            hint = nearest(name, valid | {"config", "robot"})
            raise TaskError(f"{what}: unknown option {name!r}{hint}")
    given = dict(options)
    kind = TASKS[task].config_type
    if isinstance(config, Mapping):
        try:
            (config,) = task_configs({task: config})
        except TypeError as error:
            raise TaskError(f"config {config}: {error}") from error
    if config is not None:
        if not isinstance(config, kind):
            raise TaskError(
                f"{type(config).__name__} is not the config of {task}: expected {kind.__name__}"
            )
        given["configs"] = (config,)
    return given


class BatchEnv:
    """Base of single environments and of vectors: a batch that is closed with them.

    Attributes:
        batch: The batch, which it owns.
        max_episode_steps: Time limit of episodes, of the longest if tasks differ [control steps].
    """

    batch: TaskBatch
    max_episode_steps: int
    closed = False

    def _wrap(self, batch: TaskBatch) -> None:
        self.batch, self.max_episode_steps = batch, int(batch.max_episode_steps.max())
        self._spec: EnvSpec | None = None
        self._running = False

    @property
    def spec(self) -> EnvSpec | None:
        """Specification of ``gym.make``, with ``max_episode_steps``; None without it."""
        return self._spec

    @spec.setter
    def spec(self, spec: EnvSpec | None) -> None:
        if spec is not None:
            limit = spec.max_episode_steps or self.max_episode_steps
            self._spec = replace(spec, max_episode_steps=limit)

    def _require_open(self) -> None:
        if self.closed:
            raise TaskError("this environment is closed")

    def _require_no_options(self, options: Mapping[str, Any] | None) -> None:
        if options:
            raise TaskError(f"reset: options {options!r}: expected none; a seed sets the episodes")

    def _require_running(self) -> None:
        self._require_open()
        if not self._running:
            raise TaskError("no episode is running; call reset()")


class TaskVector(BatchEnv, VectorEnv[NumpyObservation, Array, Array]):
    """A batch with a NumPy interface. It owns the batch: ``close`` frees it.

    Observations are those of ``TaskBatch``, float32; masks are int8, with at least one axis; empty
    entries are left out. They are padded to the largest robot, and an action has a number for every
    link whose joint the task controls in any of the robots, (n, K), of which those count that
    ``observation["actions"]`` marks: all robots of a batch share this one space.

    The next episode begins in the step in which one ends (``AutoresetMode.SAME_STEP``):
    ``infos["final_obs"]`` is then an array of observations, with None where no episode ended, and
    ``infos["final_info"]`` has the infos of the last step.

    Every step has ``success``, which is also ``is_success``, ``distance``, ``score``, ``diverged``,
    ``terms`` and, for goals that are poses, ``angle`` (see ``Step``), each with its mask, such as
    ``_success``: the environments whose episode goes on, or in ``final_info`` those whose episode
    ended.

    Attributes:
        action_links: Links whose joints the entries of an action move, K indices below L.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, batch: TaskBatch) -> None:
        self._wrap(batch)
        self.num_envs = batch.num_envs
        has_action, is_link = batch.action_mask.any(dim=0), batch.observe()["links"].any(dim=0)
        self.action_links: tuple[int, ...] = tuple(torch.nonzero(has_action)[:, 0].tolist())
        links = slice(int(torch.nonzero(is_link).max()) + 1)
        self._columns: dict[str, Any] = dict.fromkeys((*LINK_ENTRIES, "links"), links)
        self._columns |= {name: list(self.action_links) for name in ("actions", "previous_action")}
        self.single_observation_space = observation_space(self._numpy(batch.observe()))
        self.single_action_space = action_space(batch.action_kind, len(self.action_links))
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[NumpyObservation, dict[str, Any]]:
        """Begin an episode everywhere."""
        self._require_open()
        self._require_no_options(options)
        super().reset(seed=seed if isinstance(seed, int) else None)
        seeds: int | list[int] | None = None
        if isinstance(seed, Sequence | np.ndarray):
            # For all of them, so that an environment's does not depend on who else has None.
            drawn = [int(self.np_random.integers(2**63)) for _ in seed]
            seeds = [
                new if each is None else whole_number("seed", each, TaskError)
                for each, new in zip(seed, drawn, strict=True)
            ]
        elif seed is not None:
            seeds = whole_number("seed", seed, TaskError)
        self._running = False
        observation = self._numpy(self.batch.reset(seeds))
        self._running = True
        return observation, {}

    def step(self, actions: Array) -> tuple[NumpyObservation, Array, Array, Array, dict[str, Any]]:
        """Act for one control step."""
        self._require_running()
        step = self.batch.step(self._padded(actions))
        terminated, truncated = _numpy(step.terminated), _numpy(step.truncated)
        over = terminated | truncated
        infos = _infos(step, ~over)
        if over.any():
            final = np.full(self.num_envs, None, dtype=object)
            rows = self._numpy(step.final_observation)
            for env in np.flatnonzero(over):
                final[env] = {name: values[env].copy() for name, values in rows.items()}
            infos |= {"final_obs": final, "_final_obs": over.copy()}
            infos |= {"final_info": _infos(step, over), "_final_info": over.copy()}
        observation, reward = self._numpy(step.observation), _numpy(step.reward)
        return observation, reward, terminated, truncated, infos

    def close_extras(self, **kwargs: object) -> None:
        """Free the batch."""
        self.batch.close()

    def _padded(self, actions: Array) -> torch.Tensor:
        """Return actions for all links, shape (n, L)."""
        given, shape = np.asarray(actions), (self.num_envs, len(self.action_links))
        if given.shape != shape:
            raise TaskError(
                f"the actions have shape {given.shape}; expected {shape}: a column for each link "
                "of action_links"
            )
        padded = np.zeros((self.num_envs, self.batch.robot_tables.max_links), given.dtype)
        padded[:, list(self.action_links)] = given
        return torch.from_numpy(padded)

    def _numpy(self, observation: Observation) -> NumpyObservation:
        """Return an observation without the rows and columns that no robot has."""
        return {
            name: values[:, self._columns[name]] if name in self._columns else values
            for name, values in numpy_observation(observation).items()
        }


def task_vector(
    num_envs: int,
    *,
    task: str,
    robot: RobotLike = "ur5-plane",
    robots: Sequence[RobotLike] = (),
    config: TaskConfig | Mapping[str, Any] | None = None,
    **options: Any,  # noqa: ANN401
) -> TaskVector:
    """Make a vector environment for ``gymnasium.make_vec("morphgen/Reach-v0", num_envs, ...)``."""
    options = batch_options("vector environments", task, config, options, OPTIONS)
    if options.get("seed") is None:
        options["seed"] = int(np.random.default_rng().integers(2**63))
    return TaskVector(make_batch(task, robots or [robot], num_envs, **options))


def _infos(step: Step, where: Array) -> dict[str, Any]:
    """Return the infos of a step, each with the mask of the environments that have it."""
    names = _INFO_KEYS if step.angle is None else (*_INFO_KEYS, "angle")
    values = {name: _numpy(getattr(step, name)) for name in names}
    infos = _masked(values | {"is_success": values["success"].copy()}, where)
    terms = _masked({name: _numpy(values) for name, values in step.terms.items()}, where)
    return infos | {"terms": terms, "_terms": where.copy()}


def _masked(values: dict[str, Array], where: Array) -> dict[str, Any]:
    return values | {f"_{name}": where.copy() for name in values}


def _numpy(values: torch.Tensor) -> Array:
    return np.array(values.cpu().numpy())

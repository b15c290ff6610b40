"""A task batch as a Gymnasium vector environment."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from morphgen.errors import TaskError
from morphgen.model.robot import Robot
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.make import make_batch
from morphgen.tasks.spaces import NumpyObservation, action_space, arrays, observation_space

Array = NDArray[Any]
_TOLD = ("success", "distance", "score", "unstable")
"""What of a ``Step`` is in ``infos``, besides the terms."""


class TaskVector(VectorEnv[NumpyObservation, Array, Array]):
    """A batch in NumPy. It owns the batch: ``close`` frees it.

    Observations are those of ``TaskBatch``, padded, float32; masks are int8, with at least one
    axis; what is empty is left out. An action has a number for every link, (n, L), of which those
    count that ``observation["actions"]`` marks: all bodies of a batch share this one space.

    Where an episode ends, the next begins in the same step (``AutoresetMode.SAME_STEP``):
    ``infos["final_obs"]`` is then an array of observations, and of None where none ended, and
    ``infos["final_info"]`` has the facts of the last step. Every step has ``success``,
    ``distance``, ``score``, ``unstable`` and ``terms`` (see ``Step``), each with its mask, such as
    ``_success``: the environments whose episode goes on, or in ``final_info`` those whose episode
    ended.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP}  # noqa: RUF012

    def __init__(self, batch: TaskBatch) -> None:
        """Wrap a batch, whose episodes begin anew at ``reset``."""
        self.batch, self.num_envs = batch, batch.num_envs
        seen = arrays(batch.observe())
        self.single_observation_space = observation_space(seen)
        self.single_action_space = action_space(batch.kind, batch.bodies.max_links)
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
        return arrays(self.batch.reset(seed)), {}

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
            rows = arrays(step.final_observation)
            for env in np.flatnonzero(over):
                final[env] = {name: values[env].copy() for name, values in rows.items()}
            infos |= {"final_obs": final, "_final_obs": over.copy()}
            infos |= {"final_info": _facts(step, over), "_final_info": over.copy()}
        reward = _numpy(step.reward)
        return arrays(step.observation), reward, terminated, truncated, infos

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
    facts = {name: _numpy(getattr(step, name)) for name in _TOLD}
    found = _masked(facts, where)
    terms = _masked({name: _numpy(values) for name, values in step.terms.items()}, where)
    return found | {"terms": terms, "_terms": where.copy()}


def _masked(values: dict[str, Array], where: Array) -> dict[str, Any]:
    return values | {f"_{name}": where.copy() for name in values}


def _numpy(values: torch.Tensor) -> Array:
    return np.array(values.cpu().numpy())

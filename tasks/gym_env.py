"""One robot at a task as a plain Gymnasium environment."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError, nearest
from morphgen.model.robot import Robot
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.batch import Step
from morphgen.tasks.make import make_batch
from morphgen.tasks.observation import Observation, ObservationConfig
from morphgen.tasks.registry import TASKS, register_gym_envs
from morphgen.tasks.renderer import SIZE, Frame, Renderer, RenderState, render_state
from morphgen.tasks.sim.base import CONTROL_PERIOD, Contacts
from morphgen.tasks.task import STANDARD_FIELDS, TaskConfig
from morphgen.tasks.vector import (
    NumpyObservation,
    action_space,
    numpy_observation,
    observation_space,
)

RENDER_MODES = ("rgb_array",)

register_gym_envs()


class TaskEnv(gym.Env[NumpyObservation, NDArray[Any]]):
    """A robot at a task; ``gymnasium.make("morphgen/Reach-v0")`` makes one, and so for each task.

    Observations are those of ``TaskBatch`` without what only a batch of several robots needs: no
    padding, no masks, and no fields of other tasks. Tokens are (links, 48).

    An action is a number for each joint that the task moves, in the order of their links: for reach
    the joints on the way to the tool, for push fingers too. ``action_joints`` has their names,
    ``action_links`` their links, the rows of the tokens. Continuous actions are shares of a joint's
    largest step, in [-1, 1]; discrete ones are indices of ``morphgen.tasks.actions.BINS``.

    ``info`` has ``success``, ``distance``, ``score`` and ``terms`` (see ``Step``), and whether
    links touch each other, ``self_collision``. Episodes end by themselves: no time limit is needed.

    ``reset(seed=s)`` begins the episodes that environment 0 of ``make_batch(..., seed=s)`` has.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        task: str,
        robot: str | Path | Robot = "ur5-plane",
        *,
        sim: str | None = None,
        obstacles: bool = False,
        kind: ActionKind = "continuous",
        observe: ObservationConfig | None = None,
        contacts: Contacts | None = None,
        config: TaskConfig | None = None,
        goal_seed: int = 0,
        cache: Path | None = None,
        library: Iterable[Path] = (),
        max_links: int | None = None,
        render_mode: str | None = None,
        size: tuple[int, int] = SIZE,
    ) -> None:
        """Set up.

        Args:
            task: Name of a task, such as ``reach`` or ``push``.
            robot: A robot, or what ``load_robot`` knows: ``ur5-plane``, words of ``morphgen
                compose``, a bundle's folder or a URDF, with fitted primitives as collision shapes.
            sim: Name of a simulator, such as ``pybullet`` or ``mujoco``; by default
                ``default_simulator()``.
            obstacles: Whether there are any.
            kind: Actions are ``continuous`` or ``discrete``.
            observe: Entries of observations that are not there by default.
            contacts: What may touch what; by default everything.
            config: Constants of the task.
            goal_seed: Of goals, starts and obstacles.
            cache: Folder of these; by default the user's.
            library: Folders of your own parts.
            max_links: Number that link indices in tokens are relative to; by default the paper's
                23, or the links of the robot if it has more.
            render_mode: ``rgb_array`` or None.
            size: Width and height of what is rendered, pixels.

        Raises:
            TaskError: If an argument is none of the choices.
            MorphgenError: As ``make_batch``.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            hint = nearest(render_mode, RENDER_MODES)
            raise TaskError(f"unknown render mode {render_mode!r}{hint}")
        self._contacts = contacts or Contacts()
        kind_of_config = TASKS[task].config_type
        if config is not None and not isinstance(config, kind_of_config):
            raise TaskError(
                f"{type(config).__name__} is not the config of {task}: expected "
                f"{kind_of_config.__name__}"
            )
        self.task = task
        self.render_mode, self._size = render_mode, size
        self._renderer: Renderer | None = None
        self.batch = make_batch(
            self.task,
            [robot],
            1,
            obstacles=obstacles,
            goal_seed=goal_seed,
            configs=() if config is None else (config,),
            cache=cache,
            library=library,
            sim=sim,
            kind=kind,
            observe=observe,
            contacts=self._contacts,
            max_links=max_links,
        )
        self.env_spec = self.batch.specs[0]
        own = self.env_spec.robot
        other_fields = set(STANDARD_FIELDS) - set(TASKS[task].fields)
        self._hidden = {field.name for field in other_fields}
        self.action_links: tuple[int, ...] = tuple(
            torch.nonzero(self.batch.action_mask[0])[:, 0].tolist()
        )
        self.action_joints = tuple(own.joints[link - 1].name for link in self.action_links)
        self._running = self._closed = self._was_reset = False
        self._last: RenderState | None = None
        seen = self._seen(self.batch.observe())
        self.observation_space = cast(
            gym.Space[NumpyObservation], observation_space({k: v[None] for k, v in seen.items()})
        )
        self.action_space = action_space(kind, len(self.action_links))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NumpyObservation, dict[str, Any]]:
        """Begin an episode; without a seed the next one, and the very first at random."""
        self._require_open()
        super().reset(seed=seed)
        if seed is None and not self._was_reset:
            seed = int(self.np_random.integers(2**63))
        fresh = self._last is not None and seed is None
        seen = self.batch.observe() if fresh else self.batch.reset(seed)
        self._running, self._last, self._was_reset = True, None, True
        return self._seen(seen), {"self_collision": self._contacts.self_collision}

    def step(
        self, action: NDArray[Any]
    ) -> tuple[NumpyObservation, float, bool, bool, dict[str, Any]]:
        """Act for one control step.

        Raises:
            TaskError: If the action is none, or no episode is running.
            SimulationError: If the simulator failed.
        """
        self._require_open()
        if not self._running:
            raise TaskError("no episode is running; call reset()")
        actions = self._padded(action)
        now = render_state(self.batch)
        step = self.batch.step(actions)
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        if terminated or truncated:
            self._running = False
            self._last = _moved(now, step)
        seen = self._seen(step.final_observation)
        return seen, float(step.reward[0]), terminated, truncated, self._info(step)

    def render(self) -> Frame | None:
        """The environment as it is, (height, width, 3), if ``render_mode`` is ``rgb_array``."""
        self._require_open()
        if self.render_mode is None:
            gym.logger.warn(
                'nothing is rendered: make the environment with render_mode="rgb_array"'
            )
            return None
        if self._renderer is None:
            self._renderer = Renderer.of_spec(self.env_spec, self._size)
        return self._renderer.frame(self._last or render_state(self.batch))

    def close(self) -> None:
        """Free everything; a second time does nothing."""
        self._closed = True
        self.batch.close()
        if self._renderer is not None:
            self._renderer.close()

    def _require_open(self) -> None:
        if self._closed:
            raise TaskError("this environment is closed")

    def _padded(self, action: NDArray[Any]) -> torch.Tensor:
        """An action for every link, shape (1, L)."""
        given = np.asarray(action)
        expected = (len(self.action_links),)
        if given.shape != expected:
            joints = ", ".join(self.action_joints)
            raise TaskError(f"the action has shape {given.shape}; expected {expected}: {joints}")
        actions = torch.zeros(self.batch.action_mask.shape, dtype=torch.from_numpy(given).dtype)
        actions[0, list(self.action_links)] = torch.from_numpy(given)
        return actions

    def _seen(self, observation: Observation) -> NumpyObservation:
        """What is seen of a batch of one."""
        links = slice(len(self.env_spec.robot.links))
        rows: dict[str, Any] = {"tokens": links, "velocity": links}
        rows["previous_action"] = list(self.action_links)
        return {
            name: np.array(values[0][rows.get(name, slice(None))])
            for name, values in numpy_observation(observation).items()
            if values.dtype == np.float32 and name not in self._hidden
        }

    def _info(self, step: Step) -> dict[str, Any]:
        return {
            "success": bool(step.success[0]),
            "distance": float(step.distance[0]),
            "score": float(step.score[0]),
            "diverged": bool(step.diverged[0]),
            "terms": {name: float(term[0]) for name, term in step.terms.items()},
            "self_collision": self._contacts.self_collision,
        }


def _moved(before: RenderState, step: Step) -> RenderState:
    """Return the moment after a step, whatever episode has begun since."""
    block = None if before.block is None else step.block_pose[0].cpu().numpy()
    return replace(before, q=step.q[0, : len(before.q)].cpu().numpy(), block=block)

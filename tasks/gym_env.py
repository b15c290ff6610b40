"""One robot at a task as a plain Gymnasium environment."""

from __future__ import annotations

from dataclasses import replace
from os import PathLike
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.arguments import whole_number
from morphgen.errors import TaskError, nearest
from morphgen.grammar.library import LibraryFolders
from morphgen.grammar.robot_source import RobotLike
from morphgen.processes import Progress, no_progress
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.channels import KINEMATIC_CHANNELS
from morphgen.tasks.make import make_batch
from morphgen.tasks.numpy_step import EnvStep, numpy_stepper, pad_action
from morphgen.tasks.observation import Observation, ObservationConfig
from morphgen.tasks.obstacles import LayoutSide
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
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
_LINK_ENTRIES = ("tokens", "velocity", *KINEMATIC_CHANNELS)
"""Entries of observations with a row for each link."""


class TaskEnv(gym.Env[NumpyObservation, NDArray[Any]]):
    """A robot at a task, such as ``gymnasium.make("morphgen/Reach-v0")`` makes.

    Observations are those of ``TaskBatch`` without padding, masks and fields of other tasks; tokens
    have the shape (links, 48).

    An action has a number for each joint that the task controls, in the order of their links: for
    reach the joints between root and tool, for push fingers too. Continuous actions are fractions
    of a joint's largest step, in [-1, 1]; discrete ones are indices of
    ``morphgen.tasks.actions.BINS``.

    ``info`` has ``success``, ``distance``, ``score``, ``diverged``, ``terms``, for goals that
    are poses ``angle`` (see ``Step``), and ``self_collision``: whether links collide with each
    other in this environment. Episodes end by themselves: no time limit wrapper is needed.

    ``reset(seed=s)`` begins the same episodes as environment 0 of ``make_batch(..., seed=s)``.

    Reach and push on the CPU step in NumPy (``NumpyStepper``), several times as fast as the batch;
    all results equal the batch's to the rounding of single precision. A task whose ``TaskEnvs`` has
    no ``numpy_row``, such as one of another package, steps the batch in torch.

    Attributes:
        batch: The batch of one environment.
        env_spec: Specification of the environment.
        action_joints: Names of the joints that the entries of an action move.
        action_links: Indices of the links of these joints, which are rows of the tokens.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": list(RENDER_MODES),
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        task: str,
        robot: RobotLike = "ur5-plane",
        *,
        sim: str | None = None,
        obstacles: bool = False,
        layouts: LayoutSide = "train",
        kind: ActionKind = "continuous",
        observe: ObservationConfig | None = None,
        contacts: Contacts | None = None,
        config: TaskConfig | None = None,
        goal_seed: int = 0,
        cache: str | PathLike[str] | None = None,
        library: LibraryFolders = (),
        max_links: int | None = None,
        progress: Progress = no_progress,
        render_mode: str | None = None,
        size: tuple[int, int] = SIZE,
    ) -> None:
        """Load the robot, sample its goal set if it is not cached, and load the simulation.

        Args:
            task: Name of a task, such as ``reach`` or ``push``.
            robot: A robot, or a name that ``load_robot`` accepts: ``ur5-plane``, words of
                ``morphgen compose``, a bundle's folder or a URDF. Its collision shapes are the
                fitted primitives.
            sim: Name of a simulator, such as ``pybullet`` or ``mujoco``; by default
                ``DEFAULT_SIMULATOR``.
            obstacles: Whether there are obstacles.
            layouts: Layouts of obstacles that episodes draw from: those of training or of
                evaluation.
            kind: Actions are ``continuous`` or ``discrete``.
            observe: Optional entries of observations.
            contacts: Pairs of things that collide; by default everything.
            config: Constants of the task.
            goal_seed: Seed of goals, starts and obstacles.
            cache: Folder of stored goal sets; by default one in the user's cache.
            library: Folders of your own parts.
            max_links: Number that link indices in tokens are relative to; by default the paper's
                23, or the links of the robot if it has more.
            progress: Called with the number of robots whose goal set is ready, and their total.
            render_mode: ``rgb_array`` or None.
            size: Width and height of rendered pictures [pixels].

        Raises:
            TaskError: If an argument is invalid.
            MorphgenError: As ``make_batch``.
        """
        if render_mode is not None and render_mode not in RENDER_MODES:
            hint = nearest(render_mode, RENDER_MODES)
            raise TaskError(f"unknown render mode {render_mode!r}{hint}")
        sim = sim or DEFAULT_SIMULATOR
        self._self_collision = (contacts or Contacts()).self_collision
        self._self_collision &= SIMULATORS[sim].simulates_contacts
        config_type = TASKS[task].config_type
        if config is not None and not isinstance(config, config_type):
            raise TaskError(
                f"{type(config).__name__} is not the config of {task}: expected "
                f"{config_type.__name__}"
            )
        self.task = task
        try:
            width, height = (whole_number("size", pixels, TaskError, 1) for pixels in size)
        except (TypeError, ValueError) as error:
            raise TaskError(f"size {size!r}: expected width and height [pixels]") from error
        self.render_mode, self._size = render_mode, (width, height)
        self._renderer: Renderer | None = None
        self.batch = make_batch(
            self.task,
            [robot],
            1,
            obstacles=obstacles,
            layouts=layouts,
            goal_seed=goal_seed,
            configs=() if config is None else (config,),
            cache=cache,
            library=library,
            sim=sim,
            kind=kind,
            observe=observe,
            contacts=contacts,
            max_links=max_links,
            progress=progress,
        )
        self.env_spec = self.batch.specs[0]
        robot_links = self.env_spec.robot.joints
        other_fields = set(STANDARD_FIELDS) - set(TASKS[task].fields)
        self._hidden = {field.name for field in other_fields}
        self.action_links: tuple[int, ...] = tuple(
            torch.nonzero(self.batch.action_mask[0])[:, 0].tolist()
        )
        self.action_joints = tuple(robot_links[link - 1].name for link in self.action_links)
        self._running = self._closed = self._was_reset = self._next_has_begun = False
        self._final_state: RenderState | None = None
        self._stepper = numpy_stepper(self.batch, self._without_padding)
        first = self._without_padding(self.batch.observe())
        self.observation_space = cast(
            gym.Space[NumpyObservation],
            observation_space({k: v[None] for k, v in first.items()}, TASKS[task].fields),
        )
        self.action_space = action_space(kind, len(self.action_links))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NumpyObservation, dict[str, Any]]:
        """Begin an episode: the next one, or with a seed the first; the very first is random."""
        self._require_open()
        super().reset(seed=seed)
        if seed is None and not self._was_reset:
            seed = int(self.np_random.integers(2**63))
        next_has_begun = self._next_has_begun and seed is None
        observation = self._without_padding(
            self.batch.observe() if next_has_begun else self.batch.reset(seed)
        )
        if self._stepper is not None:
            self._stepper.begin(observation)
        self._running = self._was_reset = True
        self._next_has_begun, self._final_state = False, None
        return observation, {"self_collision": self._self_collision}

    def step(
        self, action: NDArray[Any]
    ) -> tuple[NumpyObservation, float, bool, bool, dict[str, Any]]:
        """Act for one control step.

        Raises:
            TaskError: If the action is invalid, or no episode is running.
            SimulationError: If the simulator failed.
        """
        self._require_open()
        if not self._running:
            raise TaskError("no episode is running; call reset()")
        action = self._checked(action)
        step = self._torch_step if self._stepper is None else self._stepper.step
        observation, reward, terminated, truncated, info = step(action)
        self._running = not (terminated or truncated)
        info["self_collision"] = self._self_collision
        return observation, reward, terminated, truncated, info

    def render(self) -> Frame | None:
        """Return a picture, shape (height, width, 3), if ``render_mode`` is ``rgb_array``."""
        self._require_open()
        if self.render_mode is None:
            gym.logger.warn(
                'nothing is rendered: make the environment with render_mode="rgb_array"'
            )
            return None
        if self._renderer is None:
            self._renderer = Renderer.of_spec(self.env_spec, self._size)
        return self._renderer.frame(self._final_state or render_state(self.batch))

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        self._closed = True
        self.batch.close()
        if self._renderer is not None:
            self._renderer.close()

    def _require_open(self) -> None:
        if self._closed:
            raise TaskError("this environment is closed")

    def _checked(self, action: NDArray[Any]) -> NDArray[Any]:
        """Return an action with a number for each of the task's joints."""
        action = np.asarray(action)
        expected = (len(self.action_links),)
        if action.shape != expected:
            joints = ", ".join(self.action_joints)
            raise TaskError(f"the action has shape {action.shape}; expected {expected}: {joints}")
        return action

    def _torch_step(self, action: NDArray[Any]) -> EnvStep:
        """Step the batch, which begins the next episode where one ends."""
        before = render_state(self.batch) if self.render_mode is not None else None
        step = self.batch.step(pad_action(self.batch, action))
        if step.terminated[0] or step.truncated[0]:
            self._next_has_begun = True
            if before is not None:  # the state to render comes from the step
                block = None if before.block is None else step.block_pose[0].cpu().numpy()
                q = step.q[0, : len(before.q)].cpu().numpy()
                self._final_state = replace(before, q=q, block=block)
        info = {
            "success": bool(step.success[0]),
            "distance": float(step.distance[0]),
            "score": float(step.score[0]),
            "diverged": bool(step.diverged[0]),
            "terms": {name: float(term[0]) for name, term in step.terms.items()},
        }
        if step.angle is not None:
            info["angle"] = float(step.angle[0])
        observation, ended = self._without_padding(step.final_observation), step.terminated
        return observation, float(step.reward[0]), bool(ended[0]), bool(step.truncated[0]), info

    def _without_padding(self, observation: Observation) -> NumpyObservation:
        """Return the observation of a batch of one without padding, masks and foreign fields."""
        links = slice(len(self.env_spec.robot.links))
        rows: dict[str, Any] = dict.fromkeys(_LINK_ENTRIES, links)
        rows["previous_action"] = list(self.action_links)
        return {
            name: np.array(values[0][rows.get(name, slice(None))])
            for name, values in numpy_observation(observation).items()
            if values.dtype == np.float32 and name not in self._hidden
        }

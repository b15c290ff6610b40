"""One robot at a task as a plain Gymnasium environment, which steps in NumPy.

A call of torch takes microseconds however small its tensors are, and a step makes a hundred; a call
of NumPy takes a tenth of that. A step in NumPy equals ``TaskBatch.step`` to the rounding of single
precision: all of its formulas are those of the batch, for arrays of NumPy.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from inspect import currentframe
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import TaskError, whole_number
from morphgen.grammar.robot_source import RobotLike
from morphgen.model.kinematics import FramePosition, frame_pose
from morphgen.tasks.actions import ActionDecoder, JointMotion
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.gym.vector import (
    LINK_ENTRIES,
    OPTIONS,
    Array,
    BatchEnv,
    NumpyObservation,
    action_space,
    batch_options,
    numpy_observation,
    observation_space,
)
from morphgen.tasks.observation import LinkJoints, LinkTokens, Observation
from morphgen.tasks.registry import TASKS
from morphgen.tasks.renderer import SIZE, Frame, Renderer, render_state
from morphgen.tasks.rows import numpy_row
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import STANDARD_FIELDS, StepFormulas, StepResult, TaskConfig

EnvStep = tuple[NumpyObservation, float, bool, bool, dict[str, Any]]
"""Observation, reward, whether terminated, whether truncated, and info, as of Gymnasium."""


class NumpyStepper:
    """Steps a batch of one environment in NumPy.

    It works on views of the tensors of the batch, which is thus always in the same state. Unlike
    the batch it does not begin the next episode where one ends.
    """

    def __init__(
        self, batch: TaskBatch, unpadded: Callable[[Observation], NumpyObservation]
    ) -> None:
        """Take views of the batch's tensors; ``begin`` must follow."""
        self._batch, self._unpadded = batch, unpadded
        envs = batch.groups[batch.specs[0].task]
        self._robot = robot = batch.specs[0].robot
        self._formulas: StepFormulas[Array] = numpy_row(envs.formulas)
        self._needs_tool_rotation = envs.needs_tool_rotation
        self._decode: ActionDecoder[Array] = numpy_row(batch.decode_actions)
        self._motion: JointMotion[Array] = numpy_row(batch.motion)
        self._tokens: LinkTokens[Array] = batch.observation.tokens.numpy_row()
        self._link_joints: LinkJoints[Array] = numpy_row(batch.observation.link_joints)
        self._tool_position = FramePosition(robot)
        self._rows = slice(len(robot.links))
        self._links = np.flatnonzero(batch.action_mask[0].numpy())
        self._normalized = np.zeros(batch.action_mask.shape[1], np.float32)
        self._episode_step = batch.episode_step.numpy()
        self._max_episode_steps = int(batch.max_episode_steps[0])
        simulation = batch.simulation
        tensors = simulation.q, simulation.qd, simulation.object_pose
        self._q, self._qd, self._object_pose = (tensor[0].numpy() for tensor in tensors)
        self._constant: NumpyObservation = {}
        self._requested: Callable[[], NumpyObservation] = dict

    def begin(self, observation: NumpyObservation) -> None:
        """Begin an episode that the batch has begun."""
        requested = self._unpadded(self._batch.requested_entries()).keys()
        changing = {"tokens", *self._formulas.observe(self._object_pose), *requested}
        self._constant = {k: v.copy() for k, v in observation.items() if k not in changing}
        in_numpy: dict[str, Callable[[], Array]] = {
            "velocity": lambda: self._link_joints(self._qd)[self._rows],
            "previous_action": lambda: self._motion.previous_action[self._links],
            "tool": self._tool,
        }
        if requested <= in_numpy.keys():
            self._requested = lambda: {name: in_numpy[name]() for name in requested}
        else:
            self._requested = lambda: self._unpadded(self._batch.requested_entries())

    def step(self, action: Array) -> EnvStep:
        """Act for one control step."""
        self._normalized[self._links] = self._decode(action, action.shape)
        self._motion.act(self._normalized)
        diverged = self._simulate()
        steps = self._episode_step.item() + 1
        self._episode_step[0] = steps
        state = self._motion.task_state(
            self._q,
            self._qd,
            tool=self._tool(),
            object_pose=self._object_pose,
            diverged=np.asarray(diverged)[()],
        )
        if self._needs_tool_rotation:
            state.tool_rotation = frame_pose(self._robot, self._q)[:3, :3].astype(np.float32)
        result = self._formulas.evaluate(state)
        observation = {"tokens": self._tokens(self._q)[self._rows]}
        for name, values in self._formulas.observe(self._object_pose).items():
            observation[name] = values.copy()
        for name, values in self._constant.items():
            observation[name] = values.copy()
        observation |= self._requested()
        info, terminated = _info(result, diverged), bool(result.terminated)
        truncated = (steps >= self._max_episode_steps or diverged) and not terminated
        return observation, sum(info["terms"].values()), terminated, truncated, info

    def _simulate(self) -> bool:
        """Step the simulation, undo the step if it diverged; return whether it did."""
        q, object_pose = self._q.copy(), self._object_pose.copy()
        simulation = self._batch.simulation
        mask = simulation.step(self._batch.targets)
        diverged = bool(mask)  # of one environment
        if diverged:
            simulation.reset(mask, torch.from_numpy(q[None]), torch.from_numpy(object_pose[None]))
            self._motion.previous_qd[:] = 0
        return diverged

    def _tool(self) -> Array:
        """Return the position of the tool, shape (3,) [m]."""
        return np.array(self._tool_position(self._q.tolist()), np.float32)


def _info(result: StepResult[Any], diverged: bool) -> dict[str, Any]:
    """Return the info of a step of one environment."""
    info: dict[str, Any] = {
        "success": bool(result.success),
        "is_success": bool(result.success),
        "distance": float(result.distance),
        "score": float(result.score),
        "diverged": diverged,
        "terms": {name: float(term) for name, term in result.terms.items()},
    }
    if result.angle is not None:
        info["angle"] = float(result.angle)
    return info


def render_arguments(render_mode: str | None, size: tuple[int, int]) -> tuple[int, int]:
    """Return a valid size of pictures [pixels]."""
    if render_mode not in (None, "rgb_array"):
        raise TaskError(f"unknown render mode {render_mode!r}; expected rgb_array")
    try:
        width, height = (whole_number("size", pixels, TaskError, 1) for pixels in size)
    except (TypeError, ValueError) as error:
        raise TaskError(f"size {size!r}: expected width and height [pixels]") from error
    if max(width, height) > MAX_SIDE:
        raise TaskError(f"size {size!r}: expected at most {MAX_SIDE:,} pixels each")
    return width, height


MAX_SIDE = 4096  # largest width and height of pictures [pixels]
_OPTIONS = OPTIONS - {"workers", "device", "seed", "first", "configs"} | {"render_mode", "size"}


class TaskEnv(BatchEnv, gym.Env[NumpyObservation, NDArray[Any]]):
    """A robot at a task, such as ``gymnasium.make("morphgen/Reach-v0")`` makes.

    Observations are those of ``TaskBatch`` without padding, masks and fields of other tasks; tokens
    have the shape (links, 48).

    An action has a number for each joint that the task controls, in the order of their links: for
    reach the joints between root and tool, for others fingers too. Continuous actions are fractions
    of a joint's largest step, in [-1, 1]; discrete ones are indices of
    ``morphgen.tasks.actions.BINS``.

    ``info`` has ``success``, which is also ``is_success``, ``distance``, ``score``, ``diverged``,
    ``terms`` and, for goals that are poses, ``angle`` (see ``Step``). Episodes end by themselves,
    after ``spec.max_episode_steps`` at the latest: no time limit wrapper is needed.

    ``reset(seed=s)`` begins the same episodes as environment 0 of ``make_batch(..., seed=s)``.

    It steps in NumPy on the CPU (``NumpyStepper``), several times as fast as the batch; all results
    equal the batch's to the rounding of single precision.

    Attributes:
        batch: The batch of one environment.
        env_spec: Specification of the environment.
        action_joints: Names of the joints that the entries of an action move.
        action_links: Indices of the links of these joints, which are rows of the tokens.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": round(1 / CONTROL_PERIOD),
    }

    def __init__(
        self,
        task: str,
        robot: RobotLike = "ur5-plane",
        *,
        config: TaskConfig | Mapping[str, Any] | None = None,
        render_mode: str | None = None,
        size: tuple[int, int] = SIZE,
        **options: Any,  # noqa: ANN401
    ) -> None:
        """Load the robot, sample its goal set if it is not cached, and load the simulation.

        The arguments are those of ``make_batch``; pictures have a width and a height [pixels].
        """
        self._size, self.render_mode = render_arguments(render_mode, size), render_mode
        self._renderer: Renderer | None = None
        options = batch_options("one environment", task, config, options, _OPTIONS)
        _require_limit(GoalConfig(tasks=options.get("configs", ())).task_config(task))
        self.task = task
        batch = make_batch(task, [robot], 1, **options)
        self._wrap(batch)
        self.env_spec = batch.specs[0]
        robot_links = self.env_spec.robot.joints
        fields = TASKS[task].fields
        self._hidden = {field.name for field in {*STANDARD_FIELDS} - {*fields}}
        self.action_links: tuple[int, ...] = tuple(
            torch.nonzero(self.batch.action_mask[0])[:, 0].tolist()
        )
        self.action_joints = tuple(robot_links[link - 1].name for link in self.action_links)
        self._was_reset = False
        self._stepper = NumpyStepper(batch, self._without_padding)
        first = self._without_padding(self.batch.observe())
        self.observation_space = cast(
            "gym.Space[NumpyObservation]", observation_space({k: v[None] for k, v in first.items()})
        )
        self.action_space = action_space(batch.action_kind, len(self.action_links))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NumpyObservation, dict[str, Any]]:
        """Begin an episode: the next one, or with a seed the first; the very first is random."""
        self._require_open()
        self._require_no_options(options)
        super().reset(seed=seed)
        if seed is None and not self._was_reset:
            seed = int(self.np_random.integers(2**63))  # Gymnasium: the first reset is random
        self._running = False
        observation = self._without_padding(self.batch.reset(seed))
        self._stepper.begin(observation)
        self._running = self._was_reset = True
        return observation, {}

    def step(self, action: NDArray[Any]) -> EnvStep:
        """Act for one control step."""
        self._require_running()
        action, expected = np.asarray(action), (len(self.action_links),)
        if action.shape != expected:
            joints = ", ".join(self.action_joints)
            raise TaskError(f"the action has shape {action.shape}; expected {expected}: {joints}")
        observation, reward, terminated, truncated, info = self._stepper.step(action)
        self._running = not (terminated or truncated)
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
        return self._renderer.frame(render_state(self.batch))

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        self.closed = True
        self.batch.close()
        if self._renderer is not None:
            self._renderer.close()

    def _without_padding(self, observation: Observation) -> NumpyObservation:
        """Return the observation of a batch of one without padding, masks and foreign fields."""
        links = slice(len(self.env_spec.robot.links))
        rows: dict[str, Any] = dict.fromkeys(LINK_ENTRIES, links)
        rows["previous_action"] = list(self.action_links)
        return {
            name: np.array(values[0][rows.get(name, slice(None))])
            for name, values in numpy_observation(observation).items()
            if values.dtype == np.float32 and name not in self._hidden
        }


def _require_limit(config: TaskConfig) -> None:
    """Refuse a ``max_episode_steps`` of ``gym.make`` before which all episodes end."""
    frame = currentframe()  # gym.make gives the number to a wrapper alone
    while frame is not None and frame.f_code is not gym.make.__code__:
        frame = frame.f_back
    given = None if frame is None else frame.f_locals.get("max_episode_steps")
    if isinstance(given, int) and given > config.max_episode_steps:
        raise TaskError(
            f"max_episode_steps {given}: episodes end after {config.max_episode_steps} control "
            f"steps; for longer ones pass a config of the task with max_episode_steps={given}"
        )

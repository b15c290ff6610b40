"""Act with a trained policy or a baseline: episodes of a batch, or of one robot with frames."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import torch
from msgspec import structs

from morphgen.errors import TaskError, nearest
from morphgen.formats.records import read_record
from morphgen.model.robot import Robot
from morphgen.processes import one_torch_thread
from morphgen.progress import note, report
from morphgen.rl.agents import AGENTS
from morphgen.rl.baselines import BASELINES, Controller
from morphgen.rl.config import policy_from
from morphgen.rl.observation_layout import (
    Layout,
    layout_of,
    pad_links,
    require_layout,
    truncate_links,
    with_fields,
)
from morphgen.rl.policies import make_networks, rows_needed
from morphgen.rl.runs.checkpoint import Interface, RunConfig, policy_interface, read_checkpoint
from morphgen.rl.shipped_policies import checkpoint_path, name_of, policies_for, tasks_of
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.observation import Observation
from morphgen.tasks.registry import TASKS, require_device
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.sim.base import CONTROL_PERIOD, is_host
from morphgen.tasks.task import TaskConfig

if TYPE_CHECKING:
    from morphgen.tasks.gym.env import TaskEnv
    from morphgen.tasks.renderer import Frame

Mode = Literal["deterministic", "stochastic"]
MODES: tuple[Mode, ...] = ("deterministic", "stochastic")
"""How a policy acts: by the mean of its actions, or by sampling."""


class Policy:
    """A trained policy, from observations to actions.

    Its observations are those of environments that are made with its ``batch_options``::

        policy = load_policy("zero-shot")
        batch = make_batch("reach", ["arm=ur5 ee=stick"], 4, **policy.batch_options)
        actions = policy.act(batch.reset())
    """

    def __init__(
        self,
        learner: dict[str, Any],
        mode: Mode,
        seed: int,
        device: str = "cpu",
        tasks: Sequence[TaskConfig] = (),
        interface: Interface | None = None,
    ) -> None:
        """Build the actor of a learner.

        Args:
            learner: State of a learner, as a checkpoint has it.
            mode: Whether the policy acts by the mean of its actions, or samples them.
            seed: Seed of the samples.
            device: Device of the network.
            tasks: Configs of the tasks that the policy is for, as for goals that are poses.
            interface: Actions and observations of its run; by default those of its layout.

        Raises:
            TaskError: If the state is of an agent that is unknown here.
        """
        self._tasks, self._interface = tuple(tasks), interface
        self.layout = read_record(learner["layout"], Layout, "layout", TaskError)
        """Layout of the observations that the policy was trained with."""
        self.config = policy_from(learner["policy"])
        self._device = torch.device(device)
        actor, _ = make_networks(self.config, self.layout, 0)
        actor.load_state_dict(learner["actor"])
        self._actor = actor.to(self._device).eval()
        self._deterministic = mode == "deterministic"
        self._generator = torch.Generator(self._device).manual_seed(seed)

    @property
    def batch_options(self) -> dict[str, Any]:
        """Arguments of ``make_batch`` for environments with the policy's observations and actions.

        They are continuous or discrete actions, the observation channels, the number of links that
        an agent for robots of one size needs, and the configs of the tasks.
        """
        links, obstacles = self.layout.links, self.layout.obstacles
        interface = self._interface or policy_interface(
            self.config, max_links=links, obstacles=obstacles
        )
        return vars(interface) | {"configs": self._tasks}

    def require(self, observation: Observation) -> None:
        """Require that an observation has the layout that the policy was trained with.

        Raises:
            TaskError: If it has another one.
        """
        layout = layout_of(observation)
        if AGENTS[self.config.agent].any_size:
            layout = structs.replace(layout, links=self.layout.links)
        require_layout(self.layout, layout, "the checkpoint")

    @torch.no_grad()
    def act(self, observation: Observation) -> torch.Tensor:
        """Return actions for observations, shape (n, L), on the device of the observations.

        Args:
            observation: Channels by name, tensors (n, ...), as ``TaskBatch`` returns them.

        Raises:
            TaskError: If the observations have another layout than those of the training.
        """
        observation = with_fields(observation, self.layout.fields)
        self.require(observation)
        needed = truncate_links(observation, rows_needed(self.config, observation))
        head = self._actor.distribution({k: v.to(self._device) for k, v in needed.items()})
        actions = head.mode() if self._deterministic else head.sample(self._generator)
        return pad_links(actions, observation["links"].shape[1]).to(observation["links"].device)


def load_policy(
    path: Path | str, mode: Mode = "deterministic", seed: int = 0, device: str = "cpu"
) -> Policy:
    """Load a policy. Nothing in its checkpoint is executed.

    Args:
        path: A checkpoint, the folder of a run, or the name of a shipped policy, such as
            ``zero-shot``.
        mode: Whether the policy acts by the mean of its actions, or samples them.
        seed: Seed of the samples.
        device: Device of the network.

    Raises:
        TaskError: If the checkpoint is missing, damaged or of another version, or the mode or
            device is unknown.
    """
    if mode not in MODES:
        raise TaskError(f"unknown mode {mode!r}{nearest(str(mode), MODES)}")
    require_device(device)
    run, learner = read_checkpoint(checkpoint_path(path))
    return Policy(learner, mode, seed, device, run.evaluation_tasks, run.interface)


class PolicyController:
    """Let a policy act in a batch as baselines do: it observes the batch, and acts on that."""

    def __init__(self, policy: Policy) -> None:
        self.policy = policy

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions of all environments, shape (n, L).

        Raises:
            TaskError: If the batch has other observations than those of the training.
        """
        return self.policy.act(task.observe())


STRIDE = 2  # control steps between two frames
FPS = 1 / (STRIDE * CONTROL_PERIOD)  # frames per second, so that videos run in real time: 25


@dataclass(frozen=True, eq=False)
class ControllerSpec:
    """A controller for one task: a baseline, or the policy of a checkpoint."""

    name: str  # name of a baseline or a shipped policy, or path of a checkpoint
    task: str  # name of the task
    task_config: TaskConfig
    """Constants of the task that the checkpoint's run is evaluated with, else the defaults."""
    interface: Interface = field(default_factory=Interface)
    """Interface of the policy; baselines take any environment."""
    learner: dict[str, Any] | None = None
    """State of the learner in the checkpoint; None for a baseline."""


def note_unfinished(file: Path, run: RunConfig, learner: dict[str, Any]) -> None:
    """Show that a checkpoint is not the last one of its run; shipped policies are as they are."""
    if learner["update"] < run.num_updates and name_of(file) == str(file):
        note(f"morphgen: {file} is not finished: update {learner['update']} of {run.num_updates}")


def read_controller(name: str, task: str) -> ControllerSpec:
    """Return the controller of a name; ``make_env_and_controller`` makes it."""
    valid = policies_for(task)
    if name not in valid and (tasks := tasks_of(name)):
        raise TaskError(
            f"policy {name!r} is for {' or '.join(tasks)}, not for {task}; "
            f"valid: {', '.join(valid)}"
        )
    if name in BASELINES:
        return ControllerSpec(name, task, GoalConfig().task_config(task))
    path = checkpoint_path(name)
    if not path.exists():
        raise TaskError(f"{name!r} is neither a checkpoint nor a policy{nearest(name, valid)}")
    run, learner = read_checkpoint(path)
    note_unfinished(path, run, learner)
    config = GoalConfig(tasks=run.evaluation_tasks).task_config(task)
    return ControllerSpec(name, task, config, run.interface, learner)


def make_controller(spec: ControllerSpec, seed: int) -> Controller:
    """Return a new controller; its random numbers depend on the seed alone."""
    if spec.learner is None:
        return BASELINES[spec.name].make(seed)
    return PolicyController(Policy(spec.learner, "deterministic", seed))


def make_env_and_controller(
    spec: ControllerSpec,
    robot: str | Robot,
    seed: int,
    **options: Any,  # noqa: ANN401
) -> tuple[TaskEnv, Controller]:
    """Make an environment that suits a controller, and the controller.

    Unless ``config`` is given, the task has the constants that the controller is evaluated with.
    """
    # Evaluations of batches need neither Gymnasium nor the renderer with its video encoder.
    from morphgen.tasks.gym.env import TaskEnv

    controller = make_controller(spec, seed)
    options = {"config": spec.task_config, "layouts": "eval", **vars(spec.interface), **options}
    env = TaskEnv(spec.task, robot, **options)
    if isinstance(controller, PolicyController):
        try:
            controller.policy.require(env.batch.observe())
        except TaskError:
            env.close()
            raise
    return env, controller


def play(
    env: TaskEnv,
    controller: Controller,
    episodes: int,
    seed: int,
    report: Callable[[Episode], None],
    max_successes: int | None = None,
) -> Iterator[Frame]:
    """Run episodes, and yield their frames if the environment renders.

    Yields:
        Frames, ``FPS`` per second of simulated time, with the first and last frame of each episode.
    """
    links = list(env.action_links)
    for number in range(episodes):
        env.reset(seed=seed if number == 0 else None)
        yield from _shown(env)
        scores: list[float] = []
        successes, over = 0, False
        while not over:
            with one_torch_thread():
                action = controller.act(env.batch)[0, links].cpu().numpy()
                _, _, terminated, truncated, info = env.step(action)
            scores.append(info["score"])
            successes = successes + 1 if info["success"] else 0
            over = terminated or truncated or successes == max_successes
            if over or len(scores) % STRIDE == 0:
                yield from _shown(env)
        score = TASKS[env.task].episode_score(sum(scores), scores[-1], len(scores))
        facts = info["success"], info["distance"], score, len(scores), info["diverged"]
        report(Episode(0, 0, *facts, info.get("angle", math.nan)))


def _shown(env: TaskEnv) -> Iterator[Frame]:
    if env.render_mode is not None:
        frame = env.render()
        assert frame is not None
        yield frame


STEPS_UNREAD = 32  # number of control steps after which the results on a GPU are read


@dataclass(frozen=True)
class Episode:
    """Result of an episode."""

    env: int  # index of the environment
    robot_index: int  # index of the robot
    success: bool  # whether the episode ended in success
    distance: float  # distance from success at the end [m]
    score: float  # score of the episode; see `episode_score`
    steps: int  # length of the episode [control steps]
    diverged: bool  # whether the episode ended because the simulation diverged
    angle: float = math.nan
    """Angle from success at the end [rad]; nan if the task wants no orientation."""

    @property
    def seconds(self) -> float:
        """Length of the episode [s of simulated time]."""
        return self.steps * CONTROL_PERIOD


@one_torch_thread()
def run_episodes(batch: TaskBatch, controller: Controller, count: int) -> list[Episode]:
    """Return the first ``count`` episodes of every environment, by environment and then by time."""
    batch.reset()
    n = batch.num_envs
    batch.is_idle = torch.zeros_like(batch.is_idle)
    results = EpisodeResults(n, count, batch.device)
    on_host = is_host(batch.device)
    num_steps = 0
    while True:
        step = batch.step(controller.act(batch))
        results.add(step)
        batch.is_idle = results.finished >= count
        num_steps += 1
        if on_host or num_steps % STEPS_UNREAD == 0:
            is_running = results.finished < count
            fractions = (results.steps / batch.max_episode_steps)[is_running]
            done = results.finished.clamp(max=count).sum() + fractions.sum()
            report(float(done), count * n)
            if not is_running.any():
                return results.episodes(batch)


class EpisodeResults:
    """Results of the first episodes of every environment, on the device of the batch.

    ``finished`` is the number of episodes that ended, ``steps`` that of the control steps of the
    running ones, both (n,), int64.
    """

    def __init__(self, n: int, count: int, device: torch.device) -> None:
        """Prepare to record ``count`` episodes of each of n environments."""
        self.finished, self.steps = torch.zeros(2, n, dtype=torch.int64, device=device)
        self._total = torch.zeros(n, device=device)
        # Success, distance, total and last score, steps, divergence and angle of each episode.
        self._numbers = torch.zeros(n, count, 7, dtype=torch.float64, device=device)
        self._rows = torch.arange(n, device=device)

    def add(self, step: Step) -> None:
        """Record a step, and the episodes that ended in it."""
        self._total += step.score
        self.steps += 1
        ended = step.terminated | step.truncated
        if is_host(ended.device) and not ended.any():
            return
        angle = torch.full_like(step.score, math.nan) if step.angle is None else step.angle
        scores = (self._total, step.score)
        values = (step.success, step.distance, *scores, self.steps, step.diverged, angle)
        numbers = torch.stack([value.double() for value in values], dim=1)
        count = self._numbers.shape[1]
        column = self.finished.clamp(max=count - 1)
        # Without a boolean index, which would wait for a GPU.
        is_new = (ended & (self.finished < count))[:, None]
        old = self._numbers[self._rows, column]
        self._numbers[self._rows, column] = torch.where(is_new, numbers, old)
        self.finished += ended
        self._total.masked_fill_(ended, 0)
        self.steps.masked_fill_(ended, 0)

    def episodes(self, batch: TaskBatch) -> list[Episode]:
        """Return the episodes, ordered by environment and then by time."""
        episodes = []
        numbers = self._numbers.tolist()  # at once: each read of a GPU waits for it
        for env, robot in enumerate(batch.env_robot_index.tolist()):
            task = TASKS[batch.specs[robot].task]
            for success, distance, total, last, steps, diverged, angle in numbers[env]:
                score = task.episode_score(total, last, int(steps))
                facts = bool(success), distance, score, int(steps), bool(diverged), angle
                episodes.append(Episode(env, robot, *facts))
        return episodes

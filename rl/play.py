"""Run episodes of one robot with a controller, and render them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

from morphgen.errors import TaskError, nearest
from morphgen.model.robot import Robot
from morphgen.processes import one_torch_thread
from morphgen.rl.baselines import BASELINES
from morphgen.rl.inference import Policy, PolicyController
from morphgen.rl.rollouts import Controller, Episode
from morphgen.rl.runs.checkpoint import Interface, read_checkpoint
from morphgen.rl.shipped_policies import checkpoint_path, policies_for, tasks_of
from morphgen.tasks.actions import ActionKind
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.registry import TASKS
from morphgen.tasks.render.renderer import Frame
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import TaskConfig

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
    config = GoalConfig(tasks=run.evaluation_tasks).task_config(task)
    return ControllerSpec(name, task, config, run.interface, learner)


def make_env_and_controller(
    spec: ControllerSpec,
    robot: str | Robot,
    seed: int,
    *,
    kind: ActionKind | None = None,
    **options: Any,  # noqa: ANN401
) -> tuple[TaskEnv, Controller]:
    """Make an environment that suits a controller, and the controller.

    Unless ``config`` is given, the task has the constants that the controller is evaluated with.
    """
    interface = vars(spec.interface)
    if spec.learner is not None and kind not in (None, spec.interface.kind):
        raise TaskError(f"{spec.name}: its actions are {spec.interface.kind}, not {kind}")
    if kind is not None:
        interface = interface | {"kind": kind}
    options = {"config": spec.task_config, "layouts": "eval", **interface, **options}
    env = TaskEnv(spec.task, robot, **options)
    if spec.learner is None:
        return env, BASELINES[spec.name].make(seed)
    policy = Policy(spec.learner, "deterministic", seed)
    try:
        policy.require(env.batch.observe())
    except TaskError:
        env.close()
        raise
    return env, PolicyController(policy)


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

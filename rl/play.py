"""Run episodes of one robot with a controller, and render them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path

from morphgen.errors import TaskError, nearest
from morphgen.rl.baselines import BASELINES
from morphgen.rl.evaluation import eval_config_of
from morphgen.rl.inference import Policy, PolicyController
from morphgen.rl.rollouts import Controller, Episode
from morphgen.rl.runs import Interface, read_checkpoint
from morphgen.rl.shipped_policies import checkpoint_path, policies_for, tasks_of
from morphgen.tasks.env_specs import GoalConfig
from morphgen.tasks.gym_env import TaskEnv
from morphgen.tasks.registry import TASKS
from morphgen.tasks.renderer import Frame
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import TaskConfig

STRIDE = 2
"""Control steps between two frames."""
FPS = 1 / (STRIDE * CONTROL_PERIOD)
"""Frames per second, so that videos run in real time: 25."""


def require_policy(name: str, task: str) -> None:
    """Require that a controller exists for a task.

    Raises:
        TaskError: If it is unknown, or for another task.
    """
    valid = policies_for(task)
    if name in valid:
        return
    if tasks := tasks_of(name):
        raise TaskError(
            f"policy {name!r} is for {' or '.join(tasks)}, not for {task}; "
            f"valid: {', '.join(valid)}"
        )
    if _checkpoint(name) is None:
        raise TaskError(f"{name!r} is neither a checkpoint nor a policy{nearest(name, valid)}")


def interface_of(name: str) -> Interface:
    """Return the interface of a checkpoint's policy; baselines take any environment.

    Raises:
        TaskError: If the file is not a checkpoint.
    """
    file = _checkpoint(name)
    return Interface() if file is None else read_checkpoint(file)[0].interface


def task_config_of(name: str, task: str) -> TaskConfig:
    """Return the constants of a task that a checkpoint's policy is evaluated with, else defaults.

    Raises:
        TaskError: If the file is not a checkpoint.
    """
    file = _checkpoint(name)
    if file is None:
        return GoalConfig().task_config(task)
    run, _ = read_checkpoint(file)
    return GoalConfig(tasks=eval_config_of(run, 1).tasks).task_config(task)


def make_controller(name: str, env: TaskEnv, seed: int) -> Controller:
    """Return a controller by its name.

    Args:
        name: Name of a baseline or a shipped policy; or the path of a checkpoint or of a run's
            folder, whose policy acts by the mean of its actions.
        env: Environment that the controller acts in.
        seed: Seed of random numbers.

    Raises:
        TaskError: As ``require_policy``; or if the file is not a checkpoint, or one for other
            observations or actions.
        BenchmarkError: If the robot has hardly any collision-free configuration.
    """
    require_policy(name, env.task)
    file = _checkpoint(name)
    if file is not None:
        run, learner = read_checkpoint(file)
        if run.policy.kind != env.batch.action_kind:
            raise TaskError(
                f"{name}: its actions are {run.policy.kind}, not {env.batch.action_kind}"
            )
        policy = Policy(learner, "deterministic", seed)
        policy.require(env.batch.observe())
        return PolicyController(policy)
    return BASELINES[name].make(seed)


def play(
    env: TaskEnv,
    controller: Controller,
    episodes: int,
    seed: int,
    report: Callable[[Episode], None],
) -> Iterator[Frame]:
    """Run episodes, and yield their frames if the environment renders.

    Args:
        env: The environment, not wrapped.
        controller: The controller.
        episodes: Number of episodes.
        seed: Seed of the episodes.
        report: Called with the result of each episode.

    Yields:
        Frames, ``FPS`` per second of simulated time, with the first and last frame of each episode.

    Raises:
        SimulationError: If the simulator fails.
    """
    links = list(env.action_links)
    for number in range(episodes):
        env.reset(seed=seed if number == 0 else None)
        yield from _shown(env)
        scores: list[float] = []
        over = False
        while not over:
            action = controller.act(env.batch)[0, links].cpu().numpy()
            _, _, terminated, truncated, info = env.step(action)
            scores.append(info["score"])
            over = terminated or truncated
            if over or len(scores) % STRIDE == 0:
                yield from _shown(env)
        score = TASKS[env.task].episode_score(sum(scores), scores[-1], len(scores))
        facts = info["success"], info["distance"], score, len(scores), info["diverged"]
        report(Episode(0, 0, *facts, info.get("angle", math.nan)))


def _checkpoint(policy: str) -> Path | None:
    """Return the checkpoint or run folder that a policy's name means; None for a baseline."""
    path = checkpoint_path(policy)
    return path if policy not in BASELINES and path.exists() else None


def _shown(env: TaskEnv) -> Iterator[Frame]:
    if env.render_mode is not None:
        frame = env.render()
        assert frame is not None
        yield frame

"""Watch a controller at work: episodes of one robot, with their results and pictures."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

from morphgen.errors import TaskError, nearest
from morphgen.rl.names import REFERENCES, references_for
from morphgen.rl.references import reference
from morphgen.rl.rollouts import Controller, Episode
from morphgen.rl.runs import Interface, read_checkpoint
from morphgen.rl.trained import Policy
from morphgen.tasks.config import CONTROL_PERIOD
from morphgen.tasks.gym_env import TaskEnv
from morphgen.tasks.registry import TASKS
from morphgen.tasks.renderer import Frame

STRIDE = 2
"""Control steps between two pictures."""
FPS = 1 / (STRIDE * CONTROL_PERIOD)
"""Pictures a second, so that films run as fast as what they show: 25."""


def require_policy(name: str, task: str) -> None:
    """Require that there is such a controller for a task.

    Raises:
        TaskError: If there is none, or it is for other tasks.
    """
    if _is_file(name):
        return
    valid = references_for(task)
    if name in REFERENCES and name not in valid:
        raise TaskError(
            f"policy {name!r} is for {' or '.join(REFERENCES[name] or ())}, not for {task}; "
            f"valid: {', '.join(valid)}"
        )
    if name not in REFERENCES:
        raise TaskError(f"{name!r} is no checkpoint, and no policy{nearest(name, valid)}")


def demands(name: str) -> Interface:
    """What a checkpoint's policy sees and does; other controllers take any environment.

    Raises:
        TaskError: If what is there is no checkpoint.
    """
    if not _is_file(name):
        return Interface()
    run, _ = read_checkpoint(Path(name))
    return run.interface


def controller(name: str, env: TaskEnv, seed: int) -> Controller:
    """A controller by its name.

    Args:
        name: ``zero``, ``random``, ``ik`` (for reach) or ``scripted`` (for push); or the path of a
            checkpoint or of a run's folder, whose policy acts by the mean of its actions.
        env: What it is to act in.
        seed: Of what it draws.

    Raises:
        TaskError: As ``require_policy``; or if what is there is no checkpoint, or one for other
            observations or actions.
        BenchmarkError: If the robot has hardly a free configuration.
    """
    require_policy(name, env.task)
    if _is_file(name):
        run, learner = read_checkpoint(Path(name))
        if run.policy.kind != env.batch.kind:
            raise TaskError(f"{name}: its actions are {run.policy.kind}, not {env.batch.kind}")
        policy = Policy(learner, "deterministic", seed)
        policy.require(env.batch.observe())
        return policy
    return reference(name, env.batch, seed)


def play(
    env: TaskEnv,
    acting: Controller,
    episodes: int,
    seed: int,
    report: Callable[[Episode], None],
) -> Iterator[Frame]:
    """Run episodes, and show them if the environment is rendered.

    Args:
        env: The environment, not wrapped.
        acting: The controller.
        episodes: How many.
        seed: Of the episodes.
        report: Called at the end of each.

    Yields:
        Pictures, ``FPS`` a second of simulated time, with the first and last moment of an episode.

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
            action = acting.act(env.batch)[0, links].cpu().numpy()
            _, _, terminated, truncated, info = env.step(action)
            scores.append(info["score"])
            over = terminated or truncated
            if over or len(scores) % STRIDE == 0:
                yield from _shown(env)
        score = TASKS[env.task].episode_score(sum(scores), scores[-1], len(scores))
        facts = info["success"], info["distance"], score, len(scores), info["unstable"]
        report(Episode(0, 0, *facts))


def _is_file(policy: str) -> bool:
    return policy not in REFERENCES and Path(policy).exists()


def _shown(env: TaskEnv) -> Iterator[Frame]:
    if env.render_mode is not None:
        frame = env.render()
        assert frame is not None
        yield frame

"""A shipped policy on robots that it never saw, beside controllers that do not learn."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from morphgen.errors import TaskError
from morphgen.rl.evaluation import EvalConfig, evaluate_baseline, evaluate_checkpoints
from morphgen.rl.intervals import Interval, wilson_interval
from morphgen.rl.robot_source import RobotSource
from morphgen.rl.scores import Score
from morphgen.rl.shipped_policies import ZERO_SHOT, name_of

COMPARED = ("jacobian", "ik", "random")
"""Controllers that the policy is compared with."""

Progress = Callable[[str, float, int], None]
"""Callback with a controller, the number of its episodes done, and their total."""


@dataclass(frozen=True)
class ZeroShotResult:
    """Result of a controller on a robot."""

    controller: str
    """Name of the controller."""
    episodes: int
    """Number of episodes."""
    success: Interval
    """Success rate with its 95% Wilson interval."""
    distance: float
    """Mean distance between tool and goal at the end of an episode [m]."""
    score: float
    """Mean score of the episodes, relative to the random policy."""


def zero_shot(
    source: RobotSource,
    config: EvalConfig,
    *,
    policy: Path = ZERO_SHOT.file,
    progress: Progress = lambda name, done, total: None,
) -> list[ZeroShotResult]:
    """Run a policy, and the controllers of ``COMPARED``, on a robot that reaches.

    All of them have the same starts and goals.

    Args:
        source: One robot, at reach.
        config: Episodes, simulator and seed.
        policy: Checkpoint of the policy, or folder of its run.
        progress: Callback for the progress.

    Raises:
        TaskError: If the source is no single robot at reach, or the checkpoint is invalid.
        MorphgenError: If the robot or simulator cannot be built.
    """
    if source.task != "reach":
        raise TaskError(f"{source.name}: task {source.task}; expected a robot at reach")
    name = name_of(policy)
    (score,) = evaluate_checkpoints(
        [policy],
        source,
        config,
        "deterministic",
        progress=lambda done, total: progress(name, done, total),
    )
    scores = [(name, score)]
    for baseline in COMPARED:
        (score,) = evaluate_baseline(
            baseline,
            source,
            config,
            progress=lambda done, total, of=baseline: progress(of, done, total),  # type: ignore[misc]
        )
        scores.append((baseline, score))
    return [result_of(controller, score) for controller, score in scores]


def result_of(controller: str, score: Score) -> ZeroShotResult:
    """Return the result of a controller from its score on a robot."""
    return ZeroShotResult(
        controller,
        score.episodes,
        wilson_interval(round(score.success * score.episodes), score.episodes),
        score.distance,
        score.score,
    )

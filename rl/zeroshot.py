"""A shipped policy on robots that it never saw, beside controllers that do not learn."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from morphgen.rl.baselines import ZERO, baselines_for
from morphgen.rl.evaluation import (
    EvalConfig,
    evaluate_baseline,
    evaluate_checkpoints,
    require_trained_tasks,
)
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.robot_source import RobotSource
from morphgen.rl.scores.scores import Interval, Score, success_interval
from morphgen.rl.shipped_policies import name_of


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
    """Mean distance from success at the end of an episode [m]."""
    angle: float
    """Mean angle from success at the end of an episode [rad]; nan without orientation."""
    score: float
    """Mean score of the episodes; that of reach is relative to the random policy."""


def zero_shot(source: RobotSource, policy: Path, config: EvalConfig) -> list[ZeroShotResult]:
    """Run a policy on a robot, and the controllers that do not learn.

    All of them have the same starts and goals.
    """
    task, name = str(source.task), name_of(policy)
    require_trained_tasks(read_checkpoint(policy)[0], [source], name)
    (score,) = evaluate_checkpoints([policy], source, config, "deterministic")
    scores = [(name, score)]
    for baseline in compared_with(task):
        (score,) = evaluate_baseline(baseline, source, config)
        scores.append((baseline, score))
    return [result_of(controller, score) for controller, score in scores]


def compared_with(task: str) -> tuple[str, ...]:
    """Return the baselines of a task that a policy is compared with: all but zero actions."""
    return tuple(name for name in baselines_for(task) if name != ZERO.name)


def result_of(controller: str, score: Score) -> ZeroShotResult:
    """Return the result of a controller from its score on a robot."""
    return ZeroShotResult(
        controller,
        score.episodes,
        success_interval(score.success, score.episodes),
        score.distance,
        score.angle,
        score.score,
    )

"""DAgger: what a planner would do in the states that a policy leads to.

Ross, Gordon and Bagnell 2011, "A reduction of imitation learning and structured prediction to
no-regret online learning". A round is a data set of its own: ``recording`` lets the policy act and
stores the planner's actions. The robots are those of another data set, with the same goals.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from morphgen.errors import TaskError
from morphgen.rl.baselines import BASELINES
from morphgen.rl.demonstrations.lerobot import BODIES
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.recording import RecordingConfig, best_of, record
from morphgen.rl.inference import read_controller
from morphgen.rl.runs.robot_source import robot_source
from morphgen.tasks.scenes.env_specs import GoalConfig


def read_planner(planner: str, tasks: Sequence[str]) -> None:
    """Require a baseline that can do all tasks."""
    for task in tasks:
        name = best_of(task, planner)
        if name not in BASELINES:
            raise TaskError(f"{planner!r} is no baseline; valid: {', '.join(BASELINES)}")
        read_controller(name, task)  # raises if it is not for the task


def record_states(
    data: Demonstrations,
    folder: Path,
    policy: str | Path,
    planner: str,
    *,
    episodes: int,
    seed: int,
    jobs: int = 1,
) -> Path:
    """Let a policy act with the robots of a data set, and record a planner's actions.

    Args:
        data: Data set with the robots, their tasks and goals.
        folder: The data set to record.
        policy: Folder of the policy's run, or another policy.
        planner: Baseline whose actions are the labels.
        episodes: Number of episodes of each robot at each task.
        seed: Seed of the episodes.
        jobs: Number of processes.
    """
    sources = tuple(
        robot_source(
            str(data.folder / BODIES / data.robot_hashes[index]),
            task,
            obstacles=bool(spec.scene.obstacles),
            goal_seed=spec.goals.seed,
        )
        for (index, task), spec in data.specs.items()
    )
    config = RecordingConfig(
        sources,
        policy=str(policy),
        teacher=planner,
        episodes=episodes,
        seed=seed,
        sim=data.settings["sim"],
        goals=GoalConfig(tasks=data.configs),
    )
    return record(folder, config, jobs=jobs)

"""Describe demonstrations: a summary by task."""

from __future__ import annotations

from dataclasses import dataclass

from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.scores import Interval, success_interval
from morphgen.tables import table


@dataclass(frozen=True)
class TaskSummary:
    """The episodes of a task."""

    task: str
    policy: str
    robots: int
    episodes: int
    steps: int
    success: Interval
    """Share of the episodes that ended in success, with its 95% Wilson interval."""


def summarize(demos: Demonstrations) -> list[TaskSummary]:
    """Return a summary of each task of a data set."""
    summaries = []
    for task in dict.fromkeys(episode.task for episode in demos.episodes):
        own = [episode for episode in demos.episodes if episode.task == task]
        rate = sum(episode.success for episode in own) / len(own)
        summaries.append(
            TaskSummary(
                task,
                own[0].policy,
                len({episode.robot_index for episode in own}),
                len(own),
                sum(episode.length for episode in own),
                success_interval([rate], [len(own)]),
            )
        )
    return summaries


def summary_text(demos: Demonstrations, style: str = "simple") -> str:
    """Return the table of the tasks of a data set."""
    headers = ("task", "policy", "robots", "episodes", "steps", "success")
    rows = [
        (each.task, each.policy, each.robots, each.episodes, each.steps, each.success.as_percent())
        for each in summarize(demos)
    ]
    return table(rows, headers, style=style)

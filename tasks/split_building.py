"""Build the folder of a split together with its goal sets."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from morphgen.benchmark.split import Split
from morphgen.benchmark.split_build import BuildReport, build_split, split_folder_path
from morphgen.benchmark.split_folder_files import BuildSettings
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.processes import Progress, no_progress
from morphgen.tasks.env_specs import GoalConfig
from morphgen.tasks.split_goals import (
    GOALS,
    GoalResult,
    has_goals,
    require_goal_sets,
    write_goals,
)


def build_with_goals(
    split: Split,
    folder: Path,
    library: Library,
    settings: BuildSettings,
    goals: Sequence[GoalResult] = (),
    config: GoalConfig | None = None,
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> BuildReport:
    """Write a split, all its robots and, if there are any, its goal sets; see ``build_split``.

    Args:
        split: The split.
        folder: Parent folder, such as ``data``.
        library: The library of parts.
        settings: Settings of the build.
        goals: Goal sets of all members; empty to ship none.
        config: Seed and constants that they were made with.
        jobs: Number of processes.
        progress: Receives the number of robots that are finished, and of all.

    Raises:
        BenchmarkError: As ``build_split``; or if a member has no goal set; or if there are no goal
            sets, but some of an earlier build.
        MorphgenError: If a robot cannot be composed.
    """
    require_goal_sets(goals)
    built = split_folder_path(split, folder)
    if not goals and built.is_dir() and has_goals(built):
        raise BenchmarkError(
            f"{built} was built with goals: ask for goals (--goals), delete {built / GOALS}, or "
            "name another folder"
        )
    report = build_split(split, folder, library, jobs=jobs, settings=settings, progress=progress)
    if goals:
        write_goals(report.folder, goals, config or GoalConfig())
    return report

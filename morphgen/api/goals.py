"""Sample and certify the goal sets of robots."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from typing import Any

from morphgen.arguments import checked_signature, path_argument, text_argument
from morphgen.benchmark.split_folder import read_split_or_folder
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.model.robot import Robot
from morphgen.splits.split_file import split_names
from morphgen.tables import table
from morphgen.tasks.goals.split_goals import (
    GoalResult,
    goal_record,
    sample_robot_goals,
    sample_split_goals,
)
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, load_robot

HEADERS = ("robot", "side", "task", "goals", "acceptance", "obstacles", "certified")


@dataclass(frozen=True, eq=False)
class GoalSets:
    """Goal sets of robots; the text is a table with the failures."""

    seed: int
    """Seed of the goals."""
    results: tuple[GoalResult, ...]
    """For each robot its ``goals``, or the ``error`` why there are none."""

    @property
    def passed(self) -> bool:
        """Whether every robot has its goals, and none failed its certification."""
        return all(each.goals is not None and not each.certificate_errors for each in self.results)

    def as_dict(self) -> dict[str, object]:
        """Return records of the sets, and the failures, as JSON values."""
        failures = [
            {"robot": each.robot, "side": each.side, "task": each.task, "why": each.error}
            for each in self.results
            if each.goals is None
        ]
        sets = [_record(each) for each in self.results if each.goals]
        return {"seed": self.seed, "sets": sets, "failures": failures, "passed": self.passed}

    def __str__(self) -> str:
        """Return a table with a row per robot, then a line per failure."""
        lines = [table([_row(each) for each in self.results], HEADERS)]
        for result in self.results:
            robot = f"{result.side} robot" if result.side else "robot"
            if result.goals is None:
                lines.append(f"{robot} {result.robot}: {result.error}")
            elif result.certificate_errors:
                first, *others = result.certificate_errors
                more = f" (and {len(others)} more)" if others else ""
                lines.append(f"{robot} {result.robot}: {first}{more}")
        complete = sum(each.goals is not None for each in self.results)
        count = f"{complete} of {len(self.results)}"
        return "\n".join([*lines, f"{count} goal sets are complete, seed {self.seed}"])


def _record(result: GoalResult) -> Mapping[str, Any]:
    errors = result.certificate_errors
    certified = None if errors is None else not errors
    return {**goal_record(result), "certified": certified, "unproven": list(errors or ())}


def _row(result: GoalResult) -> tuple[str, ...]:
    goals, errors = result.goals, result.certificate_errors
    certified = "not tested" if errors is None else "NO" if errors else "yes"
    rate = "" if result.acceptance is None else f"{result.acceptance:.3g}"
    count = "none" if goals is None else str(len(goals.q))
    boxes = str(len(goals.obstacles)) if goals else "yes" if result.obstacles else "0"
    return (result.robot, result.side or "", result.task, count, rate, boxes, certified)


@checked_signature
def goals(
    robots: str | PathLike[str] | Robot,
    *,
    task: str | None = None,
    obstacles: bool = False,
    seed: int = 0,
    certify: bool = False,
    jobs: int = 1,
    library: LibraryFolders = (),
) -> GoalSets:
    """Sample the goal sets of robots, and certify that each goal can be reached.

    Goals of reach and starts of push are kept in the cache. The goals of reach are full poses.

    Examples:
        >>> sets = morphgen.goals("prims", task="reach", certify=True)
        >>> sets.passed, len(sets.results[0].goals.q)
        (True, 100)

    Args:
        robots: Name of a split, its file or built folder; or with ``task`` a robot, its bundle's
            folder, a description, or words of ``compose``.
        task: Task of one robot, such as ``reach`` or ``push``.
        obstacles: Whether one robot is among obstacles.
        seed: Seed of the goals.
        certify: Whether to verify every goal with the configuration that it was sampled from.
        jobs: Number of processes.
        library: Folders of your own parts.

    Returns:
        The goal sets and failures, which print as a table.

    Raises:
        MorphgenError: If the split or the robot cannot be read, or the task is unknown.
    """
    config = GoalConfig(seed)
    if task is not None:
        TASKS[text_argument("task", task, BenchmarkError)]  # raises if the task is unknown
        if str(robots) in split_names():
            raise BenchmarkError(f"--task {task}: is for a robot; {robots} is a split")
        robot = load_robot(robots, library=library)
        result = sample_robot_goals(robot, task, config, obstacles=obstacles, certified=certify)
        return GoalSets(seed, (result,))
    if isinstance(robots, Robot):
        raise BenchmarkError(f"{robots!r}: name its task")
    path = path_argument("robots", robots, BenchmarkError)
    if len(str(path).split()) > 1 and not path.exists():
        raise BenchmarkError(f"{path}: name one split, or say --task for a robot")
    if obstacles:
        raise BenchmarkError("obstacles: only with task")
    split, _ = read_split_or_folder(path)
    results = sample_split_goals(
        split, default_library(library), config, jobs=jobs, certified=certify
    )
    return GoalSets(seed, tuple(results))

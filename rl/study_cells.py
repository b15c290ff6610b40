"""Read the scores that the cells of studies stored, whatever configuration they are of."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from morphgen.benchmark.split import Split, split_id
from morphgen.benchmark.split_file import parse_split
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.rl.aliases import renamed
from morphgen.rl.inference import MODES
from morphgen.rl.robot_source import RobotSource
from morphgen.rl.scores import Score, score_from_json
from morphgen.tasks.env_specs import GoalConfig, task_configs
from morphgen.tasks.registry import TASKS

_FINE_TUNED = re.compile(r"fine-tuned (\d[\d,]*)")


@dataclass(frozen=True, eq=False)
class StoredCell:
    """The content of a cell's ``scores.json``."""

    simulator: str
    """Name of the simulator of the evaluation."""
    episodes: int
    """Minimum number of episodes per robot."""
    seed: int
    """Seed of the episodes."""
    goals: GoalConfig
    """Seed of the goals, and constants of the tasks."""
    version: str | None
    """Version of morphgen that ran the episodes; None before 0.2.0, which did not write it."""
    scores: Mapping[str, tuple[Score, ...]]
    """Scores by mode, or by the baseline's name."""


def stored_split(file: Path, data: object) -> str:
    """Return the id of the split that a cell's scores are of; empty if they are of no split.

    Args:
        file: Path of the file, for messages.
        data: Its content.

    Raises:
        BenchmarkError: If the content is malformed.
    """
    try:
        text = _source(data).split
        return text and split_id(parse_split(text, file).split)
    except (ValueError, KeyError, TypeError, AttributeError, MorphgenError) as error:
        raise _malformed(file, error) from error


def stored_cell(file: Path, data: object) -> StoredCell:
    """Return the scores of a cell and the configuration of their evaluation.

    Args:
        file: Path of the file, for messages.
        data: Its content.

    Raises:
        BenchmarkError: If the content is malformed.
    """
    try:
        table: dict[str, Any] = renamed("scores", data)
        rules = table["eval"]
        constants = {name: values for name, values in rules.items() if name in TASKS}
        goals = GoalConfig(_source(data).goal_seed, task_configs(constants))
        scores = {
            mode: tuple(score_from_json(record) for record in records)
            for mode, records in table["scores"].items()
        }
        version = str(table["morphgen"]) if "morphgen" in table else None
        return StoredCell(rules["sim"], rules["episodes"], rules["seed"], goals, version, scores)
    except (ValueError, KeyError, TypeError, AttributeError, MorphgenError) as error:
        raise _malformed(file, error) from error


def _source(data: object) -> RobotSource:
    return RobotSource(**renamed("source", renamed("scores", data)["source"]))


def _malformed(file: Path, error: Exception) -> BenchmarkError:
    is_message = isinstance(error, ValueError | MorphgenError)
    return BenchmarkError(
        f"{file}: neither a submission nor the scores of a study's cell: "
        f"{error if is_message else repr(error)}"
    )


def tuned_name(steps: int) -> str:
    """Return the name of the mode of a policy after a number of transitions of fine-tuning."""
    return f"fine-tuned {steps:,}"


def acting(name: str) -> tuple[str, int]:
    """Return how a policy acts, and the transitions of its fine-tuning.

    Args:
        name: Name of a mode of a cell, such as ``stochastic``, or one of ``tuned_name``.
    """
    match = _FINE_TUNED.fullmatch(name)
    return (MODES[0], int(match[1].replace(",", ""))) if match else (name, 0)


def require_all_robots(scores: Sequence[Score], split: Split, file: Path) -> None:
    """Require a score of every robot of a side with a task: means of fewer do not compare.

    Args:
        scores: Scores of one mode.
        split: The split.
        file: Path of their file, for messages.

    Raises:
        BenchmarkError: If a robot is missing, there twice or unknown.
    """
    for side, task in {(score.side, score.task): None for score in scores}:
        found = sorted(s.robot for s in scores if (s.side, s.task) == (side, task))
        expected = sorted(each.name for each in split.side(side) if each.task == task)
        if found != expected:
            raise BenchmarkError(
                f"{file}: scores of {side} robots at {task}: {', '.join(found)}; expected one of "
                f"each: {', '.join(expected) or 'none'}"
            )

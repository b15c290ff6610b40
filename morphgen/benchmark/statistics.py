"""A split in numbers: how large and movable its robots are, and how alike test and train."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from morphgen.benchmark.split import Member, Split
from morphgen.benchmark.survey import Fault, RobotStats, SplitSurvey, SurveyedRobot, survey_split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.processes import Progress, no_progress

DIGITS = 4
"""Decimals of the figures."""
COUNTED = ("links", "movable", "movable_to_tool")
MEASURED = ("mass", "reach")
COSINE = "cosine"


def statistics(
    split: Split,
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = no_progress,
) -> dict[str, object]:
    """Figures of a split, as its file holds them.

    Args:
        split: The split.
        library: Where its parts are.
        jobs: Processes.
        progress: As ``survey_split`` tells it.

    Returns:
        Plain data, see ``summarize_survey``.

    Raises:
        BenchmarkError: If a robot cannot be composed, or a side is empty.
    """
    return summarize_survey(survey_split(split, library, jobs=jobs, progress=progress))


def summarize_survey(found: SplitSurvey) -> dict[str, object]:
    """Figures of a split that was surveyed.

    Returns:
        For ``train`` and ``test``: the number of ``robots`` and of different ``bodies``, mean
        ``links``, ``movable`` joints and those on the way from the root to the tool
        (``movable_to_tool``); mean, least and largest ``mass`` (kg) and ``reach`` (m). Mimic joints
        are movable; a body that has two tasks counts twice. ``cosine``: mean, least and largest
        cosine similarity over all pairs of a test and a train robot.

    Raises:
        BenchmarkError: If a robot could not be composed, or a side is empty.
    """
    split = found.split
    return {
        "train": _side(split, split.train, found.train),
        "test": _side(split, split.test, found.test),
        COSINE: mean_and_range(found.by_measure(COSINE).ravel().tolist()),
    }


def mean_and_range(values: Sequence[float]) -> dict[str, float]:
    """Mean, least and largest of values."""
    numbers = {"mean": float(np.mean(values)), "min": min(values), "max": max(values)}
    return {key: round(value, DIGITS) for key, value in numbers.items()}


def _side(
    split: Split, members: Sequence[Member], found: Iterable[SurveyedRobot | Fault]
) -> dict[str, object]:
    if not members:
        raise BenchmarkError(f"split {split.name!r} has a side without robots")
    robots = []
    for member, robot in zip(members, found, strict=True):
        if isinstance(robot, Fault):
            raise BenchmarkError(f"split {split.name!r}: robot {member.name!r}: {robot.why}")
        robots.append(robot)
    facts = [robot.stats for robot in robots]
    return {
        "robots": len(robots),
        "bodies": len({robot.robot_hash for robot in robots}),
        **{key: round(float(np.mean(_column(facts, key))), DIGITS) for key in COUNTED},
        **{key: mean_and_range(_column(facts, key)) for key in MEASURED},
    }


def _column(facts: Sequence[RobotStats], key: str) -> list[float]:
    return [float(getattr(fact, key)) for fact in facts]


PAPER_TABLE = "AnyBody (arXiv 2505.14986), table 'Statistics about benchmark tasks'"


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's table: means over the train robots."""

    title: str
    """As the paper calls the set."""
    links: float
    movable: float
    movable_to_tool: float | None
    """None where the paper has a dash."""
    cosine: float
    """Mean over test and train robots."""


PAPER: Mapping[str, PaperRow] = MappingProxyType(
    {
        "interpolation/arm3": PaperRow("Arm-3", 10, 9, 4, 0.80),
        "interpolation/panda": PaperRow("Panda", 11, 9, 7, 0.76),
        "composition/ee-arm": PaperRow("EE Arm", 8.5, 5.9, 5.6, 0.47),
        "composition/ee-task": PaperRow("EE-Task", 7.75, 5.25, None, 0.49),
        "extrapolation/primitives": PaperRow("Primitives", 6.60, 4.60, 4.60, 0.45),
        "extrapolation/arms": PaperRow("Robot Arms", 14.70, 8.5, 6.6, 0.42),
    }
)
"""The paper's figures by the set of robots: a scenario's name without its task."""


def paper_row(split: str) -> PaperRow | None:
    """The paper's figures for a scenario, such as ``extrapolation/arms/reach``; None if none."""
    return PAPER.get(robot_set(split))


def robot_set(split: str) -> str:
    """The robots of a scenario: its name without the task, which other tasks share."""
    return "/".join(split.split("/")[:2])

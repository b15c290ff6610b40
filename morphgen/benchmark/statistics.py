"""Statistics of a split: sizes of its robots, and similarity of test and train robots."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from morphgen.benchmark.split import SIDES, Side, Split
from morphgen.benchmark.survey import RobotStats, SplitSurvey, survey_split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.processes import Progress, no_progress

DIGITS = 4
"""Decimals of the statistics."""
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
    """Compute the statistics that the file of a split contains.

    Args:
        split: The split.
        library: Library of its parts.
        jobs: Number of processes.
        progress: Called as by ``survey_split``.

    Returns:
        Plain data; see ``summarize_survey``.

    Raises:
        BenchmarkError: If a robot cannot be composed, or train or test is empty.
    """
    return summarize_survey(survey_split(split, library, jobs=jobs, progress=progress))


def summarize_survey(survey: SplitSurvey) -> dict[str, object]:
    """Compute the statistics of a surveyed split.

    Returns:
        For ``train`` and ``test``: the number of ``robots`` and of distinct ``bodies``; the means
        of ``links``, ``movable`` joints (mimic joints included) and movable joints between root and
        tool (``movable_to_tool``); mean, minimum and maximum of ``mass`` [kg] and ``reach`` [m]. A
        robot with two tasks counts twice. For ``cosine``: mean, minimum and maximum of the cosine
        similarity over all pairs of a test and a train robot.

    Raises:
        BenchmarkError: If a robot could not be composed, or train or test is empty.
    """
    return {
        **{side: _side(survey, side) for side in SIDES},
        COSINE: mean_and_range(survey.by_measure(COSINE).ravel().tolist()),
    }


def mean_and_range(values: Sequence[float]) -> dict[str, float]:
    """Return mean, minimum and maximum of values, rounded to ``DIGITS``."""
    numbers = {"mean": float(np.mean(values)), "min": min(values), "max": max(values)}
    return {key: round(value, DIGITS) for key, value in numbers.items()}


def _side(survey: SplitSurvey, side: Side) -> dict[str, object]:
    robots = survey.composed(side)
    if not robots:
        raise BenchmarkError(f"split {survey.split.name!r} has a side without robots")
    stats = [robot.stats for robot in robots]
    return {
        "robots": len(robots),
        "bodies": len({robot.robot_hash for robot in robots}),
        **{key: round(float(np.mean(_column(stats, key))), DIGITS) for key in COUNTED},
        **{key: mean_and_range(_column(stats, key)) for key in MEASURED},
    }


def _column(stats: Sequence[RobotStats], key: str) -> list[float]:
    return [float(getattr(robot, key)) for robot in stats]


PAPER_TABLE = "AnyBody (arXiv 2505.14986), table 'Statistics about benchmark tasks'"


@dataclass(frozen=True)
class PaperRow:
    """A row of the paper's table: means over the train robots."""

    title: str
    """Name of the set of robots in the paper."""
    links: float
    """Mean number of links."""
    movable: float
    """Mean number of movable joints."""
    movable_to_tool: float | None
    """Mean number of movable joints between root and tool; None for the paper's dash."""
    cosine: float
    """Mean cosine similarity over pairs of a test and a train robot."""


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
"""Rows of the paper's table by set of robots, which is a scenario's name without its task."""


def paper_row(split: str) -> PaperRow | None:
    """Return the paper's row for a scenario such as ``extrapolation/arms/reach``, if it has one."""
    return PAPER.get(robot_set(split))


def robot_set(split: str) -> str:
    """Return the name of a scenario's set of robots: the scenario's name without the task."""
    return "/".join(split.split("/")[:2])

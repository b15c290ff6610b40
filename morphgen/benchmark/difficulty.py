"""The difficulty of a split robot by robot: size, mobility, nearest train robots and baselines."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from tabulate import tabulate

from morphgen.benchmark.similarity import MEASURES, most_alike
from morphgen.benchmark.split import SIDES, Member, Side, Split
from morphgen.benchmark.survey import SplitSurvey, survey_split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.typing import Array

DIGITS = 6
"""Decimals of all numbers. Near duplicates differ in the fourth one
(``near_duplicates.NEAR_THRESHOLDS``); rounding errors, which depend on the processor, are far
smaller."""


@dataclass(frozen=True)
class NearestTrain:
    """The train robot that is most similar to a robot by one measure."""

    train: str
    """Name of the train robot."""
    value: float
    """Value of the measure, rounded to ``DIGITS``."""


@dataclass(frozen=True)
class BaselineResult:
    """Result of a baseline on a robot."""

    score: float
    """Mean score, relative to the random policy for tasks with ``Task.relative_to_random``."""
    success: float
    """Success rate, 0 to 1."""


BaselineResults: TypeAlias = Mapping[str, Mapping[tuple[Side, str], BaselineResult]]
"""Results by name of the baseline, then by side and name of the robot."""


@dataclass(frozen=True)
class RobotDifficulty:
    """A row of the difficulty of a split: a robot with its task."""

    split: str
    """Name of the split."""
    side: Side
    robot: str
    """Name of the robot."""
    task: str
    obstacles: bool
    """The scene has obstacles."""
    movable_to_tool: int
    """Number of movable joints between the root and the tool's link."""
    links: int
    """Number of links."""
    reach: float
    """Largest distance of the tool from the root's origin [m]."""
    nearest: Mapping[str, NearestTrain]
    """Nearest train robot by the name of the measure; empty if there is no other train robot."""
    baselines: Mapping[str, BaselineResult] = field(default_factory=dict)
    """Results of baselines by name, without those that cannot do the task."""

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON, without ``baselines`` if there are none."""
        data = {key: value for key, value in vars(self).items() if key != "baselines"}
        data["nearest"] = {name: vars(nearest) for name, nearest in self.nearest.items()}
        if self.baselines:
            data["baselines"] = {name: vars(result) for name, result in self.baselines.items()}
        return data


def split_difficulty(
    split: Split,
    library: Library,
    *,
    results: BaselineResults | None = None,
    jobs: int = 1,
) -> tuple[RobotDifficulty, ...]:
    """Compose, measure and compare the robots of a split; see ``survey_difficulty``."""
    survey = survey_split(split, library, within_train=True, jobs=jobs)
    return survey_difficulty(survey, results)


def survey_difficulty(
    survey: SplitSurvey, results: BaselineResults | None = None
) -> tuple[RobotDifficulty, ...]:
    """Return a row per robot, train robots first.

    The nearest robot of a train robot is another one: robots with the same hash, such as the same
    robot at another task, do not count. A test robot is compared with all train robots.
    """
    return tuple(_rows(survey, results or {}))


def _rows(survey: SplitSurvey, results: BaselineResults) -> Iterator[RobotDifficulty]:
    split = survey.split
    for side in SIDES:
        robots = survey.composed(side)
        for i, (member, robot) in enumerate(zip(split.side(side), robots, strict=True)):
            if robot.robot_hash != member.robot_hash:
                raise BenchmarkError(
                    f"split {split.name!r}: robot {member.name!r}: the split names body "
                    f"{member.robot_hash}, but its derivation gives {robot.robot_hash}: a part, or "
                    "morphgen, has changed since"
                )
            similarity = train_similarity(survey, side, i)
            key = (side, member.name)
            yield RobotDifficulty(
                split.name,
                side,
                member.name,
                member.task,
                member.obstacles,
                robot.stats.movable_to_tool,
                robot.stats.links,
                _rounded(robot.stats.reach),
                dict(_nearest(split.train, similarity)),
                {
                    name: BaselineResult(_rounded(found[key].score), _rounded(found[key].success))
                    for name, found in results.items()
                    if key in found
                },
            )


def train_similarity(survey: SplitSurvey, side: Side, index: int) -> Array:
    """Return the similarity of a robot to the train robots, shape (n_train, n_measures).

    Returns:
        Values of ``MEASURES``; NaN where a train robot is the robot itself.
    """
    if survey.train_similarity is None:
        raise ValueError("the survey has no similarity of train robots; expected within_train=True")
    if side == "test":
        return np.asarray(survey.similarity[:, index])
    own = survey.split.train[index].robot_hash
    is_other = np.array([member.robot_hash != own for member in survey.split.train])
    return np.where(is_other[:, None], survey.train_similarity[:, index], np.nan)


def _nearest(train: tuple[Member, ...], similarity: Array) -> Iterator[tuple[str, NearestTrain]]:
    """Yield the nearest train robot by the name of each measure."""
    for name, values in zip(MEASURES, similarity.T, strict=True):
        best = most_alike(values, name)
        if best is not None:
            yield name, NearestTrain(train[best].name, _rounded(values[best]))


def _rounded(value: float) -> float:
    """Return a number with ``DIGITS`` decimals; 0 instead of -0."""
    return round(float(value), DIGITS) + 0.0


def nearest_column(measure: str) -> str:
    """Return the column with the nearest train robot by a measure."""
    return f"{measure}_nearest"


STRUCTURAL = (
    *("split", "side", "robot", "task", "obstacles", "movable_to_tool", "links", "reach"),
    *(column for name in MEASURES for column in (nearest_column(name), name)),
)
"""Columns that follow from the split alone; reach is in metres."""


def difficulty_csv(rows: Sequence[RobotDifficulty], baselines: Sequence[str] = ()) -> str:
    """Return a CSV table with a line per robot: ``STRUCTURAL``, then two columns per baseline.

    The same rows give the same text. Cells without a value are empty.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    results = (f"{name}_{key}" for name in baselines for key in ("score", "success"))
    writer.writerow((*STRUCTURAL, *results))
    for row in rows:
        cells = [*structural_cells(row)]
        for name in baselines:
            result = row.baselines.get(name)
            cells += ["", ""] if result is None else map(_number, (result.score, result.success))
        writer.writerow(cells)
    return text.getvalue()


def structural_cells(row: RobotDifficulty) -> Iterator[str]:
    """Yield the cells of ``STRUCTURAL`` as they are in the CSV table."""
    yield from (row.split, row.side, row.robot, row.task, str(row.obstacles).lower())
    yield from (str(row.movable_to_tool), str(row.links), _number(row.reach))
    for measure in MEASURES:
        nearest = row.nearest.get(measure)
        yield from ("", "") if nearest is None else (nearest.train, _number(nearest.value))


def _number(value: float) -> str:
    """Return a number with all its decimals, never with an exponent."""
    return f"{value:.{DIGITS}f}"


def difficulty_table(
    rows: Sequence[RobotDifficulty], baselines: Sequence[str] = (), style: str = "simple"
) -> str:
    """Return a table of the robots of one split for readers; ``style`` is one of tabulate's."""
    headers = (
        *("robot", "side", "task", "movable to tool", "links", "reach (m)"),
        *(f"nearest by {name}" for name in MEASURES),
        *baselines,
    )
    cells = [tuple(_cells(row, baselines)) for row in rows]
    return tabulate(cells, headers, tablefmt=style, disable_numparse=True)


def _cells(row: RobotDifficulty, baselines: Sequence[str]) -> Iterator[str]:
    yield from (row.robot, row.side, row.task + (" (obstacles)" if row.obstacles else ""))
    yield from (str(row.movable_to_tool), str(row.links), f"{row.reach:.2f}")
    for measure in MEASURES:
        nearest = row.nearest.get(measure)
        yield "-" if nearest is None else f"{nearest.train} {nearest.value:.3f}"
    for name in baselines:
        result = row.baselines.get(name)
        # Adding 0.0 turns -0.0 into 0.0.
        yield "-" if result is None else f"{round(result.score, 1) + 0.0:.1f}, {result.success:.0%}"

"""Every robot of a split composed and measured, and each test robot compared with each train robot.

What the audit and the statistics are made of.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.benchmark.similarity import MEASURES, Features, features
from morphgen.benchmark.split import Member, Split
from morphgen.errors import MorphgenError, nearest
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.card import rounded
from morphgen.grammar.compose import compose
from morphgen.grammar.conditions import RobotProperties
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import Progress, no_progress, parallel_map
from morphgen.typing import Array


@dataclass(frozen=True)
class RobotStats:
    """What tables say of a robot."""

    links: int
    movable: int
    """Joints that move, mimic joints among them."""
    movable_to_tool: int
    """Those between the root and the tool's link."""
    dof: int
    reach: float
    """Largest distance of the tool from the root's origin, metres."""
    mass: float
    """Kilograms."""

    def as_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Fault:
    """Why a robot of a split cannot be had."""

    code: str
    """``part-missing`` if the library lacks a part, ``links-many`` if the robot has more than its
    split allows, else ``body-broken``."""
    why: str


@dataclass(frozen=True)
class SurveyedRobot:
    """A robot of a split as it is composed today."""

    robot_hash: str
    """Its hash."""
    stats: RobotStats


@dataclass(frozen=True, eq=False)
class MeasuredRobot:
    """What is known of a robot of a split."""

    surveyed: SurveyedRobot
    features: Features


@dataclass(frozen=True, eq=False)
class SplitSurvey:
    """What was found of a split's robots, in the order of the split."""

    split: Split
    train: tuple[SurveyedRobot | Fault, ...]
    test: tuple[SurveyedRobot | Fault, ...]
    similarity: Array
    """Of every train robot to every test robot by every measure, in the order of ``MEASURES``,
    shape (n_train, n_test, n_measures); NaN where one of the two has a fault."""

    def by_measure(self, measure: str) -> Array:
        """Likeness by one measure, shape (n_train, n_test)."""
        return self.similarity[:, :, tuple(MEASURES).index(measure)]


def robot_stats(robot: Robot) -> RobotStats:
    """Count and measure a robot."""
    known = RobotProperties(robot)
    return RobotStats(
        len(robot.links),
        len(robot.movable_joints),
        int(known.movable_to_tool),
        robot.dof,
        float(rounded(known.reach) or 0.0),
        float(rounded(known.mass) or 0.0),
    )


def measure_robot(robot: Robot, folders: Sequence[Path], max_links: int) -> MeasuredRobot | Fault:
    """Measure a robot, unless it has more links than its split allows.

    Args:
        robot: The body.
        folders: Folders of parts, for their stored fits.
        max_links: Of the split.

    Raises:
        MorphgenError: If it has no tokens, or no tool that moves.
    """
    if len(robot.links) > max_links:
        why = f"it has {len(robot.links)} links, more than max_links {max_links}"
        return Fault("links-many", why)
    surveyed = SurveyedRobot(robot_hash(robot), robot_stats(robot))
    return MeasuredRobot(
        surveyed, features(robot, token_shapes(robot, folders), max_links=max_links)
    )


def survey_split(
    split: Split, library: Library, *, jobs: int = 1, progress: Progress = no_progress
) -> SplitSurvey:
    """Compose, measure and compare a split's robots; what is named twice is composed once a side.

    Args:
        split: The split.
        library: Where its parts are.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Raises:
        BenchmarkError: If ``jobs`` is below 1, or what the split says of its making is malformed.
    """
    trains, tests = _firsts(split.train), _firsts(split.test)
    total = len(trains) + len(tests)
    examination = _Examination(library.folders, split.max_links)
    tested = list(parallel_map(examination, tests, jobs, lambda done, _: progress(done, total)))
    look = _Comparison(examination, tuple(map(_features_of, tested)))
    trained = list(
        parallel_map(look, trains, jobs, lambda done, _: progress(len(tests) + done, total))
    )
    rows, columns = _places(split.train, trains), _places(split.test, tests)
    shape = (len(trains), len(tests), len(MEASURES))
    likeness = np.array([values for _, values in trained]).reshape(shape)
    return SplitSurvey(
        split,
        tuple(trained[row][0] for row in rows),
        tuple(_surveyed(tested[column]) for column in columns),
        likeness[rows][:, columns],
    )


def _firsts(members: Sequence[Member]) -> list[Member]:
    """The first member of every derivation."""
    return list({member.derivation: member for member in reversed(members)}.values())[::-1]


def _places(members: Sequence[Member], firsts: Sequence[Member]) -> list[int]:
    """For every member the index of the first one of its derivation."""
    place = {member.derivation: i for i, member in enumerate(firsts)}
    return [place[member.derivation] for member in members]


@dataclass(frozen=True, eq=False)
class _Examination:
    """How a worker sees to a robot."""

    folders: tuple[Path, ...]
    max_links: int

    @cached_property
    def library(self) -> Library:
        return Library(self.folders)

    def __call__(self, member: Member) -> MeasuredRobot | Fault:
        try:
            parsed = parse_derivation(member.derivation)
            missing = {node.part for node in parsed.walk()} - self.library.paths.keys()
            if missing:
                hints = (f"{part!r}{nearest(part, self.library.paths)}" for part in sorted(missing))
                return Fault("part-missing", f"the library has no part {' and no '.join(hints)}")
            robot = compose(parsed, self.library, member.name)
            return measure_robot(robot, self.folders, self.max_links)
        except MorphgenError as error:
            return Fault("body-broken", str(error))


@dataclass(frozen=True, eq=False)
class _Comparison:
    """How a worker compares a robot with the test robots."""

    examination: _Examination
    tests: tuple[Features | None, ...]

    def __call__(self, member: Member) -> tuple[SurveyedRobot | Fault, Array]:
        found = self.examination(member)
        values = np.full((len(self.tests), len(MEASURES)), np.nan)
        if isinstance(found, Fault):
            return found, values
        for row, test in zip(values, self.tests, strict=True):
            if test is not None:
                row[:] = [each.function(test, found.features) for each in MEASURES.values()]
        return found.surveyed, values


def _surveyed(found: MeasuredRobot | Fault) -> SurveyedRobot | Fault:
    return found.surveyed if isinstance(found, MeasuredRobot) else found


def _features_of(found: MeasuredRobot | Fault) -> Features | None:
    return found.features if isinstance(found, MeasuredRobot) else None

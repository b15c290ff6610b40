"""Compose and measure all robots of a split, and compare each test robot with each train robot.

The audit and the statistics of a split are computed from this survey.
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
from morphgen.formats.rounding import round_number
from morphgen.grammar.compose import compose
from morphgen.grammar.conditions import RobotProperties
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.model.robot import Robot
from morphgen.processes import Progress, no_progress, parallel_map
from morphgen.typing import Array


@dataclass(frozen=True)
class RobotStats:
    """Size and mobility of a robot."""

    links: int
    """Number of links."""
    movable: int
    """Number of movable joints, mimic joints included."""
    movable_to_tool: int
    """Number of movable joints between the root and the tool's link."""
    dof: int
    """Number of independent joints."""
    reach: float
    """Largest distance of the tool from the root's origin [m]."""
    mass: float
    """Total mass [kg]."""

    def as_dict(self) -> dict[str, object]:
        """Return the fields as plain data for JSON."""
        return asdict(self)


@dataclass(frozen=True)
class Fault:
    """Reason why a robot of a split cannot be composed or measured."""

    code: str
    """``part-missing`` if the library lacks a part, ``links-many`` if the robot has more links than
    its split allows, else ``body-broken``."""
    why: str
    """Error message."""


@dataclass(frozen=True)
class SurveyedRobot:
    """A robot of a split, composed with the current library."""

    robot_hash: str
    """Hash of the robot; see ``morphgen.benchmark.robot_hash``."""
    stats: RobotStats


@dataclass(frozen=True, eq=False)
class MeasuredRobot:
    """A composed robot with the features that the similarity measures compare."""

    surveyed: SurveyedRobot
    features: Features


@dataclass(frozen=True, eq=False)
class SplitSurvey:
    """Results for all robots of a split."""

    split: Split
    """The split."""
    train: tuple[SurveyedRobot | Fault, ...]
    """Train robots, in the order of the split."""
    test: tuple[SurveyedRobot | Fault, ...]
    """Test robots, in the order of the split."""
    similarity: Array
    """Similarity of train and test robots by each of ``MEASURES``, shape (n_train, n_test,
    n_measures); NaN where one of the two robots has a fault."""

    def by_measure(self, measure: str) -> Array:
        """Return the similarity by one measure, shape (n_train, n_test)."""
        return self.similarity[:, :, tuple(MEASURES).index(measure)]


def robot_stats(robot: Robot) -> RobotStats:
    """Measure the size and mobility of a robot."""
    properties = RobotProperties(robot)
    return RobotStats(
        len(robot.links),
        len(robot.movable_joints),
        int(properties.movable_to_tool),
        robot.dof,
        round_number(properties.reach),
        round_number(properties.mass),
    )


def measure_robot(robot: Robot, folders: Sequence[Path], max_links: int) -> MeasuredRobot | Fault:
    """Measure a robot, unless it has more links than its split allows.

    Args:
        robot: The robot.
        folders: Folders of parts, for their stored fits.
        max_links: Largest number of links in the split.

    Raises:
        MorphgenError: If the robot has no tokens or no movable tool.
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
    """Compose, measure and compare the robots of a split; equal ones once in train and test each.

    Args:
        split: The split.
        library: Library of its parts.
        jobs: Number of processes.
        progress: Called repeatedly with the numbers of finished and of all robots.

    Raises:
        BenchmarkError: If ``jobs`` is below 1, or the split's provenance is malformed.
    """
    train_members, test_members = _firsts(split.train), _firsts(split.test)
    total = len(train_members) + len(test_members)
    measurement = _Measurement(library.folders, split.max_links)
    test_robots = list(
        parallel_map(measurement, test_members, jobs, lambda done, _: progress(done, total))
    )
    compare = _Comparison(
        measurement,
        tuple(None if isinstance(robot, Fault) else robot.features for robot in test_robots),
    )
    train_robots = list(
        parallel_map(
            compare, train_members, jobs, lambda done, _: progress(len(test_members) + done, total)
        )
    )
    rows, columns = (
        _first_indices(split.train, train_members),
        _first_indices(split.test, test_members),
    )
    shape = (len(train_members), len(test_members), len(MEASURES))
    similarity = np.array([values for _, values in train_robots]).reshape(shape)
    return SplitSurvey(
        split,
        tuple(train_robots[row][0] for row in rows),
        tuple(
            robot if isinstance(robot, Fault) else robot.surveyed
            for robot in (test_robots[column] for column in columns)
        ),
        similarity[rows][:, columns],
    )


def _firsts(members: Sequence[Member]) -> list[Member]:
    """Return the first member with each derivation."""
    return list({member.derivation: member for member in reversed(members)}.values())[::-1]


def _first_indices(members: Sequence[Member], firsts: Sequence[Member]) -> list[int]:
    """Return, for every member, the index in ``firsts`` of the one with the same derivation."""
    index = {member.derivation: i for i, member in enumerate(firsts)}
    return [index[member.derivation] for member in members]


@dataclass(frozen=True, eq=False)
class _Measurement:
    """Picklable function that composes and measures a member; caches the library per worker."""

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
    """Picklable function that measures a train robot and compares it with all test robots."""

    measurement: _Measurement
    tests: tuple[Features | None, ...]

    def __call__(self, member: Member) -> tuple[SurveyedRobot | Fault, Array]:
        measured = self.measurement(member)
        values = np.full((len(self.tests), len(MEASURES)), np.nan)
        if isinstance(measured, Fault):
            return measured, values
        for row, test in zip(values, self.tests, strict=True):
            if test is not None:
                row[:] = [
                    measure.function(test, measured.features) for measure in MEASURES.values()
                ]
        return measured.surveyed, values

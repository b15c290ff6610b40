"""Compose, measure and compare the robots of a split; its statistics and its audit.

The audit tests leaks between train and test, and the rules of the regime.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from morphgen.benchmark.hold_out import has_hold_out_rules, hold_out_findings
from morphgen.benchmark.regimes import found, regime_findings
from morphgen.encoding.robot_hash import robot_hash
from morphgen.encoding.similarity import (
    MEASURES,
    NEAR_THRESHOLDS,
    Features,
    features,
    is_same_reach,
    most_alike,
)
from morphgen.encoding.tokens import tokens
from morphgen.errors import BenchmarkError, MorphgenError, nearest
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.rounding import round_number
from morphgen.grammar.compose import compose
from morphgen.grammar.library import Library
from morphgen.grammar.syntax import parse_derivation
from morphgen.grammar.values import RobotProperties
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map
from morphgen.progress import stage
from morphgen.splits.split import SIDES, Member, Side, Split, sided_members
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array


@dataclass(frozen=True)
class RobotStats:
    """Size and mobility of a robot."""

    links: int
    movable: int  # number of movable joints, mimic joints included
    movable_to_tool: int  # number of movable joints between the root and the tool's link
    dof: int  # number of independent joints
    reach: float  # largest distance of the tool from the first joint that moves it [m]
    mass: float  # total mass [kg]


@dataclass(frozen=True)
class Fault:
    """Reason why a robot of a split cannot be composed or measured."""

    code: str
    """``part-missing`` if the library lacks a part, ``links-many`` if the robot has more links than
    its split allows, else ``body-broken``."""
    why: str


@dataclass(frozen=True)
class SurveyedRobot:
    """A robot of a split, composed with the current library."""

    robot_hash: str  # hash of the robot; see `morphgen.encoding.robot_hash`
    stats: RobotStats
    tokens: Array = field(compare=False, repr=False)  # tokens at home, shape (n_links, 48)
    features: Features | None = field(compare=False, repr=False)
    """Features of the robot, which the similarity measures compare; None if none is asked for."""


@dataclass(frozen=True, eq=False)
class SplitSurvey:
    """Results for all robots of a split."""

    split: Split
    robots: tuple[SurveyedRobot | Fault, ...]  # train robots first
    similarity: Array
    """Similarity of all robots by each of ``MEASURES``, shape (n, n, n_measures); NaN for pairs
    that are not compared, and where one of the two robots has a fault."""

    @property
    def train(self) -> tuple[SurveyedRobot | Fault, ...]:
        """The train robots."""
        return self.robots[: len(self.split.train)]

    @property
    def test(self) -> tuple[SurveyedRobot | Fault, ...]:
        """The test robots."""
        return self.robots[len(self.split.train) :]

    @property
    def features(self) -> tuple[Features | None, ...]:
        """The features of the robots, None of those with a fault."""
        return tuple(None if isinstance(each, Fault) else each.features for each in self.robots)

    def by_measure(self, measure: str) -> Array:
        """Return the similarity of train and test robots, shape (n_train, n_test)."""
        n = len(self.split.train)
        return self.similarity[:n, n:, tuple(MEASURES).index(measure)]

    def composed(self, side: Side) -> tuple[SurveyedRobot, ...]:
        """Return the robots of a side."""
        split, robots = self.split, []
        surveyed = self.train if side == "train" else self.test
        for member, robot in zip(split.side(side), surveyed, strict=True):
            if isinstance(robot, Fault):
                raise BenchmarkError(f"split {split.name!r}: robot {member.name!r}: {robot.why}")
            robots.append(robot)
        return tuple(robots)


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


def measure_robot(
    robot: Robot, library: Library, max_links: int, *, with_features: bool
) -> SurveyedRobot:
    """Measure a robot as its split states it."""
    shapes = token_shapes(robot, library.folders)
    table = tokens(robot, shapes, max_links=max_links)
    found = features(robot, shapes, max_links=max_links) if with_features else None
    return SurveyedRobot(robot_hash(robot), robot_stats(robot), table, found)


def survey_robot(library: Library, max_links: int, member: Member) -> SurveyedRobot | Fault:
    """Compose and measure a robot."""
    try:
        parsed = parse_derivation(member.derivation)
        missing = {node.part for node in parsed.walk()} - library.paths.keys()
        if missing:
            hints = (f"{part!r}{nearest(part, library.paths)}" for part in sorted(missing))
            return Fault("part-missing", f"the library has no part {' and no '.join(hints)}")
        robot = compose(parsed, library, member.name)
        if len(robot.links) > max_links:
            why = f"it has {len(robot.links)} links, more than max_links {max_links}"
            return Fault("links-many", why)
        return measure_robot(robot, library, max_links, with_features=True)
    except MorphgenError as error:
        return Fault("body-broken", str(error))


def different_members(split: Split) -> list[Member]:
    """Return the first member of each derivation, train first: a robot is measured once."""
    firsts: dict[str, Member] = {}
    for _, member in sided_members(split):
        firsts.setdefault(member.derivation, member)
    return list(firsts.values())


def survey_split(split: Split, library: Library, *, jobs: int = 1) -> SplitSurvey:
    """Compose, measure and compare the robots of a split; equal ones once."""
    measure = partial(survey_robot, library, split.max_links)
    robots = list(parallel_map(measure, different_members(split), jobs))
    with stage("comparing"):
        return compare_members(split, robots, jobs=jobs)


def compare_members(
    split: Split,
    robots: Sequence[SurveyedRobot | Fault],
    *,
    all_pairs: bool = False,
    jobs: int = 1,
) -> SplitSurvey:
    """Return the survey of a split from its robots in the order of ``different_members``.

    Test robots are compared with train robots; with ``all_pairs`` all with each other.
    """
    number = {member.derivation: i for i, member in enumerate(different_members(split))}
    train, test = ([number[member.derivation] for member in split.side(side)] for side in SIDES)
    compared = np.zeros((len(robots), len(robots)), dtype=np.bool_)
    compared[np.ix_(train, test)] = True
    compared |= compared.T | all_pairs
    # Workers get the features alone: 74 kB a robot, most of it the density of the workspace.
    known = tuple(None if isinstance(robot, Fault) else robot.features for robot in robots)
    values = np.full((len(robots), len(robots), len(MEASURES)), np.nan)
    rows = parallel_map(partial(_compare, known, compared), range(len(robots)), jobs)
    for i, row in enumerate(rows):
        values[i, : i + 1] = values[: i + 1, i] = row
    order = [*train, *test]
    return SplitSurvey(split, tuple(robots[i] for i in order), values[order][:, order])


def _compare(known: Sequence[Features | None], compared: NDArray[np.bool_], index: int) -> Array:
    """Compare a robot with those before it and itself, shape (index + 1, n_measures)."""
    values = np.full((index + 1, len(MEASURES)), np.nan)
    robot = known[index]
    for i in np.flatnonzero(compared[index, : index + 1]).tolist():
        if robot is not None and (other := known[i]) is not None:
            values[i] = [measure.function(robot, other) for measure in MEASURES.values()]
    return values


DIGITS = 4  # decimals of the statistics
COUNTED = ("links", "movable", "movable_to_tool")
MEASURED = ("mass", "reach")


def statistics(split: Split, library: Library, *, jobs: int = 1) -> dict[str, object]:
    """Compute sizes of a split's robots and the similarity of its sides, as shipped files have."""
    survey = survey_split(split, library, jobs=jobs)
    return {
        **{side: _side(survey, side) for side in SIDES},
        "cosine": mean_and_range(survey.by_measure("cosine").ravel().tolist()),
    }


def mean_and_range(values: Sequence[float]) -> dict[str, float]:
    """Return mean, minimum and maximum of values, rounded to ``DIGITS``."""
    numbers = {"mean": float(np.mean(values)), "min": min(values), "max": max(values)}
    return {key: round(value, DIGITS) for key, value in numbers.items()}


def _side(survey: SplitSurvey, side: Side) -> dict[str, object]:
    robots = survey.composed(side)
    if not robots:
        raise BenchmarkError(f"split {survey.split.name!r} has a side without robots")
    values = {
        key: [float(getattr(robot.stats, key)) for robot in robots] for key in (*COUNTED, *MEASURED)
    }
    return {
        "robots": len(robots),
        "bodies": len({robot.robot_hash for robot in robots}),
        **{key: round(float(np.mean(values[key])), DIGITS) for key in COUNTED},
        **{key: mean_and_range(values[key]) for key in MEASURED},
    }


@dataclass(frozen=True)
class NearestTrain:
    """The train robot that is most similar to a robot by one measure."""

    train: str  # name of the train robot
    value: float  # value of the measure


def nearest_train(train: Sequence[Member], similarity: Array) -> dict[str, NearestTrain]:
    """Return the nearest train robot by each measure of similarity (n_train, n_measures)."""
    return {
        name: NearestTrain(train[best].name, float(values[best]))
        for name, values in zip(MEASURES, similarity.T, strict=True)
        if (best := most_alike(values, name)) is not None
    }


@dataclass(frozen=True)
class Audit:
    """Result of an audit."""

    split: str
    findings: tuple[Finding, ...]
    accepted: tuple[tuple[Finding, str], ...]
    """Findings that the split's author accepts, each with the reason."""
    nearest: Mapping[str, Mapping[str, NearestTrain]]
    """Nearest train robot by test robot and measure, without robots that cannot be composed."""

    def passed(self, *, strict: bool = False) -> bool:
        """Return True if there are no unaccepted errors; ``strict``: and no warnings."""
        failing = ("error", "warning") if strict else ("error",)
        return not any(finding.severity in failing for finding in self.findings)

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON."""
        accepted = [{**finding.as_dict(), "reason": reason} for finding, reason in self.accepted]
        return {
            "split": self.split,
            "findings": [finding.as_dict() for finding in self.findings],
            "accepted": accepted,
            "nearest": {
                test: {measure: vars(found) for measure, found in trains.items()}
                for test, trains in self.nearest.items()
            },
        }


def audit(split: Split, library: Library, *, jobs: int = 1) -> Audit:
    """Find leaks between train and test robots, and violations of the regime (docs/splits.md)."""
    return audit_survey(survey_split(split, library, jobs=jobs), library)


def audit_survey(survey: SplitSurvey, library: Library) -> Audit:
    """Audit a split from its survey; see ``audit``."""
    split = survey.split
    findings = [
        *_robot_findings(survey),
        *_leaks(survey),
        *_repeated(split),
        *_regime_findings(survey, library),
        *_unknown_tasks(split),
    ]
    n = len(split.train)
    nearest_by_test = {
        member.name: trains
        for j, member in enumerate(split.test, n)
        if (trains := nearest_train(split.train, survey.similarity[:n, j]))
    }
    codes = {finding.code for finding in findings}
    unused = (
        found("accepted-unused", f"accepted {code}") for code in split.accepted if code not in codes
    )
    remaining = (finding for finding in findings if finding.code not in split.accepted)
    accepted = (finding for finding in findings if finding.code in split.accepted)
    return Audit(
        split.name,
        (*remaining, *unused),
        tuple((finding, split.accepted[finding.code]) for finding in accepted),
        nearest_by_test,
    )


def _robot_findings(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield robots that cannot be composed, or that have changed."""
    for side, member, robot in _robots(survey):
        where = f"{side} robot {member.name}"
        if isinstance(robot, Fault):
            yield found(robot.code, where, why=robot.why)
        elif (given := robot.robot_hash) != member.robot_hash:
            yield found("body-changed", where, named=member.robot_hash, given=given)


def _leaks(survey: SplitSurvey) -> Iterator[Finding]:
    """Yield test robots that are train robots, or near duplicates of them."""
    split, near = survey.split, NEAR_THRESHOLDS
    names = {member.name: member for member in split.train}
    tree, cosine, workspace = map(survey.by_measure, ("tree", "cosine", "workspace"))
    is_one_workspace = _same_reach(survey) & (workspace > near.workspace)
    is_near = (tree < near.tree) & ((cosine > near.cosine) | is_one_workspace)
    for j, member in enumerate(split.test):
        where = f"test robot {member.name}"
        rivals = [i for i, other in enumerate(split.train) if other.task == member.task]
        shared = [i for i in rivals if split.train[i].robot_hash == member.robot_hash]
        if shared:
            yield found("body-shared", where, twin=_first_of(split, shared))
        duplicates = sorted(
            (i for i in rivals if is_near[i, j] and i not in shared), key=tree[:, j].item
        )
        if duplicates:
            first = duplicates[0]
            measures = {"tree": tree, "cosine": cosine, "workspace": workspace}
            values = {name: matrix[first, j] for name, matrix in measures.items()}
            twin = _first_of(split, duplicates)
            yield found("body-near", where, twin=twin, near=near, **values)
        other = names.get(member.name)
        if other is not None and other.robot_hash != member.robot_hash:
            yield found("name-shared", where)


def _same_reach(survey: SplitSurvey) -> NDArray[np.bool_]:
    """Return which pairs have nearly one reach, shape (n_train, n_test)."""
    n = len(survey.split.train)
    train, test = (
        np.array([each.workspace.reach if each else np.nan for each in known])
        for known in (survey.features[:n], survey.features[n:])
    )
    return is_same_reach(train[:, None], test[None, :])


def _repeated(split: Split) -> Iterator[Finding]:
    """Yield robots that a side has twice."""
    row = "body-repeated" if has_hold_out_rules(split) else "body-repeated/chosen"
    for side in SIDES:
        first: dict[tuple[object, ...], str] = {}
        for member in split.side(side):
            key = (member.robot_hash, member.task, member.obstacles)
            earlier = first.setdefault(key, member.name)
            if earlier != member.name:
                yield found(row, f"{side} robot {member.name}", side=side, earlier=earlier)


def _regime_findings(survey: SplitSurvey, library: Library) -> tuple[Finding, ...]:
    """Return violations of the regime by the robots that can be composed."""
    composable: dict[Side, list[Member]] = {"train": [], "test": []}
    for side, member, robot in _robots(survey):
        if isinstance(robot, SurveyedRobot):
            composable[side].append(member)
    if not composable["train"]:
        return ()
    split = replace(survey.split, train=tuple(composable["train"]), test=tuple(composable["test"]))
    findings = regime_findings(split, library)
    if has_hold_out_rules(survey.split):
        return (*findings, *hold_out_findings(split, library))
    return findings


def _unknown_tasks(split: Split) -> Iterator[Finding]:
    """Yield robots whose task no installed package has."""
    for side, member in sided_members(split):
        if (task := member.task) not in TASKS:
            where = f"{side} robot {member.name}"
            yield found("task-unknown", where, task=task, nearest=nearest(task, TASKS))


def _robots(survey: SplitSurvey) -> Iterator[tuple[Side, Member, SurveyedRobot | Fault]]:
    for (side, member), robot in zip(sided_members(survey.split), survey.robots, strict=True):
        yield side, member, robot


def _first_of(split: Split, indices: Sequence[int]) -> str:
    """Return the name of the first of some train robots, and how many more there are."""
    more = f" (and {len(indices) - 1} more)" if indices[1:] else ""
    return split.train[indices[0]].name + more

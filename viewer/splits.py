"""What a split's page says of its robots: facts, likeness of all pairs, audit, statistics."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from morphgen.benchmark.audit import Audit, audit_survey
from morphgen.benchmark.similarity import MEASURES, Features
from morphgen.benchmark.split import SIDES, Member, Split
from morphgen.benchmark.statistics import summarize_survey
from morphgen.benchmark.survey import (
    Fault,
    MeasuredRobot,
    SplitSurvey,
    SurveyedRobot,
    measure_robot,
)
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.typing import Array
from morphgen.viewer.workers import Workers

LARGEST = 60
"""The most robots of which every pair is compared; a map of more could not be read."""


@dataclass(frozen=True, eq=False)
class Study:
    """What was found of a split."""

    audit: Audit
    statistics: Mapping[str, object]
    """Empty if a robot cannot be composed."""
    members: tuple[Member, ...]
    """Those that can be compared, train first."""
    sides: tuple[str, ...]
    matrices: Mapping[str, Array]
    """Likeness of every pair of them by measure, shape (n, n)."""


def study(
    split: Split,
    folders: tuple[Path, ...],
    workers: Workers,
    progress: Callable[[int, int], None],
) -> Study:
    """Examine a split's robots in worker processes.

    Args:
        split: At most ``LARGEST`` robots.
        folders: Of the library.
        workers: The processes.
        progress: Told how many robots are done, and of how many.

    Raises:
        BenchmarkError: If there are more robots, or what the split says of its making is malformed.
    """
    members = [*split.train, *split.test]
    if len(members) > LARGEST:
        raise BenchmarkError(
            f"{len(members)} robots are too many to compare each with each (at most {LARGEST}); "
            f"morphgen split audit and morphgen split stats take them all"
        )
    derivations = list(dict.fromkeys(member.derivation for member in members))
    links = split.max_links
    futures = [workers.submit(examine, text, folders, links) for text in derivations]
    found = {}
    for i, (derivation, future) in enumerate(zip(derivations, futures, strict=True)):
        found[derivation] = workers.result(future)
        progress(i + 1, len(derivations))
    return workers.result(workers.submit(conclude, split, found, folders))


def examine(derivation: str, folders: tuple[Path, ...], max_links: int) -> MeasuredRobot | Fault:
    """Compose and measure a robot."""
    try:
        robot = compose(parse_derivation(derivation), Library(folders), "robot")
        return measure_robot(robot, folders, max_links)
    except MorphgenError as error:
        return Fault("body-broken", str(error))


def conclude(
    split: Split, found: Mapping[str, MeasuredRobot | Fault], folders: tuple[Path, ...]
) -> Study:
    """Compare the robots, and audit and sum up the split."""
    sided = [(side, member) for side in SIDES for member in split.side(side)]
    sound = [(side, m) for side, m in sided if isinstance(found[m.derivation], MeasuredRobot)]
    known = [
        each.features for _, m in sound if isinstance(each := found[m.derivation], MeasuredRobot)
    ]
    matrices = {name: _matrix(known, name) for name in MEASURES}
    survey = _survey(split, found, [m for _, m in sound], matrices)
    whole = len(sound) == len(sided)
    return Study(
        audit_survey(survey, Library(folders)),
        summarize_survey(survey) if whole else {},
        tuple(member for _, member in sound),
        tuple(side for side, _ in sound),
        matrices,
    )


def _matrix(known: Sequence[Features], measure: str) -> Array:
    function = MEASURES[measure].function
    values = np.zeros((len(known), len(known)))
    for i, a in enumerate(known):
        for j in range(i + 1):
            values[i, j] = values[j, i] = function(a, known[j])
    return values


def _survey(
    split: Split,
    found: Mapping[str, MeasuredRobot | Fault],
    sound: Sequence[Member],
    matrices: Mapping[str, Array],
) -> SplitSurvey:
    """What the audit asks for, of what is known here."""
    places = [id(member) for member in sound]
    shape = (len(split.train), len(split.test), len(MEASURES))
    likeness = np.full(shape, np.nan)
    for i, a in enumerate(split.train):
        for j, b in enumerate(split.test):
            if id(a) in places and id(b) in places:
                row, column = places.index(id(a)), places.index(id(b))
                likeness[i, j] = [matrices[name][row, column] for name in MEASURES]

    def surveyed(member: Member) -> SurveyedRobot | Fault:
        each = found[member.derivation]
        return each.surveyed if isinstance(each, MeasuredRobot) else each

    return SplitSurvey(
        split, tuple(map(surveyed, split.train)), tuple(map(surveyed, split.test)), likeness
    )

"""Draw robots from a grammar, and neighbours of a robot; the same seed gives the same robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from morphgen.checks import check
from morphgen.errors import GrammarError, MorphgenError
from morphgen.formats.fits import with_stored_fits
from morphgen.formats.rounding import round_number
from morphgen.grammar.compose import MAX_HOME_OVERLAP, join, survey_contacts
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import (
    Choices,
    RandomChooser,
    RecordedChooser,
    TooManyPartsError,
    derive,
)
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.syntax import MAX_PARTS, Expression
from morphgen.grammar.values import RobotProperties, clauses, holds
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot

MAX_ATTEMPTS = 500  # draws for one robot before its conditions are considered unsatisfiable
TOO_LARGE = f"more than {MAX_PARTS} parts"
"""Reason for rejecting a draw whose recursion exceeds the part limit."""
UNCHANGED = "nothing changed"
"""Reason for rejecting a neighbour or child that equals an original robot."""


class SamplingError(MorphgenError):
    """No valid robot was found within ``MAX_ATTEMPTS`` draws."""


@dataclass(frozen=True)
class Sample:
    """A robot drawn from a grammar."""

    index: int
    robot: Robot
    properties: RobotProperties
    findings: tuple[Finding, ...]  # findings of `morphgen.checks.check`; only of severity `info`
    derivation: Derivation
    choices: Choices  # every random choice by its key, such as `robot/1.plane.size`
    rejected: Mapping[str, int]  # number of rejected draws before this robot, by reason


def sample_robots(
    grammar: Grammar, library: Library, n: int, *, seed: int = 0, where: Sequence[Expression] = ()
) -> Iterator[Sample]:
    """Draw robots; generator i is child i of ``SeedSequence(seed)``, whatever n."""
    for index in range(n):
        yield sample_robot(grammar, library, index, seed=seed, where=where)


def sample_robot(
    grammar: Grammar,
    library: Library,
    index: int,
    *,
    seed: int = 0,
    where: Sequence[Expression] = (),
    name: str | None = None,
) -> Sample:
    """Draw robot number ``index`` of a seed; see ``sample_robots``."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    choosers = (RecordedChooser(RandomChooser(rng)) for _ in range(MAX_ATTEMPTS))
    conditions, name = (*grammar.wheres, *where), name or robot_name(grammar, index)
    result = _first_valid(choosers, grammar, library, conditions, name, index)
    if isinstance(result, Sample):
        return result
    reason, times = result.most_common(1)[0]
    raise SamplingError(
        f"robot {index} of {grammar.name!r}: 0 of {MAX_ATTEMPTS} draws were accepted; "
        f"{times} failed at: {reason}"
    )


def mutate(
    grammar: Grammar,
    library: Library,
    choices: Choices,
    n: int,
    *,
    seed: int = 0,
    name: str,
    where: Sequence[Expression] = (),
) -> Iterator[Sample]:
    """Draw neighbours of a robot: each has one of its random choices drawn again.

    Choices that only exist because of the new one, such as the parameters of another part, are
    drawn too; all other choices are kept.
    """
    random = RandomChooser(np.random.default_rng(seed))
    origin = derive(grammar, library, RecordedChooser(random, choices))
    if not choices:
        raise GrammarError(f"grammar {grammar.name!r} leaves nothing to choose: no neighbours")
    conditions = (*grammar.wheres, *where)
    for index in range(n):
        # A generator of its own, so that neighbour i does not depend on n.
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
        choosers = islice(_with_one_redrawn(rng, choices), MAX_ATTEMPTS)
        result = _first_valid(
            choosers, grammar, library, conditions, f"{name}-m{index:04d}", index, (origin,)
        )
        if not isinstance(result, Sample):
            raise SamplingError(
                f"no neighbour of {name!r} in {MAX_ATTEMPTS} draws: "
                + ", ".join(f"{times} x {reason}" for reason, times in sorted(result.items()))
            )
        yield result


def robot_name(grammar: Grammar, index: int) -> str:
    """Return the default name of robot number ``index`` of a grammar."""
    return f"{grammar.name}-{index:06d}"


def _with_one_redrawn(rng: np.random.Generator, choices: Choices) -> Iterator[RecordedChooser]:
    """Yield choosers that each forget one random choice and draw it again."""
    keys = sorted(choices)
    while True:
        forgotten = keys[int(rng.integers(len(keys)))]
        kept = {key: value for key, value in choices.items() if key != forgotten}
        yield RecordedChooser(RandomChooser(rng), kept)


def _first_valid(
    choosers: Iterable[RecordedChooser],
    grammar: Grammar,
    library: Library,
    where: Sequence[Expression],
    name: str,
    index: int,
    origins: tuple[Derivation, ...] = (),
) -> Sample | Counter[str]:
    """Return the first valid robot other than ``origins``, or the reasons for all rejections."""
    conditions = [clause for condition in where for clause in clauses(condition)]
    rejected: Counter[str] = Counter()
    for chooser in choosers:
        try:
            derivation = derive(grammar, library, chooser)
        except TooManyPartsError:
            rejected[TOO_LARGE] += 1
            continue
        if derivation in origins:
            rejected[UNCHANGED] += 1
            continue
        result = _build_if_valid(derivation, library, conditions, name, chooser.choices)
        if not isinstance(result, str):
            return Sample(index, *result, derivation, chooser.choices, dict(rejected))
        rejected[result] += 1
    return rejected


def _build_if_valid(
    derivation: Derivation,
    library: Library,
    conditions: Sequence[Expression],
    name: str,
    choices: Choices,
) -> tuple[Robot, RobotProperties, tuple[Finding, ...]] | str:
    """Compose a robot; return the reason as text if it breaks a condition or fails a check."""
    robot = join(derivation, library, name)
    provenance = {**robot.provenance, "choices": {k: round_number(v) for k, v in choices.items()}}
    robot = replace(robot, provenance=provenance)
    properties = RobotProperties(robot)
    # Cheap tests first: conditions, then overlaps at home, then all checks.
    for condition in conditions:
        if not holds(condition, properties):
            return f"where {condition}"
    contacts = survey_contacts(robot, derivation, library)
    if any(depth > MAX_HOME_OVERLAP for depth in contacts.home_penetrations.values()):
        return "links overlap at home"
    robot = with_stored_fits(replace(robot, ignore_pairs=contacts.ignore_pairs), library.folders)
    findings = check(robot, home_tested=True)
    for finding in findings:
        if finding.severity != "info":
            return f"check {finding.code}, {finding.where}"
    return robot, properties, findings

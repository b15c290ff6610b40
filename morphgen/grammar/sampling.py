"""Draw robots from a grammar; the same seed gives the same robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.fits import with_stored_fits
from morphgen.formats.rounding import round_number
from morphgen.grammar.compose import MAX_HOME_OVERLAP, join, survey_contacts
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import (
    Choices,
    RandomChooser,
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
    conditions = [
        clause for condition in (*grammar.wheres, *where) for clause in clauses(condition)
    ]
    name = name or robot_name(grammar, index)
    rejected: Counter[str] = Counter()
    for _ in range(MAX_ATTEMPTS):
        chooser = RandomChooser(rng)
        try:
            derivation = derive(grammar, library, chooser)
        except TooManyPartsError:
            rejected[TOO_LARGE] += 1
            continue
        result = _build_if_valid(derivation, library, conditions, name, chooser.choices)
        if not isinstance(result, str):
            return Sample(index, *result, derivation, chooser.choices, dict(rejected))
        rejected[result] += 1
    reason, times = rejected.most_common(1)[0]
    raise SamplingError(
        f"robot {index} of {grammar.name!r}: 0 of {MAX_ATTEMPTS} draws were accepted; "
        f"{times} failed at: {reason}"
    )


def robot_name(grammar: Grammar, index: int) -> str:
    """Return the default name of robot number ``index`` of a grammar."""
    return f"{grammar.name}-{index:06d}"


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

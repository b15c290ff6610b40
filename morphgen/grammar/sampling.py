"""Drawing robots from a grammar: the same seed gives the same robots."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.card import rounded
from morphgen.formats.fits import with_stored_fits
from morphgen.grammar.choosers import Random, Recorded
from morphgen.grammar.compose import TOUCH, join, survey_of
from morphgen.grammar.conditions import Properties, clauses, holds
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import EndlessError, derive
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_PARTS
from morphgen.grammar.model import Grammar
from morphgen.grammar.syntax import Expression
from morphgen.model.findings import Finding
from morphgen.model.robot import Robot

MAX_ATTEMPTS = 500
"""Draws for one robot before its conditions are taken to be too hard."""
TOO_LARGE = f"more than {MAX_PARTS} parts"
"""Why a draw is rejected whose recursion went on for too long."""


class SamplingError(MorphgenError):
    """No robot was found that meets the conditions."""


@dataclass(frozen=True)
class Sample:
    """A robot drawn from a grammar."""

    index: int
    robot: Robot
    properties: Properties
    findings: tuple[Finding, ...]
    derivation: Derivation
    choices: Mapping[str, float]
    """What was drawn, by the place in the grammar."""
    rejected: Mapping[str, int]
    """Draws that were thrown away for this robot, by the reason."""


def sample(
    grammar: Grammar,
    library: Library,
    n: int,
    *,
    seed: int = 0,
    where: Sequence[Expression] = (),
) -> Iterator[Sample]:
    """Draw robots one after the other.

    Robot i does not depend on n: its generator is child i of ``SeedSequence(seed)``.

    Args:
        grammar: The grammar.
        library: Where its parts are.
        n: How many.
        seed: Seed of all of them.
        where: Conditions besides the grammar's own.

    Raises:
        GrammarError: If the grammar cannot be derived.
        SamplingError: If a robot's conditions are not met in ``MAX_ATTEMPTS`` draws.
    """
    for index in range(n):
        yield draw(grammar, library, index, seed=seed, where=where)


def draw(
    grammar: Grammar,
    library: Library,
    index: int,
    *,
    seed: int = 0,
    where: Sequence[Expression] = (),
    name: str | None = None,
) -> Sample:
    """Draw robot number ``index`` of a seed; see ``sample``."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
    conditions = [clause for whole in (*grammar.wheres, *where) for clause in clauses(whole)]
    rejected: Counter[str] = Counter()
    for _ in range(MAX_ATTEMPTS):
        recorded = Recorded(Random(rng))
        try:
            derivation = derive(grammar, library, recorded)
        except EndlessError:
            rejected[TOO_LARGE] += 1
            continue
        own = name or robot_name(grammar, index)
        found = build(derivation, library, conditions, own, recorded.made)
        if isinstance(found, str):
            rejected[found] += 1
            continue
        return Sample(index, *found, derivation, recorded.made, dict(rejected))
    reason, times = rejected.most_common(1)[0]
    raise SamplingError(
        f"robot {index} of {grammar.name!r}: 0 of {MAX_ATTEMPTS} draws were accepted; "
        f"{times} failed at: {reason}"
    )


def robot_name(grammar: Grammar, index: int) -> str:
    """Name of the robot with that number."""
    return f"{grammar.name}-{index:06d}"


def build(
    derivation: Derivation,
    library: Library,
    conditions: Sequence[Expression],
    name: str,
    choices: Mapping[str, float],
) -> tuple[Robot, Properties, tuple[Finding, ...]] | str:
    """Compose a derivation if it is sound and meets conditions; else say why not."""
    robot = join(derivation, library, name)
    provenance = {**robot.provenance, "choices": {k: rounded(v) for k, v in choices.items()}}
    robot = replace(robot, provenance=provenance)
    properties = Properties(robot)
    for condition in conditions:
        if not holds(condition, properties):
            return f"where {condition}"
    contacts = survey_of(robot, derivation, library)
    if any(depth > TOUCH for depth in contacts.home_penetrations.values()):
        return "links overlap at home"
    robot = with_stored_fits(replace(robot, ignore_pairs=contacts.ignore_pairs), library.folders)
    findings = check(robot, home_tested=True)
    for finding in findings:
        if finding.severity != "info":
            return f"check {finding.code}"
    return robot, properties, findings

"""The rules of the regimes, tested on the parts and parameters of train and test robots.

Derivations suffice: no robot is composed.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy  # loads its packages at their first use, which take seconds
from numpy.typing import ArrayLike

from morphgen.errors import BenchmarkError, CompositionError, nearest
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW
from morphgen.grammar.request import SLOTS
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.findings import Finding, texts_of
from morphgen.splits.split import (
    COMPOSED,
    Candidate,
    DerivedRecipe,
    Member,
    Regime,
    Split,
    recipe_of,
)

NOTHING = "none"  # name of the part for robots without an end-effector
_CHOICE = re.compile(r"\{([^{}]*)\}")
_WILDCARD = re.compile(r"[*?[]")
found = texts_of(Path(__file__).with_name("findings.yaml"))


def pattern_robots(pattern: str, library: Library) -> list[DerivedRecipe]:
    """Return a pattern's robots: ``ee=*`` is all parts that fit; ``none`` must be named."""
    robots: list[DerivedRecipe] = []
    for words in expand(pattern):
        choices = [_matching(word, pattern, library) for word in words]
        misfit: CompositionError | None = None
        fitting: list[DerivedRecipe] = []
        for concrete in itertools.product(*choices):
            try:
                fitting.append(recipe_of(concrete, library))
            except CompositionError as error:
                if concrete == words:  # named parts must fit; a wildcard means those that do
                    raise
                misfit = error
        if misfit is not None and not fitting:
            raise misfit
        robots += fitting
    return robots


def expand(pattern: str) -> list[tuple[str, ...]]:
    """Expand the choices in braces in arguments of ``morphgen compose``: the product of all."""
    joined = _CHOICE.sub(lambda match: re.sub(r"\s", "", match[0]), pattern)
    if "{" in _CHOICE.sub("", joined) or "}" in _CHOICE.sub("", joined):
        raise BenchmarkError(f"--from {pattern!r}: a brace is not closed, or opened twice")
    words = [_choices(word, pattern) for word in joined.split()]
    if not words:
        raise BenchmarkError("--from is empty; expected such as 'arm={ur5,panda} ee={plane,stick}'")
    return list(itertools.product(*words))


def _choices(word: str, pattern: str) -> list[str]:
    """Return a word once for each choice in its braces."""
    fixed = _CHOICE.split(word)[::2]
    choices = [match.split(",") for match in _CHOICE.findall(word)]
    for options in choices:
        twice = [choice for choice, times in Counter(options).items() if times > 1]
        if "" in options or twice:
            what = f"has {twice[0]!r} twice" if twice and twice[0] else "has an empty choice"
            raise BenchmarkError(f"--from {pattern!r}: {{{','.join(options)}}} {what}")
    return [
        "".join(
            piece for pair in itertools.zip_longest(fixed, chosen, fillvalue="") for piece in pair
        )
        for chosen in itertools.product(*choices)
    ]


def _matching(word: str, pattern: str, library: Library) -> Sequence[str]:
    """Return a word once for each part that its wildcard matches."""
    key, _, value = word.partition("=")
    slot = key.rpartition(".")[2]
    if slot not in SLOTS or not _WILDCARD.search(value):
        return [word]
    names = library.names(slot)
    matching = [name for name in names if name != NOTHING and fnmatchcase(name, value)]
    if not matching:
        raise BenchmarkError(
            f"--from {pattern!r}: no {slot} matches {value!r}{nearest(value, names)}"
        )
    return [f"{key}={name}" for name in matching]


HULLS = ("inside", "outside", "any")
"""Position of a test robot's parameters relative to the convex hull of the train robots."""
ON_HULL = 1e-6
"""Distance up to which a point counts as inside the hull, in ranges of the parameters."""
_SAME = 1e-9  # relative difference below which a parameter does not vary


def structure(derivation: Derivation, library: Library) -> str:
    """Return the parts of a robot, their ports, and their counts, such as the number of fingers.

    Labels and parameters that are not whole numbers are omitted. Robots of one structure have the
    same links and joints at different sizes.
    """
    counts = [
        f"{name}={value:g}"
        for name, value in _values(derivation, library).items()
        if _is_count(name, derivation, library)
    ]
    below = [f"{port}: {structure(child, library)}" for port, child in derivation.children]
    return derivation.part + _bracketed("({})", counts) + _bracketed("[{}]", below)


def combination(derivation: Derivation) -> str:
    """Return the parts of a robot and their ports: its structure without counts."""
    below = [f"{port}: {combination(child)}" for port, child in derivation.children]
    return derivation.part + _bracketed("[{}]", below)


def parts(derivation: Derivation) -> frozenset[str]:
    """Return the parts of a robot, except ``none``."""
    return frozenset(node.part for node in derivation.walk()) - {NOTHING}


def parameters(derivation: Derivation, library: Library) -> dict[str, float]:
    """Return all parameters that are not whole numbers, under keys such as ``1.length`` [SI units].

    Parts are numbered as in ``Derivation.walk``, so robots of one structure have the same keys.
    """
    result: dict[str, float] = {}
    for index, node in enumerate(derivation.walk()):
        yaw = {MOUNT_YAW: 0.0} if index else {}  # derivations omit it where it is 0
        values = yaw | _values(node, library)
        result |= {
            f"{index}.{name}": values[name]
            for name in sorted(values)
            if not _is_count(name, node, library)
        }
    return result


def hull_distance(point: ArrayLike, points: ArrayLike) -> float:
    """Return the distance of a point (d,) from the convex hull of others (n, d); 0 inside.

    It is the smallest L1 distance, each coordinate divided by its range over the others, by a
    linear program, exact to ``ON_HULL``. A point that differs where all others are equal is
    infinitely far.
    """
    x, others = np.asarray(point, dtype=np.float64), np.asarray(points, dtype=np.float64)
    low, span = others.min(axis=0), np.ptp(others, axis=0)
    varied = span > _SAME * np.abs(others).max(axis=0)
    if not np.allclose(x[~varied], low[~varied], rtol=_SAME, atol=_SAME):
        return float("inf")
    if not varied.any():
        return 0.0
    scaled = (others[:, varied] - low[varied]) / span[varied]
    target = (x[varied] - low[varied]) / span[varied]
    n, d = scaled.shape
    # Variables: the convex weights of the points, then the negative and positive deviation in each
    # coordinate, whose sum is minimised.
    equal = np.block([[scaled.T, np.eye(d), -np.eye(d)], [np.ones((1, n)), np.zeros((1, 2 * d))]])
    cost = np.concatenate([np.zeros(n), np.ones(2 * d)])
    solution = scipy.optimize.linprog(cost, A_eq=equal, b_eq=np.append(target, 1.0), method="highs")
    if not solution.success:
        raise BenchmarkError(f"the convex hull of {n} robots: {solution.message}")
    return max(float(solution.fun), 0.0)


def regime_findings(split: Split, library: Library) -> tuple[Finding, ...]:
    """Return the violations of a split's regime that the derivations show; see docs/splits.md."""
    train = [RuledRobot.of(member, library) for member in split.train]
    test = [RuledRobot.of(member, library) for member in split.test]
    tasks = {robot.task for robot in train}
    findings: list[Finding] = []
    for robot in test:
        if robot.task not in tasks:
            findings.append(found("task-unseen", robot.where, task=robot.task))
        findings += regime_violations(split.regime, split.provenance, robot, train)
    return tuple(findings)


@dataclass(frozen=True)
class RuledRobot:
    """A robot with the properties that the rules of the regimes compare."""

    name: str
    category: str
    task: str
    derivation: Derivation
    library: Library = field(repr=False, compare=False)

    @classmethod
    def of(cls, robot: Member | Candidate, library: Library) -> RuledRobot:
        """Return the robot of a member, or of a candidate, which has no task yet."""
        if isinstance(robot, Candidate):
            return cls(robot.name, robot.category, "", robot.derivation, library)
        derivation = parse_derivation(robot.derivation, f"derivation of {robot.name!r}")
        return cls(robot.name, robot.category, robot.task, derivation, library)

    @property
    def where(self) -> str:
        """The test robot as the place of a finding."""
        return f"test robot {self.name}"

    @cached_property
    def structure(self) -> str:
        """See ``structure``."""
        return structure(self.derivation, self.library)

    @cached_property
    def combination(self) -> str:
        """See ``combination``."""
        return combination(self.derivation)

    @cached_property
    def parts(self) -> frozenset[str]:
        """See ``parts``."""
        return parts(self.derivation)

    @cached_property
    def parameters(self) -> list[float]:
        """Values of ``parameters``."""
        return list(parameters(self.derivation, self.library).values())


def regime_violations(
    regime: Regime, provenance: Mapping[str, object], test: RuledRobot, train: Sequence[RuledRobot]
) -> Iterator[Finding]:
    """Yield how a test robot violates the rule of a regime; generators then draw another."""
    if regime == "interpolation":
        return _interpolation(str(provenance.get("hull", "any")), test, train)
    if regime == "composition":
        return _composition(test, train)
    return _extrapolation(test, train) if regime == "extrapolation" else iter(())


def _interpolation(hull: str, test: RuledRobot, train: Sequence[RuledRobot]) -> Iterator[Finding]:
    same_structure = [robot for robot in train if robot.structure == test.structure]
    if not same_structure:
        yield found("structure-unseen", test.where, structure=test.structure)
        return
    if hull not in HULLS[:2]:
        return
    distance = hull_distance(test.parameters, [robot.parameters for robot in same_structure])
    if (distance <= ON_HULL) != (hull == "inside"):
        lie = "inside" if distance <= ON_HULL else f"outside, by {distance:.3g} ranges,"
        yield found("hull", test.where, lie=lie, count=len(same_structure), hull=hull)


def _composition(test: RuledRobot, train: Sequence[RuledRobot]) -> Iterator[Finding]:
    unseen = sorted(test.parts.difference(*(robot.parts for robot in train)))
    if unseen:
        yield found("part-unseen", test.where, parts=", ".join(map(repr, unseen)))
    twin = next((robot.name for robot in train if robot.combination == test.combination), None)
    if twin:
        yield found("combination-seen", test.where, twin=twin, combination=test.combination)
    if len({robot.task for robot in train}) > 1 and not unseen:
        task = test.task
        if not test.parts.difference(*(robot.parts for robot in train if robot.task == task)):
            yield found("pair-seen", test.where, task=task)


def _extrapolation(test: RuledRobot, train: Sequence[RuledRobot]) -> Iterator[Finding]:
    if test.category != COMPOSED and test.category in {robot.category for robot in train}:
        yield found("category-seen", test.where, category=test.category)
    twin = next((robot.name for robot in train if robot.structure == test.structure), None)
    if twin:
        yield found("structure-seen", test.where, twin=twin, structure=test.structure)


def _values(node: Derivation, library: Library) -> dict[str, float]:
    """Return the parameters of a part, with defaults for those that the derivation omits."""
    known = library.manifest(node.part).parameters
    return {name: known[name].default for name in known} | dict(node.parameters)


def _is_count(name: str, node: Derivation, library: Library) -> bool:
    known = library.manifest(node.part).parameters
    return name in known and known[name].integer


def _bracketed(brackets: str, entries: Iterable[str]) -> str:
    text = ", ".join(entries)
    return brackets.format(text) if text else ""

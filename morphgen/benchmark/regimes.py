"""What the regimes mean: rules about the parts and parameters of train and test robots.

Nothing is composed here; derivations say enough.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import linprog

from morphgen.benchmark.split import COMPOSED, Member, Regime, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.library import Library
from morphgen.grammar.parameters import MOUNT_YAW
from morphgen.model.findings import Finding

NOTHING = "none"
"""The part that stands for no end-effector."""
HULLS = ("inside", "outside", "any")
"""Where parameters of a test robot may lie, of the convex hull of those of the train robots."""
ON_HULL = 1e-6
"""How far out a point may be that counts as inside, in ranges of the parameters."""
_SAME = 1e-9
"""Relative difference of a parameter that does not vary."""


def structure(derivation: Derivation, library: Library) -> str:
    """What a robot is made of, sizes aside: parts, their ports, and counts such as of fingers.

    Labels and all parameters but whole numbers are left out. Robots of one structure have the
    same links and joints, in other sizes.

    Raises:
        PartError: If the library lacks a part.
    """
    counts = [
        f"{name}={value:g}"
        for name, value in _values(derivation, library).items()
        if _is_count(name, derivation, library)
    ]
    below = [f"{port}: {structure(child, library)}" for port, child in derivation.children]
    return derivation.part + _bracketed("({})", counts) + _bracketed("[{}]", below)


def combination(derivation: Derivation) -> str:
    """Which parts a robot is made of, and on which ports: its structure without counts."""
    below = [f"{port}: {combination(child)}" for port, child in derivation.children]
    return derivation.part + _bracketed("[{}]", below)


def parts(derivation: Derivation) -> frozenset[str]:
    """The parts of a robot, but for ``none``."""
    return frozenset(node.part for node in derivation.walk()) - {NOTHING}


def parameters(derivation: Derivation, library: Library) -> dict[str, float]:
    """All parameters that are no whole numbers, by place and name such as ``1.length``; SI units.

    Places are numbered as in ``Derivation.walk``, so robots of one structure have the same keys.

    Raises:
        PartError: If the library lacks a part.
    """
    found: dict[str, float] = {}
    for place, node in enumerate(derivation.walk()):
        turn = {MOUNT_YAW: 0.0} if place else {}
        values = turn | _values(node, library)
        found |= {
            f"{place}.{name}": values[name]
            for name in sorted(values)
            if not _is_count(name, node, library)
        }
    return found


def hull_distance(point: ArrayLike, points: ArrayLike) -> float:
    """How far a point lies out of the convex hull of others.

    The least sum of the absolute differences to a point of the hull, each divided by the range of
    the others; a linear programme. A coordinate that the others do not vary is left out, but a
    point that differs in it is infinitely far out.

    Args:
        point: Shape (d,).
        points: The others, shape (n, d), one at least.

    Returns:
        0 inside, up to rounding; see ``ON_HULL``.
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
    # Weights of the others, and what is missing and too much in every coordinate.
    equal = np.block([[scaled.T, np.eye(d), -np.eye(d)], [np.ones((1, n)), np.zeros((1, 2 * d))]])
    cost = np.concatenate([np.zeros(n), np.ones(2 * d)])
    found = linprog(cost, A_eq=equal, b_eq=np.append(target, 1.0), method="highs")
    if not found.success:
        raise BenchmarkError(f"the convex hull of {n} robots: {found.message}")
    return max(float(found.fun), 0.0)


def regime_findings(split: Split, library: Library) -> tuple[Finding, ...]:
    """What of a split is against its regime, as far as derivations tell.

    Interpolation: every test robot has the structure of a train robot, and where the split was
    made with a hull its parameters lie inside, or outside, that of the train robots of its
    structure. Composition: all parts of a test robot are in train robots, its combination in none;
    in a split of several tasks, some part of it is in no train robot of its task. Extrapolation:
    neither its grammar nor its structure is that of a train robot. All: its task is trained.

    Raises:
        GrammarError: If a derivation is none.
        PartError: If the library lacks a part.
    """
    train = [_Read(member, library) for member in split.train]
    rule = _RULES[split.regime]
    found: list[Finding] = []
    for member in split.test:
        test = _Read(member, library)
        found += [*_task_findings(test, train), *rule(split, test, train)]
    return tuple(found)


@dataclass(frozen=True)
class _Read:
    """A member with what its derivation says."""

    member: Member
    library: Library

    @cached_property
    def derivation(self) -> Derivation:
        where = f"derivation of {self.member.name!r}"
        return parse_derivation(self.member.derivation, where)

    @cached_property
    def structure(self) -> str:
        return structure(self.derivation, self.library)

    @cached_property
    def combination(self) -> str:
        return combination(self.derivation)

    @cached_property
    def parts(self) -> frozenset[str]:
        return parts(self.derivation)

    @cached_property
    def parameters(self) -> list[float]:
        return list(parameters(self.derivation, self.library).values())

    def finding(self, code: str, why: str, fix: str) -> Finding:
        return Finding(code, "error", f"test robot {self.member.name}", why, fix)


Rule = Callable[[Split, _Read, Sequence[_Read]], Iterator[Finding]]


def _interpolation(split: Split, test: _Read, train: Sequence[_Read]) -> Iterator[Finding]:
    alike = [read for read in train if read.structure == test.structure]
    if not alike:
        yield test.finding(
            "structure-unseen",
            f"no train robot has its structure, {test.structure}",
            "draw test robots from the grammar of train robots",
        )
        return
    wanted = str(split.provenance.get("hull", "any"))
    if wanted not in HULLS[:2]:
        return
    distance = hull_distance(test.parameters, [read.parameters for read in alike])
    if (distance <= ON_HULL) != (wanted == "inside"):
        is_where = "inside" if distance <= ON_HULL else f"outside, by {distance:.3g} ranges,"
        yield test.finding(
            "hull",
            f"its parameters lie {is_where} of the convex hull of the {len(alike)} train robots "
            f"of its structure; the split says {wanted}",
            "draw another test robot",
        )


def _composition(split: Split, test: _Read, train: Sequence[_Read]) -> Iterator[Finding]:
    trained = frozenset[str]().union(*(read.parts for read in train))
    unseen = sorted(test.parts - trained)
    if unseen:
        yield test.finding(
            "part-unseen",
            f"no train robot has {_listed(unseen)}",
            "train on a robot that has it, or test another",
        )
    same = [read.member.name for read in train if read.combination == test.combination]
    if same:
        yield test.finding(
            "combination-seen",
            f"train robot {same[0]} is the same combination, {test.combination}",
            "leave the combination out of train",
        )
    if len({read.member.task for read in train}) > 1 and not unseen:
        task = test.member.task
        at_task = frozenset[str]().union(*(r.parts for r in train if r.member.task == task))
        if test.parts <= at_task:
            yield test.finding(
                "pair-seen",
                f"every part of it is in a train robot that learns to {task}",
                f"train robots with one of its parts at other tasks than {task} only",
            )


def _extrapolation(split: Split, test: _Read, train: Sequence[_Read]) -> Iterator[Finding]:
    category = test.member.category
    if category != COMPOSED and category in {read.member.category for read in train}:
        yield test.finding(
            "category-seen",
            f"category {category!r} is in train",
            "test a category that is not trained",
        )
    same = [read.member.name for read in train if read.structure == test.structure]
    if same:
        yield test.finding(
            "structure-seen",
            f"train robot {same[0]} has the same structure, {test.structure}",
            "test a structure that is not trained",
        )


def _task_findings(test: _Read, train: Sequence[_Read]) -> Iterator[Finding]:
    trained = {read.member.task for read in train}
    if test.member.task not in trained:
        yield test.finding(
            "task-unseen",
            f"no train robot learns to {test.member.task}",
            "train some robot at it",
        )


_RULES: Mapping[Regime, Rule] = {
    "interpolation": _interpolation,
    "composition": _composition,
    "extrapolation": _extrapolation,
}


def _values(node: Derivation, library: Library) -> dict[str, float]:
    """The parameters of a part, defaults where the derivation does not say."""
    known = library.manifest(node.part).parameters
    return {name: known[name].default for name in known} | dict(node.parameters)


def _is_count(name: str, node: Derivation, library: Library) -> bool:
    known = library.manifest(node.part).parameters
    return name in known and known[name].integer


def _bracketed(brackets: str, entries: Iterable[str]) -> str:
    text = ", ".join(entries)
    return brackets.format(text) if text else ""


def _listed(names: Iterable[str]) -> str:
    return ", ".join(map(repr, names))

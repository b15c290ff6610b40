"""Choose the robots of new splits, by what they hold out or by the rules of a regime."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path

from morphgen.benchmark.generate import (
    SplitRequest,
    composition,
    extrapolation,
    interpolation,
    parse_bound,
)
from morphgen.benchmark.hold_out import hold_out
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.analysis import load_sound_grammar
from morphgen.grammar.library import Library
from morphgen.progress import part_of
from morphgen.splits.split import HOLD_OUT, REGIMES, Regime, Split

MAX_WORD = 60
"""Largest number of characters of what is held out in the name of a split."""
_REQUIRED: Mapping[Regime, tuple[str, ...]] = {
    "interpolation": ("grammar",),
    "composition": ("robots",),
    "extrapolation": ("train_category", "test_category"),
    "hold-out": ("hold_out",),
}
"""Fields of a ``RobotChoice`` that a regime needs."""
_OPTIONAL: Mapping[Regime, tuple[str, ...]] = {
    "interpolation": ("hull",),
    "composition": (),
    "extrapolation": ("similarity",),
    "hold-out": ("robots", "grammar"),
}
"""Further fields that have an effect."""


@dataclass(frozen=True)
class RobotChoice:
    """Rules by which the robots of a split are chosen."""

    regime: Regime
    """Regime of the split; the other fields have an effect with some regimes only."""
    hold_out: tuple[str, ...] = ()
    """Rules of parts that only test robots have; ``hold_out_rules.parse_rules`` reads them."""
    robots: tuple[str, ...] = ()
    """Words of ``morphgen compose`` with choices in braces and wildcards."""
    grammar: tuple[str, ...] = ()
    """Names or files of grammars to draw from; for interpolation, one."""
    train_category: tuple[str, ...] = ()
    """Extrapolation: names or files of the grammars of train robots."""
    test_category: tuple[str, ...] = ()
    """Extrapolation: names or files of the grammars of test robots."""
    hull: str = ""
    """Interpolation: side of the convex hull of the parameters, see ``interpolation``."""
    similarity: str = ""
    """Extrapolation: bound on the cosine to the nearest train robot, such as ``<0.6``."""

    def __post_init__(self) -> None:
        """Check that there are the rules that the regime needs, and no others."""
        if self.regime not in REGIMES:
            raise BenchmarkError(f"unknown regime {self.regime!r}{nearest(self.regime, REGIMES)}")
        required = _REQUIRED[self.regime]
        valid = ("regime", *required, *_OPTIONAL[self.regime])
        for name in required:
            if not getattr(self, name):
                listed = ", ".join(valid[1:])
                raise BenchmarkError(f"{self.regime}: {name} is missing; valid: {listed}")
        for field in fields(self):
            if field.name not in valid and getattr(self, field.name):
                listed = ", ".join(valid[1:])
                raise BenchmarkError(f"{self.regime}: no effect of {field.name}; valid: {listed}")
        if self.regime == "interpolation" and len(self.grammar) > 1:
            raise BenchmarkError(f"interpolation: {len(self.grammar)} grammars; expected one")

    @property
    def word(self) -> str:
        """Word for the robots in the default name of a split."""
        if self.regime == HOLD_OUT:
            words = re.findall(r"[A-Za-z0-9_.]+", ",".join(self.hold_out))
            return "-".join(words)[:MAX_WORD].strip("-.")
        if self.regime == "composition":
            words = " ".join(self.robots).split()
            keys = dict.fromkeys(word.partition("=")[0] for word in words if "={" in word)
            return "-".join(keys) or "robots"
        grammars = [Path(name).stem for name in self.test_category or self.grammar]
        return "-".join([*grammars, *([self.hull] if self.hull not in ("", "any") else [])])


def default_name(choice: RobotChoice, tasks: Sequence[str], obstacles: bool, seed: int) -> str:
    """Return the name of a split for which none is given."""
    boxes = ["obstacles"] if obstacles else []
    return "-".join([choice.regime, choice.word, *tasks, *boxes, f"seed{seed}"])


def choose_robots(
    choice: RobotChoice, request: SplitRequest, library: Library, *, jobs: int = 1
) -> tuple[Split, ...]:
    """Return a split for each size of a request."""
    grammars, train, test = (
        [load_sound_grammar(name, library) for name in names]
        for names in (choice.grammar, choice.train_category, choice.test_category)
    )
    with part_of(request.train[-1] + request.test if request.train else None):
        if choice.regime == "interpolation":
            (grammar,), hull = grammars, choice.hull or "any"
            return interpolation(request, grammar, library, hull=hull, jobs=jobs)
        if choice.regime == "composition":
            return composition(request, choice.robots, library, jobs=jobs)
        if choice.regime == "extrapolation":
            bound = parse_bound(choice.similarity) if choice.similarity else None
            return extrapolation(request, train, test, library, similarity=bound, jobs=jobs)
        return hold_out(
            request, choice.hold_out, library, patterns=choice.robots, grammars=grammars, jobs=jobs
        )

"""The grammars and rules that the private test robots of a split are drawn with."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from morphgen.benchmark.extrapolation import SimilarityBound, UntrainedStructure, parse_bound
from morphgen.benchmark.generate import RejectDerivation, RejectRobot
from morphgen.benchmark.interpolation import StructureAndHull
from morphgen.benchmark.near_duplicates import NearReason
from morphgen.benchmark.robot_factory import Candidate, DerivedRecipe, RobotFactory, make_robots
from morphgen.benchmark.split import SIDES, Side, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.grammar_file import Grammar, find_grammar, load_grammar
from morphgen.grammar.library import Library
from morphgen.grammar.pinning import pin

_GRAMMAR_NAME = re.compile(r"[A-Za-z0-9][\w-]*")


@dataclass(frozen=True, eq=False)
class PrivateSource:
    """Grammars of private robots, and the public robots that they must differ from."""

    grammars: tuple[Grammar, ...]
    public: tuple[Candidate, ...]
    """Robots of both public sides, with their features; no private robot equals one of them."""
    reject_derivation: RejectDerivation
    reject_robot: RejectRobot


def private_source(split: Split, library: Library) -> PrivateSource:
    """Return the source of private test robots that follow the rules of a split's public ones.

    Raises:
        BenchmarkError: As ``test_grammars``.
        MorphgenError: If a public robot cannot be composed.
    """
    grammars = test_grammars(split, library)
    made = split.provenance
    train, test = (_candidates(split, side, library) for side in SIDES)
    public = (*train, *test)
    if split.regime == "interpolation":
        hull = str(made.get("hull", "any"))
        return PrivateSource(
            grammars,
            public,
            StructureAndHull(train, len(train), hull, library),
            NearReason(public),
        )
    bound = parse_bound(str(made["similarity"])) if "similarity" in made else None
    violates_bound, is_near_public = SimilarityBound(train, len(train), bound), NearReason(public)
    return PrivateSource(
        grammars,
        public,
        UntrainedStructure(train, library),
        lambda robot: violates_bound(robot) or is_near_public(robot),
    )


def test_grammars(split: Split, library: Library) -> tuple[Grammar, ...]:
    """Return the grammars of the test robots, as the split's provenance names them.

    Raises:
        BenchmarkError: If the test robots are not all drawn from grammars, or a grammar is unknown
            or has changed.
    """
    refusal = BenchmarkError(
        f"split {split.name!r}: its test robots are not drawn from grammars ({split.regime}); a "
        "private test side is for splits of morphgen split new interpolation or extrapolation, and "
        "for scenarios whose test robots are sampled"
    )
    made = split.provenance
    if split.regime not in ("interpolation", "extrapolation"):
        raise refusal
    hashes = made.get("grammar" if split.regime == "interpolation" else "test_categories")
    if isinstance(hashes, Mapping) and hashes:
        loaded = [_load(str(name), (), library) for name in hashes]
        for grammar in loaded:
            if grammar.digest != hashes[grammar.name]:
                raise BenchmarkError(
                    f"split {split.name!r}: grammar {grammar.name} has changed since the split was "
                    "made; make the split again"
                )
        return tuple(loaded)
    rows = made.get("test")  # of a scenario, see morphgen.benchmark.scenarios
    if not isinstance(rows, Sequence) or isinstance(rows, str) or not rows:
        raise refusal
    pins_by_name: dict[str, str] = {}
    for row in rows:
        if not isinstance(row, Mapping) or "grammar" not in row:
            raise refusal
        name, pins = str(row["grammar"]), str(row.get("pinned", ""))
        if pins_by_name.setdefault(name, pins) != pins:
            raise BenchmarkError(
                f"split {split.name!r}: its test robots are drawn from {name} with different "
                "pinned choices; a private test side needs one grammar of a name"
            )
    return tuple(_load(name, pins.split(), library) for name, pins in pins_by_name.items())


def _load(name: str, pins: Sequence[str], library: Library) -> Grammar:
    """Return a grammar of the library; a split may be a stranger's, so a path is refused."""
    if not _GRAMMAR_NAME.fullmatch(name):
        raise BenchmarkError(f"grammar {name!r}: expected the name of a grammar in the library")
    grammar = load_grammar(find_grammar(name, library.folders), library.folders)
    return pin(grammar, list(pins), library) if pins else grammar


def _candidates(split: Split, side: Side, library: Library) -> list[Candidate]:
    """Return the robots of a side with the features that similarity measures need."""
    factory = RobotFactory(library.folders, with_features=True, max_links=split.max_links)
    recipes = [
        DerivedRecipe(
            parse_derivation(member.derivation, f"derivation of {member.name!r}"),
            member.name,
            member.category,
        )
        for member in split.side(side)
    ]
    return make_robots(recipes, factory)

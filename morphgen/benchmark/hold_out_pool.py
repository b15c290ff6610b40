"""The robots that may be drawn for a split with held-out parts, before any of them is composed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from morphgen.benchmark.generate import MAX_DRAWS, RobotStream, SplitRequest
from morphgen.benchmark.hold_out_rules import HoldOutRule, RangeCondition, held_out_parts
from morphgen.benchmark.part_patterns import PatternRobot, pattern_robots
from morphgen.benchmark.regimes import parts
from morphgen.benchmark.robot_factory import (
    Candidate,
    DerivedRecipe,
    SampledRecipe,
    category_of,
)
from morphgen.formats.rounding import format_number
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.parameters import Parameter

MAX_VALUE_DRAWS = 100
"""Draws of the values of one robot until it is one that no rule holds out; then it has none."""


@dataclass(frozen=True, eq=False)
class Draft:
    """A robot that may be drawn; it is composed when it is."""

    recipe: SampledRecipe | DerivedRecipe
    derivation: Derivation
    """Parts and values; those of a sampled robot may change when it is composed."""
    category: str
    rules: tuple[int, ...]
    """Numbers of the rules that hold for the robot; none if it may be trained on."""
    parts: frozenset[str]
    held_out: frozenset[str]
    """Parts that are held out as such."""
    matching: frozenset[str]
    """Parts that the rules hold for, alone or in a combination."""
    parts_by_kind: Mapping[str, frozenset[str]]
    order: str
    """Random text that decides between robots that are equally good."""

    @property
    def required(self) -> frozenset[str]:
        """Parts that some train robot must have if this is a test robot."""
        return self.parts - self.held_out


@dataclass(frozen=True)
class DraftMaker:
    """Convert derivations to drafts."""

    rules: tuple[HoldOutRule, ...]
    library: Library
    seed: int

    def draft(
        self, recipe: SampledRecipe | DerivedRecipe, derivation: Derivation, category: str
    ) -> Draft:
        """Return the draft of a derivation."""
        holding = tuple(
            number for number, rule in enumerate(self.rules) if rule.holds(derivation, self.library)
        )
        by_kind: dict[str, frozenset[str]] = {}
        for node in derivation.walk():
            kind = self.library.manifest(node.part).kind
            by_kind[kind] = by_kind.get(kind, frozenset()) | {node.part}
        matching = (self.rules[n].matching_parts(derivation, self.library) for n in holding)
        return Draft(
            recipe,
            derivation,
            category,
            holding,
            parts(derivation),
            held_out_parts(self.rules, derivation, self.library),
            frozenset[str]().union(*matching),
            by_kind,
            hashlib.sha256(f"{self.seed} {derivation}".encode()).hexdigest(),
        )

    def composed(self, draft: Draft, robot: Candidate) -> Draft:
        """Return the draft with the derivation that its composed robot has."""
        return self.draft(draft.recipe, robot.derivation, draft.category)


def make_pool(
    request: SplitRequest,
    maker: DraftMaker,
    patterns: Sequence[str],
    grammars: Sequence[Grammar],
) -> list[Draft]:
    """Return every robot that may be drawn, each derivation once.

    Args:
        request: Sizes and seed.
        maker: Converts derivations to drafts.
        patterns: Patterns of robots, see ``pattern_robots``.
        grammars: Grammars that robots are sampled from.

    Raises:
        MorphgenError: If a pattern is malformed or names an unknown part.
    """
    drafts: dict[str, Draft] = {}
    for draft in (
        *_from_patterns(request, maker, patterns),
        *_from_grammars(request, maker, grammars),
    ):
        drafts.setdefault(str(draft.derivation), draft)
    return list(drafts.values())


def _from_patterns(
    request: SplitRequest, maker: DraftMaker, patterns: Sequence[str]
) -> Iterator[Draft]:
    robots = [robot for p in patterns for robot in pattern_robots(p, maker.library)]
    varied = [_varied(robot, maker) for robot in robots]
    wanted = max(request.train) + request.test
    # The draws take turns between robots, so few values of each are enough, if not too few.
    num_values = min(wanted, 4 + 4 * wanted // max(sum(map(bool, varied)), 1))
    for robot, choices in zip(robots, varied, strict=True):
        category = category_of(robot.words, maker.library)
        for derivation in _with_values(robot.derivation, choices, num_values, maker):
            yield maker.draft(DerivedRecipe(derivation, robot.name, category), derivation, category)


def _from_grammars(
    request: SplitRequest, maker: DraftMaker, grammars: Sequence[Grammar]
) -> Iterator[Draft]:
    for grammar in grammars:
        stream = RobotStream.of(grammar, grammar.name, request)
        for number in range(max(MAX_DRAWS, 4 * (max(request.train) + request.test))):
            derivation = stream.derivation(number, maker.library)
            if derivation is not None:
                yield maker.draft(stream.recipe(number), derivation, grammar.name)


@dataclass(frozen=True)
class _Choice:
    """A parameter whose value is drawn, because a range of it is held out."""

    label: str
    """Label of the part in the derivation."""
    parameter: Parameter
    condition: RangeCondition

    def draw(self, rng: np.random.Generator, *, inside: bool) -> float:
        """Draw a value inside of the held-out range, or from all that are valid."""
        low, high = self.parameter.minimum, self.parameter.maximum
        if inside:
            low, high = max(low, self.condition.low), min(high, self.condition.high)
        if self.parameter.integer:
            return float(rng.integers(round(low), round(high), endpoint=True))
        return float(format_number(rng.uniform(low, high)))


def _varied(robot: PatternRobot, maker: DraftMaker) -> list[_Choice]:
    """Return the parameters with held-out ranges, except those that the pattern sets."""
    given = {word.partition("=")[0].replace(".", "_") for word in robot.words}
    conditions = [condition for rule in maker.rules for condition in rule.conditions]
    choices: list[_Choice] = []
    for node in robot.derivation.walk():
        manifest = maker.library.manifest(node.part)
        for condition in conditions:
            if not (isinstance(condition, RangeCondition) and condition.applies_to(manifest)):
                continue
            parameter = manifest.attached_parameters[condition.parameter]
            overlaps = condition.low <= parameter.maximum and condition.high >= parameter.minimum
            if overlaps and f"{node.label}_{condition.parameter}" not in given:
                choices.append(_Choice(node.label, parameter, condition))
    return choices


def _with_values(
    derivation: Derivation, choices: Sequence[_Choice], num_values: int, maker: DraftMaker
) -> Iterator[Derivation]:
    """Yield a derivation with drawn values: as many held-out ones as others, if there are any."""
    if not choices:
        yield derivation
        return
    rng = np.random.default_rng(np.random.SeedSequence([maker.seed, *str(derivation).encode()]))
    for i in range(num_values):
        # Of several ranges of one parameter the last one counts: each takes its turn.
        turn = i % len(choices)
        in_turn = [*choices[turn:], *choices[:turn]]
        yield _replace_values(derivation, in_turn, rng, inside=True)
        for _ in range(MAX_VALUE_DRAWS):
            drawn = _replace_values(derivation, choices, rng, inside=False)
            if not any(rule.holds(drawn, maker.library) for rule in maker.rules):
                yield drawn
                break


def _replace_values(
    derivation: Derivation,
    choices: Sequence[_Choice],
    rng: np.random.Generator,
    *,
    inside: bool,
) -> Derivation:
    values: dict[str, dict[str, float]] = {}
    for choice in choices:
        by_name = values.setdefault(choice.label, {})
        by_name[choice.condition.parameter] = choice.draw(rng, inside=inside)
    return _updated(derivation, values)


def _updated(node: Derivation, values: Mapping[str, Mapping[str, float]]) -> Derivation:
    """Return the derivation with some values replaced, by label and parameter."""
    return replace(
        node,
        parameters=tuple({**dict(node.parameters), **values.get(node.label, {})}.items()),
        children=tuple((port, _updated(child, values)) for port, child in node.children),
    )

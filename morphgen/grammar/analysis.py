"""What a grammar can make: faults, the number of structures, and the structures themselves."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field

from morphgen.errors import CompositionError, GrammarError
from morphgen.grammar.compose import own_values, require_root
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import (
    MAX_PARTS,
    EndlessError,
    First,
    argument,
    attached_parameters,
    derive,
    require_part,
)
from morphgen.grammar.library import Library
from morphgen.grammar.model import Grammar
from morphgen.grammar.part import load_part
from morphgen.grammar.syntax import Alternative, Expression, Item, Production
from morphgen.grammar.values import Distribution, Scope, distribution_of, evaluate, no_draw

CHECKED_STRUCTURES = 500
"""Structures that ``faults`` builds, at most, to see whether their ports fit."""
CHECKED_ENDLESS = 40
"""The same, of a grammar that has infinitely many."""


@dataclass(frozen=True)
class Variable:
    """A value that a grammar draws."""

    where: str
    """``let`` or symbol, part and parameter."""
    distribution: Distribution
    text: str


def faults(grammar: Grammar, library: Library) -> list[str]:
    """Everything that is wrong with a grammar, a line each; none if it is sound.

    Unknown names, parameters, units and values out of range; symbols that cannot be reached or
    never end; values that are never used; ports that do not exist.
    """
    found = [*_item_faults(grammar, library), *_endless(grammar), *_circular(grammar)]
    if not found:
        found += _structure_faults(grammar, library)
    return [*found, *_unreached(grammar), *_unused(grammar)]


def count(grammar: Grammar) -> float:
    """Number of structures, values aside; infinite for a grammar that recurs.

    One that can be derived in two ways counts twice.
    """
    return _count(grammar, grammar.start, ())


def variables(grammar: Grammar) -> list[Variable]:
    """Every value that the grammar draws."""
    names = _typical_names(grammar)
    found = [
        Variable(f"let {let.name}", *_described(call, names))
        for let in grammar.lets
        for call in _calls(let.expression)
    ]
    for production in grammar.productions:
        for item in _items(production):
            for name, expression in item.arguments:
                where = f"{production.symbol}: {item.name}.{name}"
                found += [Variable(where, *_described(call, names)) for call in _calls(expression)]
    return found


def enumerate_structures(grammar: Grammar, library: Library) -> Iterator[Derivation]:
    """Every structure once, with typical values; small ones first where there is no end.

    Raises:
        GrammarError: If a structure cannot be derived.
    """
    seen: set[str] = set()
    endless = math.isinf(count(grammar))
    for parts in range(1, MAX_PARTS + 1) if endless else (MAX_PARTS,):
        for derivation in _structures(grammar, library, parts):
            fits = not endless or sum(1 for _ in derivation.walk()) == parts
            if fits and derivation.digest not in seen:
                seen.add(derivation.digest)
                yield derivation


@dataclass
class _Script(First):
    """Follows a list of decisions, then takes the first; notes how many options there were."""

    decisions: list[int]
    options: list[int] = field(default_factory=list)

    def alternative(self, key: str, weights: list[float]) -> int:
        possible = [i for i, weight in enumerate(weights) if weight > 0]
        return possible[self._decide(len(possible))]

    def count(self, key: str, low: int, high: int) -> int:
        return low + self._decide(high - low + 1)

    def _decide(self, options: int) -> int:
        position = len(self.options)
        self.options.append(options)
        return self.decisions[position] if position < len(self.decisions) else 0


def _structures(grammar: Grammar, library: Library, max_parts: int) -> Iterator[Derivation]:
    decisions: list[int] = []
    while True:
        script = _Script(decisions)
        with suppress(EndlessError):  # too many parts; the next structure may have fewer
            yield derive(grammar, library, script, max_parts)
        decisions = (decisions + [0] * len(script.options))[: len(script.options)]
        while decisions and decisions[-1] + 1 >= script.options[len(decisions) - 1]:
            decisions.pop()
        if not decisions:
            return
        decisions[-1] += 1


def _item_faults(grammar: Grammar, library: Library) -> Iterator[str]:
    for draw in (_lowest, _highest, no_draw, _inner):
        names: dict[str, tuple[float, str]] = {}
        try:
            for let in grammar.lets:
                names[let.name] = evaluate(let.expression, Scope(names, draw, ""))
        except GrammarError as error:
            yield str(error)
            return
        scope = Scope(names, draw, "")
        items = (item for production in grammar.productions for item in _items(production))
        reported = {
            fault: None for item in items for fault in _faults_of(item, grammar, library, scope)
        }
        yield from reported
        if reported:
            return


def _faults_of(item: Item, grammar: Grammar, library: Library, scope: Scope) -> Iterator[str]:
    try:
        if grammar.production(item.name):
            _require_bare(item)
            return
        parameters = attached_parameters(require_part(item, grammar, library))
    except GrammarError as error:
        yield str(error)
        return
    for name, expression in item.arguments:
        try:
            argument(item, name, expression, parameters, scope)
        except GrammarError as error:
            yield str(error)


def _require_bare(item: Item) -> None:
    if item.arguments:
        raise GrammarError(f"{item.place}: {item.name!r} is a symbol and takes no parameters")


def _endless(grammar: Grammar) -> Iterator[str]:
    """Symbols none of whose derivations ends."""
    symbols = {production.symbol for production in grammar.productions}
    ending: set[str] = set()
    while True:
        more = {
            production.symbol
            for production in grammar.productions
            if any(
                all(item.name in ending or item.name not in symbols for item in alternative.items)
                for alternative in production.alternatives
            )
        }
        if more <= ending:
            break
        ending |= more
    for production in grammar.productions:
        if production.symbol not in ending:
            yield f"{production.place}: {production.symbol!r} never ends: it always holds itself"


def _circular(grammar: Grammar) -> Iterator[str]:
    """Symbols that can be rewritten to themselves and nothing else."""
    alone = {
        production.symbol: {
            alternative.items[0].name
            for alternative in production.alternatives
            if len(alternative.items) == 1
        }
        for production in grammar.productions
    }
    for production in grammar.productions:
        below = set(alone[production.symbol])
        while more := {name for symbol in below for name in alone.get(symbol, ())} - below:
            below |= more
        if production.symbol in below:
            yield f"{production.place}: {production.symbol!r} can be rewritten to itself alone"


def _unreached(grammar: Grammar) -> Iterator[str]:
    reached, fresh = {grammar.start}, [grammar.start]
    while fresh:
        production = grammar.production(fresh.pop())
        for item in _items(production) if production else ():
            if item.name not in reached:
                reached.add(item.name)
                fresh.append(item.name)
    for production in grammar.productions:
        if production.symbol not in reached:
            start = grammar.start
            yield f"{production.place}: {production.symbol!r} cannot be reached from {start!r}"


def _unused(grammar: Grammar) -> Iterator[str]:
    expressions = [let.expression for let in grammar.lets]
    for production in grammar.productions:
        for alternative in production.alternatives:
            expressions += [alternative.weight] if alternative.weight else []
            expressions += [value for item in alternative.items for _, value in item.arguments]
    used = {name for expression in expressions for name in _name_set(expression)}
    for let in grammar.lets:
        if let.name not in used:
            yield f"{let.place}: {let.name!r} is never used"


def _structure_faults(grammar: Grammar, library: Library) -> Iterator[str]:
    structures = enumerate_structures(grammar, library)
    roots: set[str] = set()
    try:
        for _ in range(CHECKED_ENDLESS if math.isinf(count(grammar)) else CHECKED_STRUCTURES):
            structure = next(structures, None)
            if structure is None:
                return
            if structure.part not in roots:
                roots.add(structure.part)
                require_root(load_part(library.manifest(structure.part), own_values(structure)))
    except CompositionError as error:
        start = grammar.production(grammar.start)
        yield f"{start.place if start else grammar.name}: {error}"
    except GrammarError as error:
        yield str(error)


def _count(grammar: Grammar, symbol: str, above: tuple[str, ...]) -> float:
    production = grammar.production(symbol)
    if production is None:
        return 1
    if symbol in above:
        return math.inf
    total: float = 0
    for alternative in _possible(grammar, production):
        product: float = 1
        for item in alternative.items:
            each = _count(grammar, item.name, (*above, symbol))
            low, high = item.repetition or (1, 1)
            product *= sum(each**n for n in range(low, high + 1))
        total += product
    return total


def _possible(grammar: Grammar, production: Production) -> Iterator[Alternative]:
    """Alternatives whose weight is not zero where values are typical."""
    scope = Scope(_typical_names(grammar), no_draw, "")
    for alternative in production.alternatives:
        if alternative.weight is None or evaluate(alternative.weight, scope)[0] > 0:
            yield alternative


def _items(production: Production) -> Iterator[Item]:
    for alternative in production.alternatives:
        yield from alternative.items


def _calls(expression: Expression) -> Iterator[Expression]:
    if expression.operator == "call":
        yield expression
    for operand in expression.operands:
        yield from _calls(operand)


def _name_set(expression: Expression) -> set[str]:
    below = {name for operand in expression.operands for name in _name_set(operand)}
    return below | ({expression.text} if expression.operator == "name" else set())


def _typical_names(grammar: Grammar) -> dict[str, tuple[float, str]]:
    names: dict[str, tuple[float, str]] = {}
    for let in grammar.lets:
        names[let.name] = evaluate(let.expression, Scope(names, no_draw, ""))
    return names


def _described(call: Expression, names: dict[str, tuple[float, str]]) -> tuple[Distribution, str]:
    distribution, _ = distribution_of(call, Scope(names, no_draw, ""))
    return distribution, str(call)


def _lowest(key: str, distribution: Distribution) -> float:
    return distribution.bounds[0]


def _inner(key: str, distribution: Distribution) -> float:
    """A value that is neither end nor middle, nor whole if it need not be."""
    return distribution.draw(lambda: 0.381966, lambda: 0.381966)


def _highest(key: str, distribution: Distribution) -> float:
    return distribution.bounds[1]

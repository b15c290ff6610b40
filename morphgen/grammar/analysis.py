"""What is wrong with a grammar, and which values it draws."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from morphgen.errors import CompositionError, GrammarError
from morphgen.grammar.compose import part_values, require_root
from morphgen.grammar.derive import (
    argument,
    attached_parameters,
    require_part,
)
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_FAULTS, MAX_PARTS
from morphgen.grammar.part import load_part
from morphgen.grammar.structures import (
    SearchError,
    count_structures,
    enumerate_structures,
    typical_names,
)
from morphgen.grammar.syntax import Expression, Item, Production
from morphgen.grammar.values import Distribution, Scope, distribution_of, evaluate, no_draw

CHECKED_STRUCTURES = 500
"""Structures that ``faults`` builds, at most, to see whether their ports fit."""
CHECKED_ENDLESS = 40
"""The same, of a grammar that has infinitely many."""


@dataclass(frozen=True)
class Variable:
    """A value that a grammar draws."""

    location: str
    """``let`` or symbol, part and parameter."""
    distribution: Distribution
    text: str


def check_grammar(grammar: Grammar, library: Library) -> list[str]:
    """Everything that is wrong with a grammar, a line each; none if it is sound.

    Unknown names, parameters, units and values out of range; symbols that cannot be reached or
    never end; values that are never used; ports that do not exist.
    """
    found = [*_item_faults(grammar, library), *_endless(grammar), *_circular(grammar)]
    if not found:
        found += _structure_faults(grammar, library)
    return [*found, *_unreached(grammar), *_unused(grammar)]


def variables(grammar: Grammar) -> list[Variable]:
    """Every value that the grammar draws."""
    names = typical_names(grammar)
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
        found = (fault for item in items for fault in _faults_of(item, grammar, library, scope))
        reported = dict.fromkeys(islice(found, MAX_FAULTS))
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
        raise GrammarError(f"{item.location}: {item.name!r} is a symbol and takes no parameters")


def _endless(grammar: Grammar) -> Iterator[str]:
    """Symbols none of whose derivations ends."""
    symbols = {production.symbol for production in grammar.productions}
    open_symbols: list[tuple[str, set[str]]] = []
    """(symbol, symbols of one of its alternatives that are not known to end)."""
    waiting: dict[str, list[int]] = {}
    fresh: list[str] = []
    for production in grammar.productions:
        for alternative in production.alternatives:
            below = {item.name for item in alternative.items} & symbols
            for name in below:
                waiting.setdefault(name, []).append(len(open_symbols))
            open_symbols.append((production.symbol, below))
            fresh += [] if below else [production.symbol]
    ending: set[str] = set()
    while fresh:
        name = fresh.pop()
        if name in ending:
            continue
        ending.add(name)
        for number in waiting.get(name, ()):
            symbol, below = open_symbols[number]
            below.discard(name)
            fresh += [] if below else [symbol]
    for production in grammar.productions:
        if production.symbol not in ending:
            yield f"{production.location}: {production.symbol!r} never ends: it always holds itself"


def _circular(grammar: Grammar) -> Iterator[str]:
    """Symbols that can be rewritten to themselves and nothing else."""
    number = {production.symbol: i for i, production in enumerate(grammar.productions)}
    alone = [
        (number[production.symbol], number[alternative.items[0].name])
        for production in grammar.productions
        for alternative in production.alternatives
        if len(alternative.items) == 1 and alternative.items[0].name in number
    ]
    graph = coo_matrix(
        (np.ones(len(alone)), np.array(alone, dtype=int).reshape(-1, 2).T),
        shape=(len(number), len(number)),
    )
    _, component = connected_components(graph, connection="strong")
    sizes = np.bincount(component)
    itself = {one for one, other in alone if one == other}
    for i, production in enumerate(grammar.productions):
        if sizes[component[i]] > 1 or i in itself:
            yield f"{production.location}: {production.symbol!r} can be rewritten to itself alone"


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
            yield f"{production.location}: {production.symbol!r} cannot be reached from {start!r}"


def _unused(grammar: Grammar) -> Iterator[str]:
    expressions = [let.expression for let in grammar.lets]
    for production in grammar.productions:
        for alternative in production.alternatives:
            expressions += [alternative.weight] if alternative.weight else []
            expressions += [value for item in alternative.items for _, value in item.arguments]
    used = {name for expression in expressions for name in _name_set(expression)}
    for let in grammar.lets:
        if let.name not in used:
            yield f"{let.location}: {let.name!r} is never used"


def _structure_faults(grammar: Grammar, library: Library) -> Iterator[str]:
    start = grammar.production(grammar.start)
    location = start.location if start else grammar.name
    most = CHECKED_ENDLESS if count_structures(grammar) == math.inf else CHECKED_STRUCTURES
    roots: set[str] = set()
    derived = False
    try:
        for structure in islice(enumerate_structures(grammar, library), most):
            derived = True
            if structure.part not in roots:
                roots.add(structure.part)
                require_root(load_part(library.manifest(structure.part), part_values(structure)))
    except CompositionError as error:
        yield f"{location}: {error}"
        return
    except SearchError as error:
        if not derived:
            yield f"{location}: {error}"
        return  # the structures that were derived are sound
    except GrammarError as error:
        yield str(error)
        return
    if not derived:
        yield f"{location}: found no structure of at most {MAX_PARTS} parts and {MAX_PARTS} levels"


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

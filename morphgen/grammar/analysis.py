"""Check a grammar for faults, and count its structures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from graphlib import CycleError, TopologicalSorter
from itertools import islice

from morphgen.errors import CompositionError, GrammarError
from morphgen.grammar import values
from morphgen.grammar.compose import require_root
from morphgen.grammar.derive import (
    argument,
    free_port,
    production_weights,
    require_no_arguments,
    require_no_yaw,
    require_part,
)
from morphgen.grammar.grammar_file import Grammar, find_grammar, load_grammar
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW
from morphgen.grammar.part import load_part
from morphgen.grammar.syntax import MAX_COUNT, MAX_FAULTS, Alternative, Item

_MANY = MAX_COUNT + 1  # stands for any larger number of structures


def count_structures(grammar: Grammar) -> float:
    """Return the number of structures, or of derivations if more; infinity if recursive.

    It is exact up to ``MAX_COUNT``; ``MAX_COUNT + 1`` stands for any larger number.
    """
    alternatives = _possible_alternatives(grammar)
    counts: dict[str, int] = {}
    try:
        for symbol in TopologicalSorter(_symbol_graph(grammar, alternatives)).static_order():
            counts[symbol] = min(sum(_count(a, counts) for a in alternatives[symbol]), _MANY)
    except CycleError:
        return math.inf
    return counts[grammar.start]


def _typical_scope(grammar: Grammar) -> values.Scope:
    """Return a scope with typical values of all names and distributions."""
    return values.Scope(_let_values(grammar, values.typical_value), values.typical_value, "")


def _let_values(grammar: Grammar, draw: values.Draw) -> dict[str, tuple[float, str]]:
    """Return the value and the unit of every name defined by ``let``."""
    names: dict[str, tuple[float, str]] = {}
    for let in grammar.lets:
        names[let.name] = values.evaluate(let.expression, values.Scope(names, draw, ""))
    return names


def _symbol_graph(
    grammar: Grammar, alternatives: Mapping[str, Sequence[Alternative]]
) -> dict[str, set[str]]:
    """Return the symbols in the alternatives of every symbol reachable from the start."""
    graph: dict[str, set[str]] = {}
    pending = [grammar.start]
    while pending:
        symbol = pending.pop()
        if symbol not in graph:
            items = (item.name for a in alternatives[symbol] for item in a.items)
            graph[symbol] = {name for name in items if name in alternatives}
            pending += graph[symbol]
    return graph


def _count(alternative: Alternative, counts: Mapping[str, int]) -> int:
    """Return the number of structures of an alternative, exact up to ``MAX_COUNT``."""
    product = 1
    for item in alternative.items:
        low, high = item.repetition or (1, 1)
        power, total = 1, 0
        for n in range(1, high + 1):
            # Uncapped, 64 doublings of a symbol would give a number of 2**64 bits.
            power = min(power * counts.get(item.name, 1), _MANY)
            total += power if n >= low else 0
        product = min(product * total, _MANY)
    return product


def _possible_alternatives(grammar: Grammar) -> dict[str, list[Alternative]]:
    """Return the alternatives of each symbol with a positive weight at typical values."""
    scope = _typical_scope(grammar)
    return {
        production.symbol: [
            alternative
            for alternative, weight in zip(
                production.alternatives, production_weights(production, scope), strict=True
            )
            if weight > 0
        ]
        for production in grammar.productions
    }


INNER_QUANTILE = 0.381966
"""Quantile of a test value that is neither a bound nor the middle; 1 - 1 / golden ratio."""
_TESTED: tuple[values.Draw, ...] = (
    lambda _, distribution: distribution.bounds[0],
    lambda _, distribution: distribution.bounds[1],
    values.typical_value,
    # Neither a bound nor the middle, and no integer if it need not be one.
    lambda _, distribution: distribution.draw(lambda: INNER_QUANTILE, lambda: INNER_QUANTILE),
)
"""Selections of the values that ``check_grammar`` tests."""


def check_grammar(grammar: Grammar, library: Library) -> list[str]:
    """Return the faults of a grammar, one line each; an empty list if it is valid.

    Faults are: unknown names, parameters and units; values out of range; symbols that cannot be
    reached or never end; values that are never used; ports that do not exist.
    """
    faults = [*_item_faults(grammar, library), *_never_ending(grammar), *_circular(grammar)]
    if not faults:
        faults += _structure_faults(grammar, library)
    return [*faults, *_unreachable(grammar), *_unused(grammar)]


def load_sound_grammar(name: str, library: Library) -> Grammar:
    """Return a grammar by its name or file, and require that it has no faults."""
    grammar = load_grammar(find_grammar(name, library.folders), library.folders)
    if faults := check_grammar(grammar, library):
        raise GrammarError(faults[0] + (f" (and {len(faults) - 1} more)" if faults[1:] else ""))
    return grammar


def _item_faults(grammar: Grammar, library: Library) -> Iterator[str]:
    """Test all items with each distribution at its bounds, its typical and an inner value."""
    for draw in _TESTED:
        try:
            scope = values.Scope(_let_values(grammar, draw), draw, "")
        except GrammarError as error:
            yield str(error)
            return
        items = (item for production in grammar.productions for item in production.items())
        faults = (fault for item in items for fault in _faults_of(item, grammar, library, scope))
        reported = dict.fromkeys(islice(faults, MAX_FAULTS))
        yield from reported
        if reported:
            return


def _faults_of(
    item: Item, grammar: Grammar, library: Library, scope: values.Scope
) -> Iterator[str]:
    try:
        if grammar.production(item.name):
            require_no_arguments(item)
            return
        parameters = require_part(item, grammar, library).attached_parameters
    except GrammarError as error:
        yield str(error)
        return
    for name, expression in item.arguments:
        try:
            argument(item, name, expression, parameters, scope)
        except GrammarError as error:
            yield str(error)


def _never_ending(grammar: Grammar) -> Iterator[str]:
    symbols = {production.symbol for production in grammar.productions}
    contents = [
        (production.symbol, symbols & {item.name for item in alternative.items})
        for production, alternative in grammar.alternatives()
    ]
    ending: set[str] = set()
    # A symbol ends if all symbols of one of its alternatives do.
    while found := {symbol for symbol, names in contents if names <= ending} - ending:
        ending |= found
    for production in grammar.productions:
        if (symbol := production.symbol) not in ending:
            yield f"{production.location}: {symbol!r} never ends: it always holds itself"


def _circular(grammar: Grammar) -> Iterator[str]:
    """Find symbols that can be rewritten to themselves and nothing else."""
    targets: dict[str, set[str]] = {production.symbol: set() for production in grammar.productions}
    for production, alternative in grammar.alternatives():
        if len(alternative.items) == 1 and (name := alternative.items[0].name) in targets:
            targets[production.symbol].add(name)
    for production in grammar.productions:
        reached: set[str] = set()
        pending = [*targets[production.symbol]]
        while pending:
            if (symbol := pending.pop()) not in reached:
                reached.add(symbol)
                pending += targets[symbol]
        if production.symbol in reached:
            yield f"{production.location}: {production.symbol!r} can be rewritten to itself alone"


def _unreachable(grammar: Grammar) -> Iterator[str]:
    reached = _symbol_graph(grammar, {p.symbol: p.alternatives for p in grammar.productions})
    for production in grammar.productions:
        if (symbol := production.symbol) not in reached:
            yield f"{production.location}: {symbol!r} cannot be reached from {grammar.start!r}"


def _unused(grammar: Grammar) -> Iterator[str]:
    expressions = [let.expression for let in grammar.lets]
    for _, alternative in grammar.alternatives():
        expressions += [alternative.weight] if alternative.weight else []
        expressions += [value for item in alternative.items for _, value in item.arguments]
    terms = (term for expression in expressions for term in expression.walk())
    used = {term.text for term in terms if term.operator == "name"}
    for let in grammar.lets:
        if let.name not in used:
            yield f"{let.location}: {let.name!r} is never used"


def _structure_faults(grammar: Grammar, library: Library) -> Iterator[str]:
    """Find ports that do not exist or are taken, and first parts that need a base."""
    start = grammar.production(grammar.start)
    location = start.location if start else grammar.name
    try:
        alternatives = _possible_alternatives(grammar)
        _require_ports(alternatives, library)
        scope, roots = _typical_scope(grammar), set()
        for item in _first_items(grammar.start, alternatives):
            manifest = library.manifest(item.name)
            values = {
                name: argument(item, name, expression, manifest.attached_parameters, scope)
                for name, expression in item.arguments
            }
            require_no_yaw(item.name, values.pop(MOUNT_YAW, 0.0), location)
            if item.name not in roots:
                roots.add(item.name)
                require_root(load_part(manifest, values))
    except CompositionError as error:
        yield f"{location}: {error}"
    except GrammarError as error:
        yield str(error)


def _first_items(start: str, alternatives: Mapping[str, Sequence[Alternative]]) -> list[Item]:
    """Return the items that may become the first part of a robot."""
    items: list[Item] = []
    symbols = [start]
    for symbol in symbols:  # which grows
        for item in (alternative.items[0] for alternative in alternatives[symbol]):
            if item.name not in alternatives:
                items.append(item)
            elif item.name not in symbols:
                symbols.append(item.name)
    return items


_Trunk = tuple[str, frozenset[str]]
"""A part that the next item is attached to, and its ports that are taken."""


def _require_ports(alternatives: Mapping[str, Sequence[Alternative]], library: Library) -> None:
    """Require that every item can be attached to every part that may come before it."""
    last: dict[str, set[_Trunk]] = {symbol: set() for symbol in alternatives}
    size = -1
    while size != (size := sum(map(len, last.values()))):  # fixed point: symbols may be recursive
        for symbol, each in alternatives.items():
            for alternative in each:
                last[symbol] |= _last_parts(alternative, last, library)


def _last_parts(
    alternative: Alternative, last: Mapping[str, set[_Trunk]], library: Library
) -> set[_Trunk]:
    """Return what the item after an alternative may be attached to, given that of symbols."""
    trunks: set[_Trunk] = set()
    for i, item in enumerate(alternative.items):
        new = last.get(item.name, {(item.name, frozenset())})
        low, high = item.repetition or (1, 1)
        before, trunks = trunks, set()
        for n in range(1, min(high, 3) + 1):  # further copies are attached as the third one
            after = set() if i or n > 1 else set(new)
            for part, taken in before:
                port = free_port(part, library.manifest(part).ports, taken, item)
                after |= {(part, taken | {port})} if item.port else new
            trunks |= after if n >= min(low, 3) else set()
            before = after
    return trunks

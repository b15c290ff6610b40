"""Count and enumerate the structures of a grammar: its derivations without their values."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter

from morphgen.errors import GrammarError
from morphgen.grammar.choosers import FirstChooser
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import DeriveCache, TooManyPartsError, count_fewest_parts, derive
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_COUNT, MAX_PARTS, MAX_SEARCH
from morphgen.grammar.syntax import Alternative
from morphgen.grammar.values import Scope, evaluate, typical_value


class SearchError(GrammarError):
    """The search for another structure was given up after ``MAX_SEARCH`` parts."""


def count_structures(grammar: Grammar) -> float:
    """Return the number of structures, or infinity for a recursive grammar.

    A structure that has two derivations counts twice. The number is exact up to ``MAX_COUNT``;
    ``MAX_COUNT + 1`` stands for any larger number.
    """
    alternatives = _possible_alternatives(grammar)
    counts: dict[str, int] = {}
    try:
        for symbol in TopologicalSorter(_symbol_graph(grammar, alternatives)).static_order():
            counts[symbol] = _capped(sum(_count(a, counts) for a in alternatives[symbol]))
    except CycleError:
        return math.inf
    return counts[grammar.start]


def enumerate_structures(grammar: Grammar, library: Library) -> Iterator[Derivation]:
    """Yield every structure once, with typical values; the smallest first if they are infinite.

    Raises:
        GrammarError: If a structure cannot be derived, or ``MAX_SEARCH`` parts give no further
            one (``SearchError``).
    """
    digests: set[str] = set()
    is_infinite = count_structures(grammar) == math.inf
    wasted_parts = 0
    # Infinitely many structures are enumerated by size, a pass for each number of parts.
    for max_parts in range(1, MAX_PARTS + 1) if is_infinite else (MAX_PARTS,):
        for derivation in _derivations(grammar, library, max_parts):
            size = max_parts if derivation is None else sum(1 for _ in derivation.walk())
            fits = not is_infinite or size == max_parts
            if derivation is not None and fits and derivation.digest not in digests:
                digests.add(derivation.digest)
                wasted_parts = 0
                yield derivation
                continue
            wasted_parts += size
            if wasted_parts > MAX_SEARCH:
                raise SearchError(
                    f"{grammar.name}: no new structure in the last {wasted_parts:,} parts "
                    f"(limit {MAX_SEARCH:,}): alternatives repeat, or lead to more than "
                    f"{MAX_PARTS} parts or levels"
                )


def typical_names(grammar: Grammar) -> dict[str, tuple[float, str]]:
    """Return the typical value and the unit of every name defined by ``let``."""
    names: dict[str, tuple[float, str]] = {}
    for let in grammar.lets:
        names[let.name] = evaluate(let.expression, Scope(names, typical_value, ""))
    return names


@dataclass
class _ScriptedChooser(FirstChooser):
    """Follows a list of decisions, then chooses the first option; records the option counts."""

    decisions: list[int]
    options: list[int] = field(default_factory=list)
    """Number of options of every decision."""

    def alternative(self, key: str, weights: list[float]) -> int:
        possible = [i for i, weight in enumerate(weights) if weight > 0]
        return possible[self._decide(len(possible))]

    def count(self, key: str, low: int, high: int) -> int:
        return low + self._decide(high - low + 1)

    def _decide(self, options: int) -> int:
        position = len(self.options)
        self.options.append(options)
        return self.decisions[position] if position < len(self.decisions) else 0


def _derivations(grammar: Grammar, library: Library, max_parts: int) -> Iterator[Derivation | None]:
    """Yield the derivation of every list of decisions; None if it has too many parts."""
    decisions: list[int] = []
    cache = DeriveCache(fewest_parts=_fewest_parts(_possible_alternatives(grammar)))
    while True:
        chooser = _ScriptedChooser(decisions)
        try:
            derivation = derive(grammar, library, chooser, max_parts, cache)
        except TooManyPartsError:
            derivation = None
        yield derivation
        # Advance the decisions like an odometer whose last digit turns fastest.
        decisions = (decisions + [0] * len(chooser.options))[: len(chooser.options)]
        while decisions and decisions[-1] + 1 >= chooser.options[len(decisions) - 1]:
            decisions.pop()
        if not decisions:
            return
        decisions[-1] += 1


def _fewest_parts(possible: Mapping[str, Sequence[Alternative]]) -> dict[str, int]:
    """Return the smallest number of parts of each symbol, at most ``MAX_PARTS + 1``."""
    fewest = dict.fromkeys(possible, MAX_PARTS + 1)
    changed = True
    while changed:  # fixed-point iteration, as symbols may be recursive
        changed = False
        for symbol, alternatives in possible.items():
            sizes = (count_fewest_parts(alternative, fewest) for alternative in alternatives)
            least = min(sizes, default=fewest[symbol])
            if least < fewest[symbol]:
                fewest[symbol] = least
                changed = True
    return fewest


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
            power = _capped(power * counts.get(item.name, 1))
            total += power if n >= low else 0
        product = _capped(product * total)
    return product


def _capped(number: int) -> int:
    """Return a number of structures, at most ``MAX_COUNT + 1``."""
    return min(number, MAX_COUNT + 1)


def _possible_alternatives(grammar: Grammar) -> dict[str, list[Alternative]]:
    """Return the alternatives of each symbol with a positive weight at typical values."""
    scope = Scope(typical_names(grammar), typical_value, "")
    return {
        production.symbol: [
            alternative
            for alternative in production.alternatives
            if alternative.weight is None or evaluate(alternative.weight, scope)[0] > 0
        ]
        for production in grammar.productions
    }

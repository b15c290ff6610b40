"""The structures that a grammar can make: their number, and the structures themselves."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from graphlib import CycleError, TopologicalSorter

from morphgen.errors import GrammarError
from morphgen.grammar.choosers import FirstChooser
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import Known, TooManyPartsError, derive, fewest_parts
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_COUNT, MAX_PARTS, MAX_SEARCH
from morphgen.grammar.syntax import Alternative
from morphgen.grammar.values import Scope, evaluate, no_draw


class SearchError(GrammarError):
    """No further structure was found with reasonable work."""


def count_structures(grammar: Grammar) -> float:
    """Number of structures, values aside; infinite for a grammar that recurs.

    One that can be derived in two ways counts twice. A finite number is exact up to ``MAX_COUNT``;
    what is above stands for any larger one.
    """
    possible = _possible(grammar)
    counts: dict[str, int] = {}
    try:
        for symbol in TopologicalSorter(_graph(grammar, possible)).static_order():
            total = sum(_sequences(alternative, counts) for alternative in possible[symbol])
            counts[symbol] = _bounded(total)
    except CycleError:
        return math.inf
    return counts[grammar.start]


def enumerate_structures(grammar: Grammar, library: Library) -> Iterator[Derivation]:
    """Every structure once, with typical values; small ones first where there is no end.

    Raises:
        GrammarError: If a structure cannot be derived, or no further one is found although
            ``MAX_SEARCH`` parts are placed (``SearchError``).
    """
    seen: set[str] = set()
    endless = count_structures(grammar) == math.inf
    in_vain = 0
    for parts in range(1, MAX_PARTS + 1) if endless else (MAX_PARTS,):
        for derivation in _structures(grammar, library, parts):
            size = parts if derivation is None else sum(1 for _ in derivation.walk())
            fits = derivation is not None and (not endless or size == parts)
            if derivation is not None and fits and derivation.digest not in seen:
                seen.add(derivation.digest)
                in_vain = 0
                yield derivation
                continue
            in_vain += size
            if in_vain > MAX_SEARCH:
                raise SearchError(
                    f"{grammar.name}: no new structure in the last {in_vain:,} parts that were "
                    f"placed (limit {MAX_SEARCH:,}): alternatives repeat, or lead to more than "
                    f"{MAX_PARTS} parts or levels"
                )


def typical_names(grammar: Grammar) -> dict[str, tuple[float, str]]:
    """The values that ``let`` gives names when nothing is drawn, with their units."""
    names: dict[str, tuple[float, str]] = {}
    for let in grammar.lets:
        names[let.name] = evaluate(let.expression, Scope(names, no_draw, ""))
    return names


@dataclass
class _Script(FirstChooser):
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


def _structures(grammar: Grammar, library: Library, max_parts: int) -> Iterator[Derivation | None]:
    """What every list of decisions leads to; None where that is too large."""
    decisions: list[int] = []
    known = Known(fewest=_fewest(_possible(grammar)))
    while True:
        script = _Script(decisions)
        try:
            derivation = derive(grammar, library, script, max_parts, known)
        except TooManyPartsError:
            derivation = None
        yield derivation
        decisions = (decisions + [0] * len(script.options))[: len(script.options)]
        while decisions and decisions[-1] + 1 >= script.options[len(decisions) - 1]:
            decisions.pop()
        if not decisions:
            return
        decisions[-1] += 1


def _fewest(possible: Mapping[str, Sequence[Alternative]]) -> dict[str, int]:
    """Fewest parts of each symbol; ``MAX_PARTS + 1`` stands for any larger number."""
    fewest = dict.fromkeys(possible, MAX_PARTS + 1)
    changed = True
    while changed:
        changed = False
        for symbol, alternatives in possible.items():
            least = min(
                (fewest_parts(alternative, fewest) for alternative in alternatives),
                default=MAX_PARTS + 1,
            )
            if least < fewest[symbol]:
                fewest[symbol] = least
                changed = True
    return fewest


def _graph(grammar: Grammar, used: Mapping[str, Sequence[Alternative]]) -> dict[str, set[str]]:
    """The symbols that each symbol's alternatives hold, for those that the start leads to."""
    graph: dict[str, set[str]] = {}
    fresh = [grammar.start]
    while fresh:
        symbol = fresh.pop()
        if symbol not in graph:
            items = (item.name for alternative in used[symbol] for item in alternative.items)
            graph[symbol] = {name for name in items if name in used}
            fresh += graph[symbol]
    return graph


def _sequences(alternative: Alternative, counts: Mapping[str, int]) -> int:
    """Structures of an alternative, exact up to ``MAX_COUNT``."""
    product = 1
    for item in alternative.items:
        low, high = item.repetition or (1, 1)
        power, total = 1, 0
        for n in range(1, high + 1):
            power = _bounded(power * counts.get(item.name, 1))
            total += power if n >= low else 0
        product = _bounded(product * total)
    return product


def _bounded(number: int) -> int:
    return number if number <= MAX_COUNT else MAX_COUNT + 1


def _possible(grammar: Grammar) -> dict[str, list[Alternative]]:
    """Alternatives of each symbol whose weight is not zero where values are typical."""
    scope = Scope(typical_names(grammar), no_draw, "")
    return {
        production.symbol: [
            alternative
            for alternative in production.alternatives
            if alternative.weight is None or evaluate(alternative.weight, scope)[0] > 0
        ]
        for production in grammar.productions
    }

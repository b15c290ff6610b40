"""From a grammar to a derivation, one choice after the other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from morphgen.errors import GrammarError, PartError, nearest
from morphgen.formats.rounding import format_number
from morphgen.grammar.choosers import Chooser
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.limits import MAX_PARTS
from morphgen.grammar.manifest import Manifest
from morphgen.grammar.parameters import MOUNT_YAW, Parameter, require_range
from morphgen.grammar.syntax import Alternative, Expression, Item, Production
from morphgen.grammar.values import Distribution, Scope, evaluate, no_draw

MAIN_PORTS = ("top", "flange", "end")
"""Ports where the next part goes when none is named."""


@dataclass
class _Node:
    """A part under construction."""

    label: str
    part: str
    values: dict[str, float]
    ports: tuple[str, ...]
    children: list[tuple[str, _Node]] = field(default_factory=list)

    def frozen(self) -> Derivation:
        return Derivation(
            self.label,
            self.part,
            tuple(self.values.items()),
            tuple((port, child.frozen()) for port, child in self.children),
        )


@dataclass(frozen=True)
class Known:
    """What derivations of one grammar with the same values of ``let`` share."""

    weights: dict[str, list[float]] = field(default_factory=dict)
    """Weights of each symbol's alternatives, as far as they were needed."""
    fewest: Mapping[str, int] = field(default_factory=dict)
    """Fewest parts of each symbol; with them a derivation is given up as early as it can be."""


class TooManyPartsError(GrammarError):
    """A derivation has more parts than allowed."""


def derive(
    grammar: Grammar,
    library: Library,
    chooser: Chooser,
    max_parts: int = MAX_PARTS,
    known: Known | None = None,
) -> Derivation:
    """Rewrite the start symbol until only parts are left.

    Args:
        grammar: The grammar.
        library: Where its parts are.
        chooser: Decides alternatives, counts and values.
        max_parts: Parts beyond which the derivation is given up.
        known: What earlier derivations with the same values of ``let`` found out.

    Raises:
        GrammarError: If a name is unknown, a port is missing or taken, a value does not fit its
            parameter, or the derivation does not end (``EndlessError``); the message says where in
            the grammar.
    """
    return _Run(grammar, library, chooser, max_parts, known or Known()).tree().frozen()


class _Run:
    """One derivation."""

    def __init__(
        self,
        grammar: Grammar,
        library: Library,
        chooser: Chooser,
        max_parts: int,
        known: Known,
    ) -> None:
        self._grammar, self._library, self._chooser = grammar, library, chooser
        self._max_parts = max_parts
        self._known = known
        self._pending = known.fewest.get(grammar.start, 0)
        """Fewest parts that are still to come."""
        self._labels: set[str] = set()
        self._names: dict[str, tuple[float, str]] = {}
        for let in grammar.lets:
            scope = Scope(self._names, chooser.value, f"let {let.name}")
            self._names[let.name] = evaluate(let.expression, _counted(scope))

    def tree(self) -> _Node:
        start = self._grammar.production(self._grammar.start)
        if start is None:
            symbols = [production.symbol for production in self._grammar.productions]
            raise GrammarError(
                f"grammar {self._grammar.name!r} has no symbol {self._grammar.start!r}"
                + nearest(self._grammar.start, symbols)
            )
        first, _ = self._sequence(self._alternative(start, start.symbol), "", start.symbol, 0)
        if MOUNT_YAW.name in first.values:
            raise GrammarError(
                f"{start.location}: {first.part!r} stands on no port: it has no {MOUNT_YAW.name}"
            )
        return first

    def _expand(
        self, item: Item, label: str, prefix: str, key: str, depth: int
    ) -> tuple[_Node, _Node]:
        """Rewrite one item; return its first part and the one where it goes on.

        A single part takes the label; of several, each takes its own name after the prefix.
        """
        production = self._grammar.production(item.name)
        if production is None:
            node = self._part(item, label, key)
            return node, node
        if item.arguments:
            raise GrammarError(
                f"{item.location}: {item.name!r} is a symbol and takes no parameters"
            )
        if depth > MAX_PARTS:
            raise TooManyPartsError(
                f"{item.location}: {item.name!r} does not end: {depth} levels deep"
            )
        alternative = self._alternative(production, key)
        if len(alternative.items) == 1:
            (only,) = alternative.items
            if only.repetition is None and not only.port:
                return self._expand(only, label, prefix, f"{key}/{only.name}", depth + 1)
        return self._sequence(alternative, prefix, key, depth)

    def _sequence(
        self, alternative: Alternative, prefix: str, key: str, depth: int
    ) -> tuple[_Node, _Node]:
        ends: list[tuple[_Node, _Node]] = []
        trunk: _Node | None = None
        for position, item in enumerate(alternative.items):
            limb = f"{prefix}{item.port}_" if item.port else prefix
            below = f"{key}/{position}.{item.name}"
            for label, inner, place in self._repeated(item, limb, below):
                first, last = self._expand(item, label, inner, place, depth + 1)
                ends.append((first, last))
                if trunk is not None:
                    _attach(trunk, first, item)
                if trunk is None or not item.port:
                    trunk = last
        return ends[0][0], trunk or ends[0][1]

    def _repeated(self, item: Item, prefix: str, key: str) -> list[tuple[str, str, str]]:
        """(label of a single part, prefix of several, key) of every repetition."""
        if item.repetition is None:
            return [(prefix + item.name, prefix, key)]
        low, high = item.repetition
        n = low if low == high else self._chooser.count(f"{key}#", low, high)
        if fewest := self._known.fewest:
            self._expect((n - low) * fewest.get(item.name, 1), item)
        names = [f"{prefix}{item.name}{i}" for i in range(1, n + 1)]
        return [(name, f"{name}_", f"{key}[{i}]") for i, name in enumerate(names, start=1)]

    def _alternative(self, production: Production, key: str) -> Alternative:
        weights = self._known.weights.get(production.symbol)
        if weights is None:
            weights = self._known.weights[production.symbol] = self._weighed(production, key)
        index = self._chooser.alternative(key, weights) if len(weights) > 1 else 0
        alternative = production.alternatives[index]
        if fewest := self._known.fewest:
            self._expect(fewest_parts(alternative, fewest) - fewest[production.symbol], production)
        return alternative

    def _expect(self, more: int, where: Item | Production) -> None:
        """Count parts to come; give up if there will be too many."""
        self._pending += more
        if len(self._labels) + self._pending > self._max_parts:
            raise TooManyPartsError(
                f"{where.location}: more than {self._max_parts} parts: does it end?"
            )

    def _weighed(self, production: Production, key: str) -> list[float]:
        weights = []
        for alternative in production.alternatives:
            weight = 1.0
            if alternative.weight is not None:
                scope = Scope(self._names, no_draw, key)
                weight = evaluate(alternative.weight, scope)[0]
                if weight < 0:
                    raise GrammarError(
                        f"{alternative.weight.location}: a weight is negative: {weight:g}"
                    )
            weights.append(weight)
        if not math.isfinite(sum(weights)):
            raise GrammarError(
                f"{production.location}: the weights of {production.symbol!r} sum to no finite "
                "number"
            )
        if sum(weights) <= 0:
            raise GrammarError(
                f"{production.location}: all weights of {production.symbol!r} are zero"
            )
        return weights

    def _part(self, item: Item, label: str, key: str) -> _Node:
        manifest = require_part(item, self._grammar, self._library)
        parameters = attached_parameters(manifest)
        values = {name: parameter.default for name, parameter in parameters.items()}
        for name, expression in item.arguments:
            scope = _counted(Scope(self._names, self._chooser.value, f"{key}.{name}"))
            values[name] = argument(item, name, expression, parameters, scope)
        if values[MOUNT_YAW.name] == 0.0:
            del values[MOUNT_YAW.name]
        node = _Node(self._free(label), item.name, values, tuple(manifest.ports))
        self._pending -= 1
        if len(self._labels) > self._max_parts:
            raise TooManyPartsError(
                f"{item.location}: more than {self._max_parts} parts: does it end?"
            )
        return node

    def _free(self, label: str) -> str:
        free, k = label, 1
        while free in self._labels:
            k += 1
            free = f"{label}_{k}"
        self._labels.add(free)
        return free


def fewest_parts(alternative: Alternative, fewest: Mapping[str, int]) -> int:
    """The fewest parts of an alternative, given those of each symbol."""
    return sum(
        (item.repetition or (1, 1))[0] * fewest.get(item.name, 1) for item in alternative.items
    )


def require_part(item: Item, grammar: Grammar, library: Library) -> Manifest:
    """The manifest of an item that is no symbol.

    Raises:
        GrammarError: If it is no part either.
    """
    if item.name not in library.paths:
        valid = [*(production.symbol for production in grammar.productions), *library.paths]
        raise GrammarError(
            f"{item.location}: {item.name!r} is neither a symbol nor a part"
            + nearest(item.name, valid)
        )
    return library.manifest(item.name)


def attached_parameters(manifest: Manifest) -> dict[str, Parameter]:
    """Parameters of a part in a tree: its own, and the turn of its mount."""
    return {**manifest.parameters, MOUNT_YAW.name: MOUNT_YAW}


def argument(
    item: Item,
    name: str,
    expression: Expression,
    parameters: Mapping[str, Parameter],
    scope: Scope,
) -> float:
    """The value of an item's argument.

    Raises:
        GrammarError: If there is no such parameter, or the value is of another unit or out of
            range.
    """
    if name not in parameters:
        raise GrammarError(
            f"{expression.location}: {item.name!r} has no parameter {name!r}"
            + nearest(name, parameters)
        )
    parameter = parameters[name]
    value, unit = evaluate(expression, scope)
    if unit and unit != parameter.unit:
        raise GrammarError(
            f"{expression.location}: {name} is in {parameter.unit or 'pure numbers'}, "
            f"{expression} in {unit}"
        )
    try:
        return require_range(float(format_number(value)), parameter, f"{item.name}.{name}")
    except PartError as error:
        raise GrammarError(f"{expression.location}: {error}") from error


def _counted(scope: Scope) -> Scope:
    """A scope whose second and later distributions of one expression have keys of their own."""
    calls = 0

    def draw(key: str, distribution: Distribution) -> float:
        nonlocal calls
        calls += 1
        return scope.draw(key if calls == 1 else f"{key}~{calls}", distribution)

    return Scope(scope.names, draw, scope.key)


def _attach(trunk: _Node, node: _Node, item: Item) -> None:
    port = item.port or _main_port(trunk, item)
    if port not in trunk.ports:
        raise GrammarError(
            f"{item.location}: {trunk.part!r} has no port {port!r}{nearest(port, trunk.ports)}"
        )
    if any(port == taken for taken, _ in trunk.children):
        raise GrammarError(f"{item.location}: port {port!r} of {trunk.part!r} is taken already")
    trunk.children.append((port, node))


def _main_port(trunk: _Node, item: Item) -> str:
    for port in MAIN_PORTS:
        if port in trunk.ports:
            return port
    if len(trunk.ports) == 1:
        return trunk.ports[0]
    if not trunk.ports:
        raise GrammarError(f"{item.location}: nothing can go on {trunk.part!r}: it has no port")
    raise GrammarError(
        f"{item.location}: say on which port of {trunk.part!r}, such as "
        f"{trunk.ports[0]}:{item.name}; ports: {', '.join(trunk.ports)}"
    )

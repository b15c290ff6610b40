"""Derive robots from a grammar: rewrite its start symbol until only parts are left."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

import numpy as np

from morphgen.errors import GrammarError, PartError, nearest
from morphgen.formats.rounding import format_number
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW, Manifest, Parameter, require_range
from morphgen.grammar.syntax import MAX_PARTS, Alternative, Derivation, Expression, Item, Production
from morphgen.grammar.values import Distribution, Scope, evaluate, typical_value
from morphgen.model.tree import take_name

Choices = Mapping[str, float]
"""Choices of a derivation by their keys: an alternative's index, a count or a value in SI units."""


class Chooser:
    """Makes the choices that a grammar leaves open, without chance; the key names the choice."""

    def alternative(self, key: str, weights: list[float]) -> int:
        """Return the index of an alternative: the first one with a positive weight."""
        return next(i for i, weight in enumerate(weights) if weight > 0)

    def count(self, key: str, low: int, high: int) -> int:
        """Return a number of repetitions: the smallest."""
        return low

    def value(self, key: str, distribution: Distribution) -> float:
        """Return a value of a distribution: the typical one."""
        return distribution.typical


class RandomChooser(Chooser):
    """Draws every choice from a random generator, and keeps them as a file would hold them."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.choices: dict[str, float] = {}

    def alternative(self, key: str, weights: list[float]) -> int:
        """Draw an index with probabilities proportional to the weights."""
        total = np.cumsum(weights)
        index = int(np.searchsorted(total, self._rng.random() * total[-1], side="right"))
        # The product may round up to the total, which is beyond the last positive weight.
        return int(self._record(key, min(index, int(np.flatnonzero(weights)[-1]))))

    def count(self, key: str, low: int, high: int) -> int:
        """Draw a count uniformly."""
        return int(self._record(key, int(self._rng.integers(low, high + 1))))

    def value(self, key: str, distribution: Distribution) -> float:
        """Draw a value from the distribution."""
        drawn = distribution.draw(self._rng.random, self._rng.standard_normal)
        return self._record(key, float(format_number(drawn)))

    def _record(self, key: str, value: float) -> float:
        if key in self.choices:
            raise GrammarError(f"two choices share the key {key!r}")
        self.choices[key] = value
        return value


DEFAULT_PORTS = ("top", "flange", "end")
"""Ports that the next part is attached to when none is named; the first one that exists."""


@dataclass
class _Node:
    """A part of an unfinished derivation."""

    label: str  # prefix of the part's names in the robot, unique in the derivation
    part: str
    values: dict[str, float]  # parameters of the part in SI units
    ports: tuple[str, ...]
    children: list[tuple[str, _Node]] = field(default_factory=list)  # (port, part attached to it)

    def derivation(self) -> Derivation:
        children = tuple((port, child.derivation()) for port, child in self.children)
        return Derivation(self.label, self.part, tuple(self.values.items()), children)


class TooManyPartsError(GrammarError):
    """A derivation has more parts than allowed."""


def derive(grammar: Grammar, library: Library, chooser: Chooser) -> Derivation:
    """Rewrite the start symbol of a grammar until only parts are left."""
    return _Run(grammar, library, chooser).root().derivation()


@dataclass
class _Run:
    """One derivation.

    Every random choice has a key that names its position in the derivation, such as
    ``robot/1.arm/panda.size``, so that it can be recorded and repeated.
    """

    _grammar: Grammar
    _library: Library
    _chooser: Chooser
    _labels: set[str] = field(default_factory=set)
    _names: dict[str, tuple[float, str]] = field(default_factory=dict)  # values of ``let``
    _weights: dict[str, list[float]] = field(default_factory=dict)
    """Weights of the alternatives by symbol."""

    def __post_init__(self) -> None:
        for let in self._grammar.lets:
            scope = Scope(self._names, self._chooser.value, f"let {let.name}")
            self._names[let.name] = evaluate(let.expression, _with_unique_keys(scope))

    def root(self) -> _Node:
        start = self._grammar.production(self._grammar.start)
        assert start  # the symbol of a production
        first, _ = self._sequence(self._alternative(start, start.symbol), "", start.symbol, 0)
        require_no_yaw(first.part, first.values.get(MOUNT_YAW, 0.0), start.location)
        return first

    def _expand(
        self, item: Item, label: str, prefix: str, key: str, depth: int
    ) -> tuple[_Node, _Node]:
        """Rewrite one item; return its first part and the part that the next item attaches to."""
        production = self._grammar.production(item.name)
        if production is None:
            node = self._part(item, label, key)
            return node, node
        require_no_arguments(item)
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
        """Rewrite and attach the items of an alternative; return values as of ``_expand``."""
        root: _Node | None = None
        trunk: _Node | None = None
        for position, item in enumerate(alternative.items):
            limb_prefix = f"{prefix}{item.port}_" if item.port else prefix
            item_key = f"{key}/{position}.{item.name}"
            for label, inner_prefix, copy_key in self._copies(item, limb_prefix, item_key):
                first, last = self._expand(item, label, inner_prefix, copy_key, depth + 1)
                root = root or first
                if trunk is not None:
                    _attach(trunk, first, item)
                if trunk is None or not item.port:
                    trunk = last
        assert root  # the syntax requires an item
        assert trunk
        return root, trunk

    def _copies(self, item: Item, prefix: str, key: str) -> list[tuple[str, str, str]]:
        """Return (label if it is a single part, prefix if it is several, key) of each copy."""
        if item.repetition is None:
            return [(prefix + item.name, prefix, key)]
        low, high = item.repetition
        n = low if low == high else self._chooser.count(f"{key}#", low, high)
        names = [f"{prefix}{item.name}{i}" for i in range(1, n + 1)]
        return [(name, f"{name}_", f"{key}[{i}]") for i, name in enumerate(names, start=1)]

    def _alternative(self, production: Production, key: str) -> Alternative:
        if production.symbol not in self._weights:
            scope = Scope(self._names, typical_value, key)
            self._weights[production.symbol] = production_weights(production, scope)
        weights = self._weights[production.symbol]
        return production.alternatives[
            self._chooser.alternative(key, weights) if len(weights) > 1 else 0
        ]

    def _part(self, item: Item, label: str, key: str) -> _Node:
        manifest = require_part(item, self._grammar, self._library)
        parameters = manifest.attached_parameters
        values = {name: parameter.default for name, parameter in parameters.items()}
        for name, expression in item.arguments:
            scope = _with_unique_keys(Scope(self._names, self._chooser.value, f"{key}.{name}"))
            values[name] = argument(item, name, expression, parameters, scope)
        if values[MOUNT_YAW] == 0.0:
            del values[MOUNT_YAW]  # derivations from before the parameter existed stay equal
        node = _Node(take_name(label, self._labels), item.name, values, tuple(manifest.ports))
        if len(self._labels) > MAX_PARTS:
            raise TooManyPartsError(f"{item.location}: more than {MAX_PARTS} parts: does it end?")
        return node


def production_weights(production: Production, scope: Scope) -> list[float]:
    """Return the weights of a symbol's alternatives, of which one at least is positive."""
    weights = []
    for expression in (alternative.weight for alternative in production.alternatives):
        weight = 1.0 if expression is None else evaluate(expression, scope)[0]
        if expression is not None and weight < 0:
            raise GrammarError(f"{expression.location}: a weight is negative: {weight:g}")
        weights.append(weight)
    total, symbol = sum(weights), repr(production.symbol)
    if not math.isfinite(total):
        raise GrammarError(f"{production.location}: the sum of weights of {symbol} is infinite")
    if total <= 0:
        raise GrammarError(f"{production.location}: all weights of {symbol} are zero")
    return weights


def require_no_arguments(symbol: Item) -> None:
    """Require that an item that names a symbol has no parameters."""
    if symbol.arguments:
        raise GrammarError(
            f"{symbol.location}: {symbol.name!r} is a symbol and takes no parameters"
        )


def require_no_yaw(part: str, yaw: float, location: object) -> None:
    """Require that the first part of a robot is not turned about a port."""
    if yaw:
        raise GrammarError(f"{location}: {part!r} is not attached to a port: it has no {MOUNT_YAW}")


def require_part(item: Item, grammar: Grammar, library: Library) -> Manifest:
    """Return the manifest of an item that is not a symbol."""
    if item.name not in library.paths:
        valid = [*(production.symbol for production in grammar.productions), *library.paths]
        raise GrammarError(
            f"{item.location}: {item.name!r} is neither a symbol nor a part"
            + library.nearest_part(item.name, valid)
        )
    return library.manifest(item.name)


def argument(
    item: Item, name: str, expression: Expression, parameters: Mapping[str, Parameter], scope: Scope
) -> float:
    """Return the value of an item's argument in SI units."""
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


def _with_unique_keys(scope: Scope) -> Scope:
    """Return a scope that gives each distribution of one expression its own key."""
    calls = 0

    def draw(key: str, distribution: Distribution) -> float:
        nonlocal calls
        calls += 1
        return scope.draw(key if calls == 1 else f"{key}~{calls}", distribution)

    return Scope(scope.names, draw, scope.key)


def _attach(trunk: _Node, node: _Node, item: Item) -> None:
    port = free_port(trunk.part, trunk.ports, dict(trunk.children), item)
    trunk.children.append((port, node))


def free_port(part: str, ports: Collection[str], taken: Collection[str], item: Item) -> str:
    """Return the port of a part that an item is attached to."""
    port, where = item.port or _default_port(part, ports, item), item.location
    if port not in ports:
        raise GrammarError(f"{where}: {part!r} has no port {port!r}{nearest(port, ports)}")
    if port in taken:
        raise GrammarError(f"{where}: port {port!r} of {part!r} is already taken")
    return port


def _default_port(part: str, ports: Collection[str], item: Item) -> str:
    default = [port for port in DEFAULT_PORTS if port in ports]
    if default or len(ports) == 1:
        return (*default, *ports)[0]
    if not ports:
        raise GrammarError(f"{item.location}: nothing can be attached to {part!r}: it has no port")
    raise GrammarError(
        f"{item.location}: name the port of {part!r}, such as "
        f"{next(iter(ports))}:{item.name}; ports: {', '.join(ports)}"
    )

"""Values of expressions: arithmetic, units and distributions."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from morphgen.errors import GrammarError
from morphgen.grammar.parameters import UNITS
from morphgen.grammar.syntax import Expression, unknown


@dataclass(frozen=True)
class Distribution:
    """What a value is drawn from."""

    kind: str
    """One of ``DISTRIBUTIONS``."""
    arguments: tuple[float, ...]
    """SI units: (low, high); (mean, deviation, low, high) of ``normal``; the choices."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value that can come out."""
        if self.kind == "normal":
            return (self.arguments[2], self.arguments[3])
        return (min(self.arguments), max(self.arguments))

    @property
    def is_continuous(self) -> bool:
        """Whether there is no list of its values."""
        return self.kind in ("uniform", "loguniform", "normal")

    @property
    def typical(self) -> float:
        """The value taken when nothing is drawn: the median, or the first choice."""
        low, high = self.bounds
        match self.kind:
            case "uniform":
                return (low + high) / 2
            case "loguniform":
                return math.sqrt(low * high)
            case "normal":
                return min(max(self.arguments[0], low), high)
            case "choice":
                return self.arguments[0]
            case _:
                return low

    def nearest(self, value: float) -> float | None:
        """What it can give that is ``value`` to 11 digits; None if there is nothing."""
        low, high = self.bounds
        match self.kind:
            case "choice":
                found = min(self.arguments, key=lambda choice: abs(choice - value))
            case "randint":
                found = min(max(round(value), low), high)
            case _:
                found = min(max(value, low), high)
        return found if math.isclose(found, value, rel_tol=1e-11, abs_tol=1e-12) else None

    def draw(self, uniform: Callable[[], float], normal: Callable[[], float]) -> float:
        """Draw a value.

        Args:
            uniform: Draws from [0, 1).
            normal: Draws from the standard normal distribution.
        """
        low, high = self.bounds
        match self.kind:
            case "uniform":
                return low + (high - low) * uniform()
            case "loguniform":
                return float(low * (high / low) ** uniform())
            case "normal":
                mean, deviation = self.arguments[:2]
                return min(max(mean + deviation * normal(), low), high)
            case "choice":
                return self.arguments[int(uniform() * len(self.arguments))]
            case _:
                return low + math.floor(uniform() * (high - low + 1))


DISTRIBUTIONS: Mapping[str, str] = {
    "uniform": "low, high",
    "loguniform": "low, high",
    "normal": "mean, deviation, low, high",
    "choice": "value, ...",
    "randint": "low, high",
}
"""What each distribution takes; ``normal`` is clipped, ``randint`` includes both ends."""


class Draw(Protocol):
    """Decides the value of a distribution at a point of the derivation."""

    def __call__(self, key: str, distribution: Distribution) -> float:
        """Return a value that the distribution can give."""


@dataclass(frozen=True)
class Scope:
    """What names mean, and how distributions are decided."""

    names: Mapping[str, tuple[float, str]]
    """Values in SI units and their units; an empty unit for pure numbers."""
    draw: Draw
    key: str
    """Where in the derivation the expression stands."""


def evaluate(expression: Expression, scope: Scope) -> tuple[float, str]:
    """Value of an arithmetic expression.

    Args:
        expression: The expression.
        scope: Names and decisions.

    Returns:
        The value in SI units, and its unit: ``m``, ``rad``, ``kg`` or empty for a pure number.

    Raises:
        GrammarError: If a name, function or unit is unknown, units do not fit, or the result is
            not finite.
    """
    value, unit = _evaluate(expression, scope)
    if not math.isfinite(value):
        raise GrammarError(f"{expression.location}: {expression} is not finite")
    return value, unit


def distribution_of(expression: Expression, scope: Scope) -> tuple[Distribution, str]:
    """The distribution that a call names, and the unit of its values.

    Raises:
        GrammarError: If there is no such distribution or its arguments do not fit.
    """
    kind, location = expression.text, expression.location
    if kind not in DISTRIBUTIONS:
        raise unknown("distribution", kind, location, list(DISTRIBUTIONS))
    operands = [evaluate(operand, scope) for operand in expression.operands]
    units = {unit for _, unit in operands if unit}
    if len(units) > 1:
        raise GrammarError(f"{location}: {expression} mixes units {' and '.join(sorted(units))}")
    distribution = Distribution(kind, tuple(value for value, _ in operands))
    _require_arguments(distribution, expression)
    return distribution, units.pop() if units else ""


def _evaluate(expression: Expression, scope: Scope) -> tuple[float, str]:
    location = expression.location
    match expression.operator:
        case "number":
            return _quantity(expression)
        case "name":
            if expression.text not in scope.names:
                raise unknown("value", expression.text, location, list(scope.names))
            return scope.names[expression.text]
        case "call":
            distribution, unit = distribution_of(expression, scope)
            return scope.draw(scope.key, distribution), unit
        case "negative":
            value, unit = evaluate(expression.operands[0], scope)
            return -value, unit
        case "+" | "-" | "*" | "/":
            left, right = (evaluate(operand, scope) for operand in expression.operands)
            return _arithmetic(expression, left, right)
        case _:
            raise GrammarError(f"{location}: {expression} is a condition, not a value")


def _quantity(expression: Expression) -> tuple[float, str]:
    if not expression.text:
        return expression.value, ""
    if expression.text not in UNITS:
        raise unknown("unit", expression.text, expression.location, list(UNITS))
    unit, scale = UNITS[expression.text]
    return expression.value * scale, unit


def _arithmetic(
    expression: Expression, left: tuple[float, str], right: tuple[float, str]
) -> tuple[float, str]:
    (a, a_unit), (b, b_unit) = left, right
    match expression.operator:
        case "+" | "-":
            if a_unit and b_unit and a_unit != b_unit:
                raise GrammarError(
                    f"{expression.location}: {expression} mixes units {a_unit} and {b_unit}"
                )
            return (a + b if expression.operator == "+" else a - b), a_unit or b_unit
        case "*":
            if a_unit and b_unit:
                raise GrammarError(
                    f"{expression.location}: {expression} multiplies {a_unit} by {b_unit}; "
                    "values are lengths, angles, masses or pure numbers"
                )
            return a * b, a_unit or b_unit
        case _:
            if b == 0:
                raise GrammarError(f"{expression.location}: {expression} divides by zero")
            if b_unit and a_unit != b_unit:
                raise GrammarError(
                    f"{expression.location}: {expression} divides {a_unit or 'a pure number'} by "
                    f"{b_unit}; values are lengths, angles, masses or pure numbers"
                )
            return a / b, "" if b_unit else a_unit


def _require_arguments(distribution: Distribution, expression: Expression) -> None:
    given, location = distribution.arguments, expression.location
    signature = f"{distribution.kind}({DISTRIBUTIONS[distribution.kind]})"
    wanted = {"choice": None, "normal": 4}.get(distribution.kind, 2)
    if (wanted is not None and len(given) != wanted) or not given:
        raise GrammarError(f"{location}: {expression} does not fit {signature}")
    low, high = distribution.bounds
    ordered = given[-2] <= given[-1] if wanted is not None else True
    if not ordered:
        raise GrammarError(f"{location}: {expression}: low is above high in {signature}")
    if not math.isfinite(high - low) or (low > 0 and not math.isfinite(high / low)):
        raise GrammarError(f"{location}: {expression}: {low:g} and {high:g} are too far apart")
    if distribution.kind == "loguniform" and low <= 0:
        raise GrammarError(f"{location}: {expression}: low must be above zero")
    if distribution.kind == "normal" and given[1] < 0:
        raise GrammarError(f"{location}: {expression}: the deviation is negative")
    if distribution.kind == "randint" and (low != int(low) or high != int(high)):
        raise GrammarError(f"{location}: {expression}: randint needs whole numbers")


def no_draw(key: str, distribution: Distribution) -> float:
    """Decide every distribution by its typical value."""
    del key
    return distribution.typical

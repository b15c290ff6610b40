"""Evaluate expressions: arithmetic, units and distributions."""

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
    """Probability distribution of a value."""

    kind: str
    """One of ``DISTRIBUTIONS``."""
    arguments: tuple[float, ...]
    """Arguments as in ``DISTRIBUTIONS``, in SI units."""

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible value."""
        if self.kind == "normal":
            return (self.arguments[2], self.arguments[3])
        return (min(self.arguments), max(self.arguments))

    @property
    def is_continuous(self) -> bool:
        """Whether the possible values form an interval."""
        return self.kind in ("uniform", "loguniform", "normal")

    @property
    def typical(self) -> float:
        """Value used without random draws: the median, the first choice or the least integer."""
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

    def closest(self, value: float) -> float | None:
        """Return the possible value that equals ``value`` to 11 digits, or None."""
        low, high = self.bounds
        if self.kind == "choice":
            closest = min(self.arguments, key=lambda choice: abs(choice - value))
        else:
            closest = min(max(round(value) if self.kind == "randint" else value, low), high)
        return closest if math.isclose(closest, value, rel_tol=1e-11, abs_tol=1e-12) else None

    def draw(self, uniform: Callable[[], float], normal: Callable[[], float]) -> float:
        """Draw a value.

        Args:
            uniform: Returns a uniform sample of [0, 1).
            normal: Returns a sample of the standard normal distribution.
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
"""Arguments of each distribution; ``normal`` is clipped, ``randint`` includes both bounds."""


class Draw(Protocol):
    """Selects the value of a distribution."""

    def __call__(self, key: str, distribution: Distribution) -> float:
        """Return a possible value; the key names the random choice in the derivation."""


@dataclass(frozen=True)
class Scope:
    """Everything that the value of an expression depends on."""

    names: Mapping[str, tuple[float, str]]
    """Values of names in SI units, with their units; the unit of a pure number is empty."""
    draw: Draw
    key: str
    """Key of the expression in the derivation; it is passed to ``draw``."""


def evaluate(expression: Expression, scope: Scope) -> tuple[float, str]:
    """Evaluate an arithmetic expression.

    Returns:
        The value in SI units, and its unit: ``m``, ``rad``, ``kg`` or empty for a pure number.

    Raises:
        GrammarError: If a name, function or unit is unknown, units do not match, or the result is
            not finite.
    """
    value, unit = _evaluate(expression, scope)
    if not math.isfinite(value):
        raise GrammarError(f"{expression.location}: {expression} is not finite")
    return value, unit


def distribution_of(expression: Expression, scope: Scope) -> tuple[Distribution, str]:
    """Return the distribution that a call expression names, and the unit of its values.

    Raises:
        GrammarError: If the distribution is unknown or its arguments are invalid.
    """
    kind = expression.text
    if kind not in DISTRIBUTIONS:
        raise unknown("distribution", kind, expression.location, DISTRIBUTIONS)
    operands = [evaluate(operand, scope) for operand in expression.operands]
    units = {unit for _, unit in operands if unit}
    if len(units) > 1:
        raise _error(expression, f"mixes units {' and '.join(sorted(units))}")
    distribution = Distribution(kind, tuple(value for value, _ in operands))
    _require_arguments(distribution, expression)
    return distribution, units.pop() if units else ""


def _evaluate(expression: Expression, scope: Scope) -> tuple[float, str]:
    """Return the value, which may be infinite or NaN, and the unit of an expression."""
    match expression.operator:
        case "number":
            return _quantity(expression)
        case "name":
            if expression.text not in scope.names:
                raise unknown("value", expression.text, expression.location, scope.names)
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
            raise _error(expression, "is a condition, not a value")


def _quantity(expression: Expression) -> tuple[float, str]:
    """Return a number with a unit in SI units."""
    if not expression.text:
        return expression.value, ""
    if expression.text not in UNITS:
        raise unknown("unit", expression.text, expression.location, UNITS)
    unit, scale = UNITS[expression.text]
    return expression.value * scale, unit


_VALID_UNITS = "values are lengths, angles, masses or pure numbers"


def _arithmetic(
    expression: Expression, left: tuple[float, str], right: tuple[float, str]
) -> tuple[float, str]:
    (a, a_unit), (b, b_unit) = left, right
    match expression.operator:
        case "+" | "-":
            if a_unit and b_unit and a_unit != b_unit:
                raise _error(expression, f"mixes units {a_unit} and {b_unit}")
            return (a + b if expression.operator == "+" else a - b), a_unit or b_unit
        case "*":
            if a_unit and b_unit:
                raise _error(expression, f"multiplies {a_unit} by {b_unit}; {_VALID_UNITS}")
            return a * b, a_unit or b_unit
        case _:
            if b == 0:
                raise _error(expression, "divides by zero")
            if b_unit and a_unit != b_unit:
                dividend = a_unit or "a pure number"
                raise _error(expression, f"divides {dividend} by {b_unit}; {_VALID_UNITS}")
            return a / b, "" if b_unit else a_unit


def _require_arguments(distribution: Distribution, expression: Expression) -> None:
    arguments, kind = distribution.arguments, distribution.kind
    signature = f"{kind}({DISTRIBUTIONS[kind]})"
    expected = {"choice": None, "normal": 4}.get(kind, 2)
    if (expected is not None and len(arguments) != expected) or not arguments:
        raise _error(expression, f"does not fit {signature}")
    low, high = distribution.bounds
    if expected is not None and arguments[-2] > arguments[-1]:
        raise _error(expression, f"low is above high in {signature}", ": ")
    if not math.isfinite(high - low) or (low > 0 and not math.isfinite(high / low)):
        raise _error(expression, f"{low:g} and {high:g} are too far apart", ": ")
    if kind == "loguniform" and low <= 0:
        raise _error(expression, "low must be above zero", ": ")
    if kind == "normal" and arguments[1] < 0:
        raise _error(expression, "the deviation is negative", ": ")
    if kind == "randint" and (low != int(low) or high != int(high)):
        raise _error(expression, "randint needs whole numbers", ": ")


def _error(expression: Expression, text: str, separator: str = " ") -> GrammarError:
    return GrammarError(f"{expression.location}: {expression}{separator}{text}")


def typical_value(key: str, distribution: Distribution) -> float:
    """Return the typical value of a distribution; a ``Draw`` without randomness."""
    del key
    return distribution.typical

"""Evaluate expressions: arithmetic, units and distributions."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property

from morphgen.errors import GrammarError
from morphgen.grammar.manifest import UNITS
from morphgen.grammar.syntax import Expression, parse_condition, unknown
from morphgen.model.inertia import bounding_box, box_corners
from morphgen.model.kinematics import forward_kinematics, reach, reach_from_root
from morphgen.model.robot import Robot


@dataclass(frozen=True)
class Distribution:
    """Probability distribution of a value."""

    kind: str  # one of `DISTRIBUTIONS`
    arguments: tuple[float, ...]  # arguments as in `DISTRIBUTIONS`, in SI units

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest possible value."""
        if self.kind == "normal":
            return (self.arguments[2], self.arguments[3])
        return (min(self.arguments), max(self.arguments))

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

    def draw(self, uniform: Callable[[], float], normal: Callable[[], float]) -> float:
        """Draw a value."""
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
                return self.arguments[int(uniform() * len(self.arguments))]  # uniform() is below 1
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


Draw = Callable[[str, Distribution], float]
"""Selects a possible value of a distribution; the key names the choice in the derivation."""


@dataclass(frozen=True)
class Scope:
    """Everything that the value of an expression depends on."""

    names: Mapping[str, tuple[float, str]]
    """Values of names in SI units, with their units; the unit of a pure number is empty."""
    draw: Draw
    key: str  # key of the expression in the derivation; it is passed to `draw`


def evaluate(expression: Expression, scope: Scope) -> tuple[float, str]:
    """Return the value of an arithmetic expression in SI units, and its unit, empty for none."""
    value, unit = _evaluate(expression, scope)
    if not math.isfinite(value):
        raise GrammarError(f"{expression.location}: {expression} is not finite")
    return value, unit


def distribution_of(expression: Expression, scope: Scope) -> tuple[Distribution, str]:
    """Return the distribution that a call expression names, and the unit of its values."""
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
        case "number" if not expression.text:
            return expression.value, ""
        case "number":
            if expression.text not in UNITS:
                raise unknown("unit", expression.text, expression.location, UNITS)
            unit, scale = UNITS[expression.text]
            return expression.value * scale, unit
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


_COMPARATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


class RobotProperties:
    """Properties of a robot; those that take time are computed when first used."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self.mass = robot.mass  # total mass [kg]
        self.dof = robot.dof  # number of independent joints
        self.links = len(robot.links)  # number of links, including the root
        self.movable = len(robot.movable_joints)  # number of movable joints, including mimic joints

    @cached_property
    def reach(self) -> float:
        """Largest distance of the tool from the first joint that moves it [m]; 0 without a tool."""
        return reach(self._robot) if self._robot.tool else 0.0

    @cached_property
    def reach_from_root(self) -> float:
        """Largest distance of the tool from the root's origin [m]; 0 without a tool."""
        return reach_from_root(self._robot) if self._robot.tool else 0.0

    @cached_property
    def movable_to_tool(self) -> float:
        """Number of movable joints between the root and the tool; 0 without a tool."""
        robot = self._robot
        chain = robot.joint_chain(robot.tool.link) if robot.tool else ()
        return sum(robot.joints[k].is_movable for k in chain)

    @cached_property
    def height(self) -> float:
        """Height of the highest point at home above the root's origin [m]."""
        robot = self._robot
        T_root_link = forward_kinematics(robot, robot.home)
        top = 0.0
        for T, link in zip(T_root_link, robot.links, strict=True):
            if shapes := link.solid_shapes:
                corners = box_corners(*bounding_box(shapes)).T
                top = max(top, float((T[2, :3] @ corners + T[2, 3]).max()))
        return top


PROPERTIES: Mapping[str, str] = {
    "reach": "m",
    "reach_from_root": "m",
    "mass": "kg",
    "dof": "",
    "links": "",
    "movable": "",
    "movable_to_tool": "",
    "height": "m",
}
"""Unit of every property that conditions can use."""


def clauses(condition: Expression) -> Iterator[Expression]:
    """Yield the conditions that are joined by ``and`` at the top level."""
    if condition.operator == "and":
        for operand in condition.operands:
            yield from clauses(operand)
    else:
        yield condition


def holds(condition: Expression, properties: RobotProperties) -> bool:
    """Return whether a robot meets a condition."""
    match condition.operator:
        case "and":
            return all(holds(operand, properties) for operand in condition.operands)
        case "or":
            return any(holds(operand, properties) for operand in condition.operands)
        case "not":
            return not holds(condition.operands[0], properties)
        case sign:
            used = (term.text for term in condition.walk() if term.operator == "name")
            names = {name: (float(getattr(properties, name)), PROPERTIES[name]) for name in used}
            scope = Scope(names, typical_value, "")
            left, right = (evaluate(operand, scope)[0] for operand in condition.operands)
            return _COMPARATORS[sign](left, right)


def parse_conditions(texts: Iterable[str], origin: str) -> list[Expression]:
    """Return the conditions that texts such as ``reach > 0.4`` contain."""
    conditions = [parse_condition(text, origin) for text in texts]
    for condition in conditions:
        require_condition(condition)
    return conditions


def require_condition(expression: Expression) -> None:
    """Require that an expression is a condition on known properties."""
    if expression.operator in ("and", "or", "not"):
        for operand in expression.operands:
            require_condition(operand)
        return
    if expression.operator not in _COMPARATORS:
        raise _error(expression, "is a value; a condition compares, such as mass < 40")
    for term in expression.walk():
        if term.operator == "call":
            raise GrammarError(f"{term.location}: a condition cannot draw values: {term}")
        if term.operator == "name" and term.text not in PROPERTIES:
            raise unknown("property", term.text, term.location, PROPERTIES)
    sample = Scope({name: (1.0, unit) for name, unit in PROPERTIES.items()}, typical_value, "")
    units = {evaluate(operand, sample)[1] for operand in expression.operands}
    if len(units - {""}) > 1:
        raise _error(expression, f"compares {' with '.join(sorted(units))}")

"""Conditions on computed properties of a robot, such as ``reach > 0.4 and dof >= 5``."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property

from morphgen.errors import GrammarError
from morphgen.grammar.syntax import Expression, parse_condition, unknown
from morphgen.grammar.values import Scope, evaluate, typical_value
from morphgen.model.inertia import bounding_box, box_corners
from morphgen.model.kinematics import forward_kinematics, reach
from morphgen.model.robot import TOOL, Robot

_COMPARATORS: Mapping[str, Callable[[float, float], bool]] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


class RobotProperties:
    """Properties of a robot, each computed when first used."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    @cached_property
    def reach(self) -> float:
        """Largest distance of the tool from the root's origin [m]; 0 without a tool."""
        robot = self._robot
        return reach(robot) if any(frame.name == TOOL for frame in robot.frames) else 0.0

    @cached_property
    def mass(self) -> float:
        """Total mass [kg]."""
        return self._robot.mass

    @cached_property
    def dof(self) -> float:
        """Number of independent joints."""
        return self._robot.dof

    @cached_property
    def links(self) -> float:
        """Number of links, including the root."""
        return len(self._robot.links)

    @cached_property
    def movable(self) -> float:
        """Number of movable joints, including mimic joints."""
        return len(self._robot.movable_joints)

    @cached_property
    def movable_to_tool(self) -> float:
        """Number of movable joints between the root and the tool; 0 without a tool."""
        robot = self._robot
        link = next((frame.link for frame in robot.frames if frame.name == TOOL), None)
        chain = [] if link is None else robot.joint_chain(link)
        return sum(robot.joints[k].is_movable for k in chain)

    @cached_property
    def height(self) -> float:
        """Height of the highest point at home above the root's origin [m]."""
        robot = self._robot
        T_root_link = forward_kinematics(robot, robot.home)
        top = 0.0
        for T, link in zip(T_root_link, robot.links, strict=True):
            if shapes := link.collisions or link.visuals:
                corners = box_corners(*bounding_box(shapes)).T
                top = max(top, float((T[2, :3] @ corners + T[2, 3]).max()))
        return top


PROPERTIES: Mapping[str, str] = {
    "reach": "m",
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
            left, right = (_value(operand, properties) for operand in condition.operands)
            return _COMPARATORS[sign](left, right)


def parse_conditions(texts: Iterable[str], origin: str) -> list[Expression]:
    """Return the conditions that texts such as ``reach > 0.4`` contain.

    Args:
        texts: The texts.
        origin: What contains them, for messages, such as ``--where``.

    Raises:
        GrammarError: If one is not a condition on known properties.
    """
    conditions = [parse_condition(text, origin) for text in texts]
    for condition in conditions:
        require_condition(condition)
    return conditions


def require_condition(expression: Expression) -> None:
    """Require that an expression is a condition on known properties.

    Raises:
        GrammarError: If it is not; the message names the location of the fault.
    """
    if expression.operator in ("and", "or", "not"):
        for operand in expression.operands:
            require_condition(operand)
        return
    if expression.operator not in _COMPARATORS:
        raise GrammarError(
            f"{expression.location}: {expression} is a value; a condition compares, such as "
            "mass < 40"
        )
    units = set()
    for operand in expression.operands:
        for name in _names(operand):
            if name.text not in PROPERTIES:
                raise unknown("property", name.text, name.location, PROPERTIES)
        sample = {name: (1.0, unit) for name, unit in PROPERTIES.items()}
        units.add(evaluate(operand, Scope(sample, typical_value, ""))[1])
    if len(units - {""}) > 1:
        raise GrammarError(
            f"{expression.location}: {expression} compares {' with '.join(sorted(units))}"
        )


def _value(expression: Expression, properties: RobotProperties) -> float:
    names = {
        name.text: (float(getattr(properties, name.text)), PROPERTIES[name.text])
        for name in _names(expression)
    }
    return evaluate(expression, Scope(names, typical_value, ""))[0]


def _names(expression: Expression) -> Iterator[Expression]:
    for term in expression.walk():
        if term.operator == "call":
            raise GrammarError(f"{term.location}: a condition cannot draw values: {term}")
        if term.operator == "name":
            yield term

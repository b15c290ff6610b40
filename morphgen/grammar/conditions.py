"""Conditions over computed properties of a robot: ``where reach > 0.4 and dof >= 5``."""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping
from functools import cached_property

import numpy as np

from morphgen.errors import GrammarError
from morphgen.grammar.syntax import Expression, unknown
from morphgen.grammar.values import Scope, evaluate, no_draw
from morphgen.model.inertia import bounding_box
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
    """Properties of a robot, each computed when first asked for."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot

    @cached_property
    def reach(self) -> float:
        """Largest distance of the tool from the root's origin, metres; 0 without a tool."""
        robot = self._robot
        return reach(robot) if any(frame.name == TOOL for frame in robot.frames) else 0.0

    @cached_property
    def mass(self) -> float:
        """Total mass, kg."""
        return self._robot.mass

    @cached_property
    def dof(self) -> float:
        """Independent joints."""
        return self._robot.dof

    @cached_property
    def links(self) -> float:
        """Links, the root among them."""
        return len(self._robot.links)

    @cached_property
    def movable(self) -> float:
        """Joints that move, mimic joints among them."""
        return len(self._robot.movable_joints)

    @cached_property
    def movable_to_tool(self) -> float:
        """Movable joints between the root and the tool; 0 without a tool."""
        robot = self._robot
        link = next((frame.link for frame in robot.frames if frame.name == TOOL), None)
        return (
            0 if link is None else sum(robot.joints[k].is_movable for k in robot.joint_chain(link))
        )

    @cached_property
    def height(self) -> float:
        """Highest point of the shapes at home above the root's origin, metres."""
        robot = self._robot
        T_root_link = forward_kinematics(robot, robot.home)
        top = 0.0
        for T, link in zip(T_root_link, robot.links, strict=True):
            if shapes := link.collisions or link.visuals:
                low, high = bounding_box(shapes)
                corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1)
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
"""What conditions can speak of, and its unit."""


def clauses(condition: Expression) -> Iterator[Expression]:
    """The conditions that ``and`` joins at the top."""
    if condition.operator == "and":
        for operand in condition.operands:
            yield from clauses(operand)
    else:
        yield condition


def holds(condition: Expression, properties: RobotProperties) -> bool:
    """Whether a robot meets a condition."""
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


def require_condition(expression: Expression) -> None:
    """Refuse what is no condition over known properties.

    Raises:
        GrammarError: At the place of what is wrong.
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
                raise unknown("property", name.text, name.location, list(PROPERTIES))
        sample = {name: (1.0, unit) for name, unit in PROPERTIES.items()}
        units.add(evaluate(operand, Scope(sample, no_draw, ""))[1])
    if len(units - {""}) > 1:
        raise GrammarError(
            f"{expression.location}: {expression} compares {' with '.join(sorted(units))}"
        )


def _value(expression: Expression, properties: RobotProperties) -> float:
    names = {
        name.text: (float(getattr(properties, name.text)), PROPERTIES[name.text])
        for name in _names(expression)
    }
    return evaluate(expression, Scope(names, no_draw, ""))[0]


def _names(expression: Expression) -> Iterator[Expression]:
    if expression.operator == "name":
        yield expression
    elif expression.operator == "call":
        raise GrammarError(f"{expression.location}: a condition draws nothing: {expression}")
    for operand in expression.operands:
        yield from _names(operand)

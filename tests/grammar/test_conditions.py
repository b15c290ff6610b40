"""Conditions on the properties of a robot."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.grammars import LIBRARY
from helpers.robots import arm
from morphgen.errors import GrammarError
from morphgen.grammar.compose import join
from morphgen.grammar.request import parse_request
from morphgen.grammar.syntax import parse_condition
from morphgen.grammar.values import (
    PROPERTIES,
    RobotProperties,
    clauses,
    holds,
    require_condition,
)


def true_of(text, robot):
    condition = parse_condition(text)
    require_condition(condition)
    return holds(condition, RobotProperties(robot))


@pytest.fixture(scope="module")
def gantry():
    return join(parse_request(["base=gantry", "ee=cube"], LIBRARY), LIBRARY, "robot")


def test_properties_of_a_robot(gantry):
    properties = RobotProperties(gantry)
    assert (properties.links, properties.dof, properties.movable) == (7, 5, 5)
    assert properties.movable_to_tool == 5
    assert properties.mass == pytest.approx(gantry.mass)


def test_mimic_joints_move_and_are_not_independent():
    properties = RobotProperties(arm())
    assert (properties.links, properties.dof, properties.movable) == (6, 4, 5)
    assert properties.movable_to_tool == 3


def test_height_is_measured_at_the_highest_point_at_home():
    straight = replace(arm(), home=(0.0, 0.0, 0.0, 0.0))
    assert RobotProperties(straight).height == pytest.approx(0.05 + 0.3 + 0.3 + 0.2 + 0.1 - 0.03)
    lying = replace(arm(), home=(np.pi / 2, 0.0, 0.0, 0.0))
    assert RobotProperties(lying).height == pytest.approx(0.05 + 0.02, abs=1e-3)


def test_reach_is_measured_from_the_root_and_undefined_without_a_tool():
    assert RobotProperties(arm()).reach == pytest.approx(0.05 + 0.3 + 0.3 + 0.04 + 0.28, abs=0.02)
    toolless = replace(arm(), frames=())
    assert (RobotProperties(toolless).reach, RobotProperties(toolless).movable_to_tool) == (0, 0)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("dof == 5", True),
        ("dof != 5", False),
        ("links >= 7 and links <= 7", True),
        ("links > 7 or links < 7", False),
        ("not links > 7", True),
        ("4 < dof < 6", True),
        ("4 < dof < 5", False),
        ("mass > 0g", True),
        ("mass < 1g", False),
        ("movable_to_tool + 2 == links", True),
        ("reach / height > 0 and reach < 100m", True),
        ("dof * 2 == 10 and not (dof == 4 or dof == 6)", True),
    ],
)
def test_a_condition_evaluates_to_true_or_false(gantry, text, expected):
    assert true_of(text, gantry) is expected


def test_clauses_are_the_operands_of_and():
    condition = parse_condition("mass < 4 and (dof > 2 or links > 3) and 1 < reach < 2")
    assert [str(clause) for clause in clauses(condition)] == [
        "(mass < 4)",
        "((dof > 2) or (links > 3))",
        "(1 < reach)",
        "(reach < 2)",
    ]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("mas < 3", "1:1: unknown property 'mas'; did you mean 'mass'? valid: dof, height"),
        ("mass", "1:1: mass is a value; a condition compares, such as mass < 40"),
        ("mass < 3 and dof", "dof is a value"),
        ("reach < 3kg", "1:7: (reach < 3kg) compares kg with m"),
        ("reach + mass < 3", "mixes units m and kg"),
        ("mass < uniform(1, 2)", "1:8: a condition cannot draw values: uniform(1, 2)"),
        ("reach > 1furlong", "unknown unit 'furlong'"),
    ],
)
def test_invalid_conditions_are_errors(text, message):
    with pytest.raises(GrammarError) as caught:
        require_condition(parse_condition(text, "g"))
    assert str(caught.value).startswith("g:")
    assert message in str(caught.value)


@pytest.mark.parametrize("name", PROPERTIES)
def test_every_property_can_be_used_in_a_condition(gantry, name):
    assert true_of(f"{name} >= 0", gantry)

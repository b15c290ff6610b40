"""Arithmetic with units, distributions, and conditions on the properties of a robot."""

import math
import statistics
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
    Distribution,
    RobotProperties,
    Scope,
    clauses,
    evaluate,
    holds,
    require_condition,
    typical_value,
)

LOG_MEAN = 99 / math.log(100)
NAMES = {"r": (0.02, "m"), "k": (3.0, ""), "turn": (1.0, "rad")}


def value(text):
    return evaluate(parse_condition(text, "g"), Scope(NAMES, typical_value, ""))


def drawn(text, n=4000):
    """Return reproducible values of a distribution."""
    rng = np.random.default_rng(0)
    expression = parse_condition(text, "g")
    scope = Scope({}, lambda _, d: d.draw(rng.random, rng.standard_normal), "")
    return [evaluate(expression, scope)[0] for _ in range(n)]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("30mm", (0.03, "m")),
        ("3cm + 5mm", (0.035, "m")),
        ("200g", (0.2, "kg")),
        ("2*r - 1cm", (0.03, "m")),
        ("r / 1mm", (20.0, "")),
        ("1 / k", (1 / 3, "")),
        ("-(r + r)", (-0.04, "m")),
        ("k * turn", (3.0, "rad")),
        ("1 + 2 * k", (7.0, "")),
    ],
)
def test_arithmetic_keeps_units(text, expected):
    number, unit = value(text)
    assert (number, unit) == (pytest.approx(expected[0]), expected[1])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1m + 1kg", "1:4: (1m + 1kg) mixes units m and kg"),
        ("1m * 2m", "1:4: (1m * 2m) multiplies m by m"),
        ("1 / 2m", "1:3: (1 / 2m) divides a pure number by m"),
        ("r - turn", "1:3: (r - turn) mixes units m and rad"),
        ("uniform(1m, 2kg)", "1:1: uniform(1m, 2kg) mixes units kg and m"),
        ("3inch", "1:1: unknown unit 'inch'; valid: N, cm, deg, g, kg, m, mm, rad"),
        ("q + 1", "1:1: unknown value 'q'; valid: k, r, turn"),
        ("1 / 0", "1:3: (1 / 0) divides by zero"),
        ("1e300 * 1e300", "1:7: (1e+300 * 1e+300) is not finite"),
        ("(1 < 2) + 1", "1:4: (1 < 2) is a condition, not a value"),
        ("uniforn(1, 2)", "1:1: unknown distribution 'uniforn'; did you mean 'uniform'?"),
        ("uniform(1)", "1:1: uniform(1) does not fit uniform(low, high)"),
        ("uniform(2, 1)", "1:1: uniform(2, 1): low is above high in uniform(low, high)"),
        ("loguniform(0, 1)", "1:1: loguniform(0, 1): low must be above zero"),
        ("normal(1, 2)", "does not fit normal(mean, deviation, low, high)"),
        ("normal(1, -1, 0, 2)", "the deviation is negative"),
        ("choice()", "1:1: choice() does not fit choice(value, ...)"),
        ("randint(1, 2.5)", "randint needs whole numbers"),
    ],
)
def test_invalid_arithmetic_is_an_error_with_a_position(text, message):
    with pytest.raises(GrammarError, match=r"^g:[^\n]*$") as caught:
        value(text)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("text", "low", "high", "mean", "deviation"),
    [
        ("uniform(1, 3)", 1, 3, 2, 2 / math.sqrt(12)),
        ("loguniform(1, 100)", 1, 100, LOG_MEAN, math.sqrt(9999 / math.log(1e4) - LOG_MEAN**2)),
        ("normal(5, 2, -1, 11)", -1, 11, 5, 2),
        ("randint(1, 6)", 1, 6, 3.5, math.sqrt(35 / 12)),
        ("choice(7, 1, 4, 1)", 1, 7, 3.25, math.sqrt(6.1875)),
        ("uniform(2, 2)", 2, 2, 2, 0),
    ],
)
def test_values_have_the_bounds_mean_and_deviation_of_their_distribution(
    text, low, high, mean, deviation
):
    values = drawn(text)
    assert low <= min(values) <= low + 0.02 * (high - low)
    assert high >= max(values) >= high - 0.02 * (high - low)
    assert statistics.fmean(values) == pytest.approx(mean, abs=4 * deviation / math.sqrt(4000))
    assert statistics.pstdev(values) == pytest.approx(deviation, rel=0.05)


def test_a_normal_is_clipped_not_redrawn():
    values = drawn("normal(0, 1, 0, 1)")
    assert values.count(0.0) / len(values) == pytest.approx(0.5, abs=0.03)
    assert values.count(1.0) / len(values) == pytest.approx(0.159, abs=0.03)


@pytest.mark.parametrize(
    ("text", "typical"),
    [
        ("uniform(1, 3)", 2),
        ("loguniform(1, 100)", 10),
        ("normal(9, 1, 0, 5)", 5),
        ("choice(7, 1)", 7),
        ("randint(2, 5)", 2),
    ],
)
def test_the_typical_value_is_the_middle_or_the_first(text, typical):
    assert value(text)[0] == pytest.approx(typical)


@pytest.mark.parametrize(
    ("distribution", "asked", "given"),
    [
        (Distribution("choice", (math.pi / 6, math.pi / 3)), 1.0471975512, math.pi / 3),
        (Distribution("choice", (0.0, 1.0)), 0.5, None),
        (Distribution("normal", (0.0, 1.0, 0.0, 2 / 3)), 0.666666666667, 2 / 3),
        (Distribution("uniform", (0.0, 1.0)), 0.25, 0.25),
        (Distribution("uniform", (0.0, 1.0)), 1.1, None),
        (Distribution("randint", (2.0, 5.0)), 3.0, 3),
        (Distribution("randint", (2.0, 5.0)), 2.5, None),
        (Distribution("randint", (2.0, 5.0)), 6.0, None),
    ],
)
def test_a_value_rounded_for_a_file_is_recognized(distribution, asked, given):
    assert distribution.closest(asked) == given


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
    properties = RobotProperties(arm())  # a mimic joint moves and is not independent
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
        ("links >= 7 and links <= 7", True),
        ("links > 7 or links < 7", False),
        ("not links > 7", True),
        ("4 < dof < 6", True),
        ("mass > 0g", True),
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
        ("reach < 3kg", "1:7: (reach < 3kg) compares kg with m"),
        ("reach + mass < 3", "mixes units m and kg"),
        ("mass < uniform(1, 2)", "1:8: a condition cannot draw values: uniform(1, 2)"),
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

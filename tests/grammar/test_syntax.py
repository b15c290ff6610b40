"""Parsing grammar text to a syntax tree; syntax errors have line, column and what was expected."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morphgen.errors import GrammarError
from morphgen.grammar.syntax import (
    Expression,
    Include,
    Let,
    Production,
    SourceLocation,
    Where,
    parse_condition,
    parse_grammar,
)


def only(text):
    (statement,) = parse_grammar(text, "g")
    return statement


def argument(text):
    """Return the expression of a parameter of a part."""
    return only(f"robot -> part(x={text})").alternatives[0].items[0].arguments[0][1]


def names(production):
    return [[item.name for item in alternative.items] for alternative in production.alternatives]


def test_a_production_has_alternatives_of_items():
    production = only("robot -> base arm ee | body")
    assert production.symbol == "robot"
    assert names(production) == [["base", "arm", "ee"], ["body"]]


def test_an_item_has_a_port_parameters_and_a_repetition():
    (item,) = only("tail -> left : bead(radius=2cm, rod=r){2, 7}").alternatives[0].items
    assert (item.name, item.port, item.repetition) == ("bead", "left", (2, 7))
    assert [(name, str(value)) for name, value in item.arguments] == [
        ("radius", "2cm"),
        ("rod", "r"),
    ]


def test_a_weight_belongs_to_its_alternative():
    production = only("arm -> @weight(3) ur5 | panda | @weight(1/2) xarm7")
    weights = [alternative.weight for alternative in production.alternatives]
    assert [weight and str(weight) for weight in weights] == ["3", None, "(1 / 2)"]


def test_every_kind_of_statement():
    text = 'include nlink\ninclude "a/b c.grammar"\nlet r = 2\nwhere mass < 4\nrobot -> fixed\n'
    kinds = [type(statement) for statement in parse_grammar(text, "g")]
    assert kinds == [Include, Include, Let, Where, Production]
    assert parse_grammar(text, "g")[1].target == "a/b c.grammar"


def test_comments_blank_lines_and_windows_line_ends_are_ignored():
    plain = parse_grammar("a -> b\nc -> d", "g")
    noisy = parse_grammar("# x -> y\r\n\r\na -> b # e\r\n\r\n  # f\r\nc -> d\r\n\r\n", "g")
    assert [names(p) for p in noisy] == [names(p) for p in plain]
    assert parse_grammar("", "g") == parse_grammar("# nothing\n", "g") == ()


@pytest.mark.parametrize(
    "text",
    [
        "a -> b(x=1, y=2) c | d",
        "a -> b(x=1,\n  y=2)\n  c\n  | d",
        "a -> b(\n\tx=1, # one\n\ty=2\n\t) c\n| d",
        "a ->\n  b(x=1, y=2)\n\n# between\n\n  c | d\n",
    ],
)
def test_indented_lines_and_lines_with_a_bar_continue_a_statement(text):
    assert names(only(text)) == [["b", "c"], ["d"]]


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("1 + 2 * 3", "(1 + (2 * 3))"),
        ("(1 + 2) * 3", "((1 + 2) * 3)"),
        ("8 - 4 - 2", "((8 - 4) - 2)"),
        ("8 / 4 / 2", "((8 / 4) / 2)"),
        ("-2 * 3", "(-2 * 3)"),
        ("2 - -1", "(2 - -1)"),
        ("+5", "5"),
        ("2*uniform(1cm, r/2)", "(2 * uniform(1cm, (r / 2)))"),
        ("1e-3m", "0.001m"),
        (".5", "0.5"),
        ("5.", "5"),
        ("android + nothing + orbit + including", "(((android + nothing) + orbit) + including)"),
    ],
)
def test_arithmetic_has_the_usual_precedence(text, read):
    assert str(argument(text)) == read


@pytest.mark.parametrize(
    ("text", "read"),
    [
        ("mass < 4 or dof > 2 and reach > 1", "((mass < 4) or ((dof > 2) and (reach > 1)))"),
        ("not mass < 4 and dof > 2", "(not (mass < 4) and (dof > 2))"),
        ("not (mass < 4 and dof > 2)", "not ((mass < 4) and (dof > 2))"),
        ("(mass < 4 or dof > 2) and links == 3", "(((mass < 4) or (dof > 2)) and (links == 3))"),
        ("0.4 < reach <= 1.5m", "((0.4 < reach) and (reach <= 1.5m))"),
        ("reach + 1 > 2 * height", "((reach + 1) > (2 * height))"),
        ("(reach) != 3", "(reach != 3)"),
    ],
)
def test_and_binds_closer_than_or_and_comparisons_chain(text, read):
    assert str(parse_condition(text)) == read


def test_a_number_keeps_its_unit_and_its_text():
    assert argument("45deg") == Expression("number", (), SourceLocation("g", 1, 17), "deg", 45.0)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("robot -> base arm(", "1:19: found the end, expected ')' or a name"),
        ("robot ->", "1:9: found the end, expected '@weight' or a name"),
        ("robot > base", "1:7: found '>', expected '->'"),
        ("robot -> a{2.5}", "1:12: found '2.5', expected a whole number"),
        ("robot -> a{3,2}", "1:12: repetition {3,2} needs 1 <= m <= n"),
        ("robot -> a;", "1:11: found ';', expected '('"),
        ("robot -> where", "1:10: found 'where', expected '@weight' or a name"),
        ("robot -> a(x=1, x=2)", "1:17: x is given twice"),
        ("robot -> a(x=3 mm)", "1:16: found 'mm', expected ')'"),
        ("robot -> a(x=1.2.3)", "1:17: found '.3', expected ')'"),
        ("robot -> @weight 2 a", "1:18: found '2', expected '('"),
        ("\n\n  robot -> a left:\n\n", "3:19: found the end, expected a name"),
        ("let x 5\nrobot -> a", "1:7: found '5', expected '='"),
        ("robot -> a\nwhere mass < 3 or", "2:18: found the end, expected '('"),
        ('include "a\nrobot -> a', '1:9: found \'"\', expected a "path" or a name'),
    ],
)
def test_syntax_errors_have_a_position_and_the_expected_tokens(text, message):
    with pytest.raises(GrammarError, match=r"^[^\n]*$") as caught:
        parse_grammar(text, "my.grammar")
    assert str(caught.value).startswith(f"my.grammar:{message}")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "--where:1:1: found the end, expected '('"),
        ("reach > 1 2", "--where:1:11: found '2', expected '*' or '/' or '+' or '-' or 'and'"),
    ],
)
def test_invalid_conditions_are_errors(text, message):
    with pytest.raises(GrammarError) as caught:
        parse_condition(text)
    assert str(caught.value).startswith(message)


NUMBERS = st.builds(
    lambda value, unit: Expression("number", (), SourceLocation("x", 1, 1), unit, value),
    st.floats(0, 1e12),
    st.sampled_from(["", "m", "mm", "deg", "kg"]),
)
NAMES = st.builds(
    lambda name: Expression("name", (), SourceLocation("x", 1, 1), name),
    st.sampled_from(["r", "mass"]),
)


def combined(below):
    pairs = st.tuples(below, below)
    location = SourceLocation("x", 1, 1)
    return st.one_of(
        st.builds(lambda s, ab: Expression(s, ab, location), st.sampled_from("+-*/"), pairs),
        st.builds(lambda ab: Expression("call", ab, location, "uniform"), pairs),
        st.builds(lambda a: Expression("negative", (a,), location), below),
    )


@given(st.recursive(NUMBERS | NAMES, combined, max_leaves=8))
def test_random_expressions_round_trip_through_printing(expression):
    assert str(argument(str(expression))) == str(expression)

"""Derivations as text: parsing, printing, hashing and differences."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from morphgen.errors import GrammarError
from morphgen.grammar.derivation import Derivation, difference, outline, parse_derivation

NAMES = st.from_regex(r"[a-z_][a-z0-9_]{0,8}", fullmatch=True)
VALUES = st.tuples(NAMES, st.floats(-1e3, 1e3).map(lambda x: float(f"{x:.12g}")))
TREES = st.recursive(
    st.builds(Derivation, NAMES, NAMES, st.lists(VALUES, max_size=3).map(tuple)),
    lambda below: st.builds(
        Derivation,
        NAMES,
        NAMES,
        st.lists(VALUES, max_size=3).map(tuple),
        st.lists(st.tuples(NAMES, below), max_size=3).map(tuple),
    ),
    max_leaves=8,
)


@given(TREES)
def test_printing_and_parsing_a_derivation_round_trips(tree):
    assert str(parse_derivation(str(tree))) == str(tree)
    assert parse_derivation(str(tree)).digest == tree.digest


@pytest.mark.parametrize("text", ["", "arm", "arm=ur5(", "arm=ur5[top ee=x]", "a=b(c=d)", "a=b]"])
def test_invalid_derivations_are_errors_with_a_position(text):
    with pytest.raises(GrammarError, match=r"^card:1:\d+: invalid derivation"):
        parse_derivation(text, "card")


def test_a_difference_lists_parts_and_parameters():
    a = parse_derivation("base=fixed[top: arm=ur5[flange: ee=plane(size=0.1)]]")
    b = parse_derivation("base=fixed[top: arm=ur5[flange: ee=plane(size=0.2)]]")
    c = parse_derivation("base=fixed[top: arm=panda]")
    assert difference(a, a) == []
    assert difference(a, b) == ["- ee.size = 0.1", "+ ee.size = 0.2"]
    assert difference(a, c)[:2] == ["- arm = ur5 on base:top", "+ arm = panda on base:top"]


def test_an_outline_has_one_line_per_part():
    tree = parse_derivation("base=fixed[top: arm=ur5[flange: ee=plane(size=0.1)]]")
    assert outline(tree).splitlines() == [
        "base=fixed",
        "  top: arm=ur5",
        "    flange: ee=plane(size=0.1)",
    ]

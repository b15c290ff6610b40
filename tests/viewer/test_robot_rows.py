"""Filtering, sorting and paging of gallery rows."""

import pytest

from morphgen.grammar.library import default_library
from morphgen.viewer.robot_rows import (
    Row,
    fact_choices,
    facts_line,
    part_rows,
    passes,
    select_page,
    sort_rows,
)

ROWS = [
    Row("b-arm", "b", "arms", "train", dof=6, reach=0.9, mass=20.0, findings=(), order=0),
    Row("a-hand", "a", "hands", "test", dof=2, reach=None, mass=1.0, findings=("axis",), order=1),
    Row("c-arm", "c", "arms", "test", dof=7, reach=1.2, mass=None, findings=None, order=2),
]


def names(rows):
    return [row.name[0] for row in rows]


@pytest.mark.parametrize(
    ("condition", "left"),
    [
        ({}, "bac"),
        ({"search": "ARM", "sort": "name"}, "bc"),
        ({"search": "arm train"}, "b"),
        ({"search": "axis", "category": ""}, "a"),
        ({"category": "hands"}, "a"),
        ({"role": "test"}, "ac"),
        ({"findings": "with"}, "a"),
        ({"findings": "without"}, "bc"),
        ({"dof": "3..6"}, "b"),
        ({"reach": "0.5..2"}, "bc"),
        ({"mass": "0..100"}, "ba"),
        ({"search": "arm", "role": "test", "dof": "7..7"}, "c"),
    ],
)
def test_filters(condition, left):
    assert names(row for row in ROWS if passes(row, condition)) == list(left)


@pytest.mark.parametrize(
    ("key", "order"),
    [
        ("order", "bac"),
        ("-order", "cab"),
        ("name", "abc"),
        ("-name", "cba"),
        ("reach", "bca"),
        ("-reach", "cba"),
        ("mass", "abc"),
        ("-mass", "bac"),
        ("-findings", "abc"),
    ],
)
def test_sorting_puts_unknown_values_last(key, order):
    assert names(sort_rows(ROWS, key)) == list(order)


@pytest.mark.parametrize(
    ("number", "size", "expected"),
    [
        (1, 3, ([0, 1, 2], 1, 3)),
        (3, 3, ([6], 3, 3)),
        (9, 3, ([6], 3, 3)),
        (0, 3, ([0, 1, 2], 1, 3)),
        (1, 7, ([0, 1, 2, 3, 4, 5, 6], 1, 1)),
    ],
)
def test_pages(number, size, expected):
    assert select_page(range(7), number, size) == expected


def test_parts_have_their_stored_facts_before_they_are_drawn():
    rows = part_rows(default_library())
    facts = [(row.dof, row.reach, row.mass, row.licence) for row in rows]
    assert all(None not in each and each[-1] for each in facts)
    wide = [row.name for row in sort_rows(rows, "-reach")]
    assert wide.index("ur10") < wide.index("ur5") < wide.index("plane")
    assert all(1 <= row.reach <= 2 for row in rows if passes(row, {"reach": "1..2"}))
    assert passes(next(row for row in rows if row.name == "ur10"), {"reach": "1..2"})


def test_a_robot_passes_with_each_of_its_licences():
    row = Row("d", "d", licence="MIT, Apache-2.0")
    assert fact_choices([row, Row("e", "e")], "licence") == ["Apache-2.0", "MIT"]
    assert [passes(row, {"licence": each}) for each in ("MIT", "Apache-2.0", "BSD")] == [1, 1, 0]


def test_known_facts_are_joined_in_one_line():
    row = Row("d", "d", dof=3, reach=0.5, mass=1.25, findings=())
    assert facts_line(row) == "3 DoF · 0.50 m · 1.25 kg"
    assert facts_line(Row("d", "d")) == ""

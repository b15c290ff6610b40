"""Rows of galleries are filtered, sorted and paged."""

import pytest

from morphgen.viewer.entries import (
    Entry,
    Filter,
    choices,
    extent,
    facts_line,
    filtered,
    ordered,
    paged,
    with_facts,
)

ROWS = [
    Entry("b-arm", "b", "arms", "train", dof=6, reach=0.9, mass=20.0, findings=(), order=0),
    Entry("a-hand", "a", "hands", "test", dof=2, reach=None, mass=1.0, findings=("axis",), order=1),
    Entry("c-arm", "c", "arms", "test", dof=7, reach=1.2, mass=None, findings=None, order=2),
]


def names(rows):
    return [row.name[0] for row in rows]


@pytest.mark.parametrize(
    ("wanted", "left"),
    [
        (Filter(), "bac"),
        (Filter("ARM"), "bc"),
        (Filter("arm train"), "b"),
        (Filter("axis"), "a"),
        (Filter(category="hands"), "a"),
        (Filter(role="test"), "ac"),
        (Filter(findings="with"), "a"),
        (Filter(findings="without"), "bc"),
        (Filter(ranges={"dof": (3, 6)}), "b"),
        (Filter(ranges={"reach": (0.5, 2)}), "bc"),
        (Filter(ranges={"mass": (0, 100)}), "ba"),
        (Filter("arm", role="test", ranges={"dof": (7, 7)}), "c"),
    ],
)
def test_filters(wanted, left):
    assert names(filtered(ROWS, wanted)) == list(left)


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
def test_sorting_puts_the_unknown_last(key, order):
    assert names(ordered(ROWS, key)) == list(order)


def test_unknown_keys_are_refused():
    with pytest.raises(ValueError, match="cannot sort by 'colour'"):
        ordered(ROWS, "colour")


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
    assert paged(range(7), number, size) == expected


def test_no_rows_make_one_empty_page():
    assert paged([], 3, 24) == ([], 1, 1)


def test_extents_and_choices():
    assert extent(ROWS, "reach") == (0.9, 1.2)
    assert extent(ROWS[:1], "reach") is None
    assert choices([*ROWS, Entry("d", "d")], "category") == ["arms", "hands"]


def test_facts_become_known():
    row = with_facts(Entry("d", "d"), {"dof": 3, "reach": 0.5, "mass": 1.25, "findings": ()})
    assert facts_line(row) == "3 DoF · 0.50 m · 1.25 kg"
    assert facts_line(Entry("d", "d")) == ""

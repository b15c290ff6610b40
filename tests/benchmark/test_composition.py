"""Holding out combinations of parts for the composition regime."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from morphgen.benchmark.generate import HoldOutCandidate, hold_out, num_covering
from morphgen.errors import BenchmarkError


def cell(arm, ee, task="reach"):
    return HoldOutCandidate(
        f"{arm}-{ee}", (), f"{arm}({ee})", f"{arm}[{ee}]", frozenset((arm, ee)), ee, task
    )


def chosen(cells, n=1, left=1, seed=0):
    return hold_out(cells, n, left, np.random.SeedSequence(seed))


def is_fair(cells, test, left):
    """Return whether the test cells are a valid selection, from the definition."""
    mixed = len({c.task for c in cells}) > 1
    train = [
        c
        for c in cells
        if all(c.combination != t.combination for t in test)
        and not (mixed and any(t.outermost in c.parts and t.task == c.task for t in test))
    ]
    shown = {what for c in train for what in (*c.parts, c.task)}
    return len(train) >= left and all({*t.parts, t.task} <= shown for t in test)


CELLS = st.lists(
    st.tuples(st.sampled_from("ab"), st.sampled_from("xyz"), st.sampled_from(["reach", "push"])),
    min_size=2,
    max_size=9,
    unique=True,
).map(lambda triples: [cell(*triple) for triple in triples])


@settings(max_examples=200, deadline=None)
@given(CELLS, st.integers(1, 3), st.integers(1, 4), st.integers(0, 99))
def test_hold_out_finds_a_valid_test_set_if_one_exists(cells, n, left, seed):
    exists = any(is_fair(cells, test, left) for test in itertools.combinations(cells, n))
    if not exists:
        with pytest.raises(BenchmarkError, match=f" of {n} test robots can be held out of "):
            chosen(cells, n, left, seed)
        return
    test, train = chosen(cells, n, left, seed)
    assert len(test) == len(set(test)) == n
    assert is_fair(cells, test, left)
    assert len(train) == len(set(train)) >= left
    assert {c.combination for c in test}.isdisjoint(c.combination for c in train)
    needed = {what for c in test for what in (*c.parts, c.task)}
    k = num_covering(train, test)
    assert needed <= {what for c in train[:k] for what in (*c.parts, c.task)}
    assert not needed <= {what for c in train[: k - 1] for what in (*c.parts, c.task)}


def test_the_held_out_robots_depend_on_the_seed():
    cells = [cell(arm, ee) for arm in "abcd" for ee in "wxyz"]
    assert chosen(cells, 3, 2, 7) == chosen(cells, 3, 2, 7)
    assert len({tuple(chosen(cells, 1, 1, seed)[0]) for seed in range(30)}) > 8


def test_each_combination_is_held_out_once_before_any_is_repeated():
    cells = [
        HoldOutCandidate(
            f"{arm}{ee}{k}", (), f"{arm}{ee}{k}", arm + ee, frozenset((arm, ee)), ee, "reach"
        )
        for arm in "abc"
        for ee in "xyz"
        for k in range(3)
    ]
    for seed in range(10):
        test, _ = chosen(cells, 4, 1, seed)
        assert len({c.combination for c in test}) == 4
    test, train = chosen(cells, 9, 1)
    assert len(test) == 9
    assert train


def test_an_impossible_hold_out_is_an_error_with_the_reason():
    with pytest.raises(BenchmarkError) as caught:
        chosen([cell("a", "x"), cell("a", "y")])
    assert "0 of 1 test robots can be held out of 2 combinations" in str(caught.value)
    assert "in one combination only: x, y" in str(caught.value)
    square = [cell(arm, ee) for arm in "ab" for ee in "xy"]
    with pytest.raises(
        BenchmarkError, match=r"0 of 1 .* and at least 4 are left to train on; give"
    ):
        chosen(square, 1, 4)
    both = [cell("a", "x", task) for task in ("reach", "push")]
    with pytest.raises(BenchmarkError, match="the outermost at another task only"):
        chosen(both)

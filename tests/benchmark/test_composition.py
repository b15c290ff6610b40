"""Splits by composition: combinations that are held out, nested sizes, braces and errors."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.splits import LIBRARY, derivations, names, order, require_sound
from morphgen.benchmark.composition import (
    composition,
    hold_out_combinations,
    num_covering,
)
from morphgen.benchmark.regimes import RuledRobot, regime_findings, structure
from morphgen.errors import BenchmarkError, CompositionError, PartError
from morphgen.grammar.syntax import Derivation, parse_derivation

pytestmark = pytest.mark.usefixtures("composed_once")

FROM = ["arm={ur5,lwr,xarm7} ee={plane,stick,cylinder}"]


def test_every_nested_size_trains_every_part_of_the_test_robots():
    splits = composition(order(3, 5, 7), FROM, LIBRARY)
    assert splits[0].train == splits[2].train[:3]
    assert splits[1].train == splits[2].train[:5]
    assert [regime_findings(split, LIBRARY) for split in splits] == [()] * 3
    assert splits[0].provenance["from"] == FROM


def test_parameters_of_parts_may_vary_but_do_not_define_combinations():
    sized = ["base=gantry ee={plane,cube} ee.size={5cm,10cm}", "arm=lwr ee={plane,cube}"]
    (split,) = composition(order(2, test=2), sized, LIBRARY)
    tested = {structure(d, LIBRARY) for d in derivations(split.test)}
    assert len(tested) == 2
    assert tested.isdisjoint(structure(d, LIBRARY) for d in derivations(split.train))
    assert len(set(names((*split.train, *split.test)))) == len(split.train) + 2
    require_sound(split)


def test_combinations_may_include_the_task():
    (split,) = composition(order(6, test=2, tasks=("reach", "push")), FROM, LIBRARY)
    for member in split.test:
        ee = parse_derivation(member.derivation).children[0][1].children[0][1].part
        at = {m.task for m in split.train if ee in m.derivation}
        assert at == {"reach", "push"} - {member.task}
        assert member.name.endswith(f"{ee}-{member.task}")
    assert {m.task for m in split.train} == {"reach", "push"}
    require_sound(split)


def test_grammars_and_limbs_can_be_combined():
    patterns = ["nlink links={2,3}", "base={fixed,pedestal} left.arm=lwr left.ee={plane,cube}"]
    (split,) = composition(order(4, test=2), patterns, LIBRARY)
    members = (*split.train, *split.test)
    assert sorted(m.category for m in members) == ["composed"] * 4 + ["nlink"] * 2
    require_sound(split)


@pytest.mark.parametrize(
    ("asked", "patterns", "error", "message"),
    [
        (order(1), ["arm=ur5 ee={plane,stick}"], BenchmarkError, "in one combination only: plane"),
        (order(1, test=7), FROM, BenchmarkError, "of 7 test robots can be held out of 9"),
        (order(9), FROM, BenchmarkError, "0 of 1 test robots can be held out of 9 combinations"),
        (order(1), FROM, BenchmarkError, "--train 1: 2 robots at least are needed so that every"),
        (order(1), ["arm={ur5,lwr} ee={plnae,stick}"], PartError, "unknown ee 'plnae'; did you"),
        (order(1), ["base={fixed,gantry}"], CompositionError, "nothing to compose"),
    ],
)
def test_impossible_compositions_are_errors_with_the_reason(asked, patterns, error, message):
    with pytest.raises(error) as caught:
        composition(asked, patterns, LIBRARY)
    assert message in str(caught.value)


def cell(arm, ee, task="reach", k=""):
    values = (("k", float(k)),) if k != "" else ()
    derivation = Derivation("arm", arm, (), (("flange", Derivation("ee", ee, values)),))
    return RuledRobot(f"{arm}-{ee}", "composed", task, derivation, LIBRARY)


def chosen(cells, n=1, left=1, seed=0):
    return hold_out_combinations(cells, n, left, np.random.SeedSequence(seed))


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


@settings(max_examples=200)
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
    cells = [cell(arm, ee, k=k) for arm in "abc" for ee in "xyz" for k in range(3)]
    for seed in range(10):
        test, _ = chosen(cells, 4, 1, seed)
        assert len({c.combination for c in test}) == 4
    test, train = chosen(cells, 9, 1)
    assert len(test) == 9
    assert train


def test_a_task_that_only_one_robot_has_cannot_be_held_out():
    both = [cell("a", "x", task) for task in ("reach", "push")]
    with pytest.raises(BenchmarkError, match="the outermost at another task only"):
        chosen(both)

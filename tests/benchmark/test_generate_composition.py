"""Generating splits by composition: combinations, nested sizes, braces and error messages."""

import pytest

from helpers.generated_splits import LIBRARY, derivations, names, order, require_sound
from morphgen.benchmark.generate import composition
from morphgen.benchmark.regimes import expand, parts, regime_findings, structure
from morphgen.errors import BenchmarkError, CompositionError, PartError
from morphgen.grammar.derivation import parse_derivation

FROM = ["arm={ur5,lwr,xarm7} ee={plane,stick,cylinder}"]


@pytest.mark.slow
def test_composition_holds_out_combinations_whose_parts_are_trained():
    for seed in range(3):
        (split,) = composition(order(6, test=2, seed=seed, tasks=("push",)), FROM, LIBRARY)
        trained = [parts(d) for d in derivations(split.train)]
        for own in map(parts, derivations(split.test)):
            assert own not in trained
            assert own <= frozenset().union(*trained)
        assert (len(split.train), len(split.test)) == (6, 2)
        assert {m.task for m in split.train} == {"push"}
        assert {m.category for m in split.train} == {"composed"}
        assert regime_findings(split, LIBRARY) == ()
    require_sound(split)


def test_without_a_size_all_admissible_robots_are_trained():
    (split,) = composition(order(test=2), FROM, LIBRARY)
    assert len(split.train) == 7
    assert split.provenance["from"] == FROM


def test_every_nested_size_trains_every_part_of_the_test_robots():
    splits = composition(order(3, 5, 7), FROM, LIBRARY)
    assert splits[0].train == splits[2].train[:3]
    assert splits[1].train == splits[2].train[:5]
    assert [regime_findings(split, LIBRARY) for split in splits] == [()] * 3


def test_parameters_of_parts_may_vary_but_do_not_define_combinations():
    sized = ["base=gantry ee={plane,cube} ee.size={5cm,10cm}", "arm=lwr ee={plane,cube}"]
    (split,) = composition(order(test=2), sized, LIBRARY)
    tested = {structure(d, LIBRARY) for d in derivations(split.test)}
    assert len(tested) == 2
    assert tested.isdisjoint(structure(d, LIBRARY) for d in derivations(split.train))
    assert len(set(names((*split.train, *split.test)))) == len(split.train) + 2
    require_sound(split)


def test_combinations_may_include_the_task():
    (split,) = composition(order(test=2, tasks=("reach", "push")), FROM, LIBRARY)
    for member in split.test:
        ee = parse_derivation(member.derivation).children[0][1].children[0][1].part
        at = {m.task for m in split.train if ee in m.derivation}
        assert at == {"reach", "push"} - {member.task}
        assert member.name.endswith(f"{ee}-{member.task}")
    assert {m.task for m in split.train} == {"reach", "push"}
    require_sound(split)


def test_grammars_and_limbs_can_be_combined():
    patterns = ["nlink links={2,3}", "base={fixed,pedestal} left.arm=lwr left.ee={plane,cube}"]
    (split,) = composition(order(test=2), patterns, LIBRARY)
    members = (*split.train, *split.test)
    assert sorted(m.category for m in members) == ["composed"] * 4 + ["nlink"] * 2
    require_sound(split)


def test_braces_are_expanded():
    assert expand("arm={ur5,lwr} ee=plane") == [("arm=ur5", "ee=plane"), ("arm=lwr", "ee=plane")]
    assert expand(" arm={ ur5 , lwr }  ") == [("arm=ur5",), ("arm=lwr",)]
    assert expand("ee.size={5,10}{cm,mm}") == [
        ("ee.size=5cm",),
        ("ee.size=5mm",),
        ("ee.size=10cm",),
        ("ee.size=10mm",),
    ]
    assert expand("arm=ur5") == [("arm=ur5",)]


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("arm={ur5,lwr ee=plane", "a brace is not closed, or opened twice"),
        ("arm=ur5,lwr} ee=plane", "a brace is not closed, or opened twice"),
        ("arm={ur5,{lwr}}", "a brace is not closed, or opened twice"),
        ("arm={ur5,,lwr}", r"{ur5,,lwr} has an empty choice"),
        ("arm={}", r"{} has an empty choice"),
        ("arm={ur5,lwr,ur5}", "{ur5,lwr,ur5} has 'ur5' twice"),
        (" ", "--from is empty"),
    ],
)
def test_invalid_braces_are_errors(pattern, message):
    with pytest.raises(BenchmarkError) as caught:
        expand(pattern)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("asked", "patterns", "error", "message"),
    [
        (order(), ["arm=ur5 ee={plane,stick}"], BenchmarkError, "in one combination only: plane, "),
        (order(test=7), FROM, BenchmarkError, "of 7 test robots can be held out of 9 combinations"),
        (order(9), FROM, BenchmarkError, "0 of 1 test robots can be held out of 9 combinations"),
        (order(1), FROM, BenchmarkError, "--train 1: 2 robots at least are needed so that every"),
        (order(), ["arm={ur5,lwr} ee={plnae,stick}"], PartError, "unknown ee 'plnae'; did you"),
        (order(), ["base={fixed,gantry}"], CompositionError, "nothing to compose"),
    ],
)
def test_impossible_compositions_are_errors_with_the_reason(asked, patterns, error, message):
    with pytest.raises(error) as caught:
        composition(asked, patterns, LIBRARY)
    assert message in str(caught.value)

"""The same seed draws the same robots, and only sound ones that meet the conditions."""

import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from helpers.grammars import LIBRARY, grammar, shipped, unphysical
from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.urdf_text import urdf_text
from morphgen.grammar import sampling
from morphgen.grammar.analysis import check_grammar
from morphgen.grammar.choosers import RandomChooser
from morphgen.grammar.derive import derive
from morphgen.grammar.grammar_file import grammar_from_text, grammar_text
from morphgen.grammar.sampling import SamplingError, robot_name, sample_robot, sample_robots
from morphgen.grammar.structures import count_structures
from morphgen.grammar.syntax import parse_condition


def bodies(name, n, **options):
    return [str(drawn.derivation) for drawn in sample_robots(shipped(name), LIBRARY, n, **options)]


def test_robot_17_is_the_same_however_many_are_drawn():
    assert bodies("chain", 3) == bodies("chain", 7)[:3]
    alone = sample_robot(shipped("chain"), LIBRARY, 5)
    assert str(alone.derivation) == bodies("chain", 7)[5]
    assert (alone.index, alone.robot.name) == (5, "chain-000005")


def test_another_seed_gives_other_robots():
    assert not set(bodies("cubes", 5)) & set(bodies("cubes", 5, seed=1))


def test_robots_are_drawn_when_they_are_asked_for():
    endless = sample_robots(shipped("cubes"), LIBRARY, 10**9)
    assert len(list(itertools.islice(endless, 2))) == 2


def test_a_sample_says_what_was_drawn():
    (drawn,) = sample_robots(shipped("cubes"), LIBRARY, 1)
    assert list(drawn.choices) == ["robot/0.cubes.size"]
    assert drawn.choices["robot/0.cubes.size"] == dict(drawn.derivation.parameters)["size"]
    assert drawn.robot.provenance["choices"] == drawn.choices
    assert drawn.robot.provenance["derivation"] == str(drawn.derivation)


def test_conditions_hold_for_every_robot_and_rejected_draws_are_counted():
    condition = parse_condition("dof > 9 and mass < 14")
    drawn = list(sample_robots(shipped("chain"), LIBRARY, 8, where=[condition]))
    assert all(d.robot.dof > 9 and d.properties.mass < 14 for d in drawn)
    rejected = {reason for d in drawn for reason in d.rejected}
    assert rejected == {"where (dof > 9)", "where (mass < 14)"}


def test_a_rejected_draw_moves_no_other_robot():
    free = bodies("cubes", 12)
    condition = parse_condition("mass < 0.5")
    kept = list(sample_robots(shipped("cubes"), LIBRARY, 12, where=[condition]))
    same = [d.index for d in kept if not d.rejected]
    assert 0 < len(same) < 12
    assert all(str(kept[i].derivation) == free[i] for i in same)


def test_conditions_of_the_grammar_count_too():
    found = grammar("robot -> cubes(size=choice(0.05, 0.1))", "where mass < 0.1")
    sizes = {dict(d.derivation.parameters)["size"] for d in sample_robots(found, LIBRARY, 8)}
    assert sizes == {0.05}


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("mass > 900", "500 failed at: where (mass > 900)"),
        ("dof == 2 and mass > 900 and reach > 0", "500 failed at: where (mass > 900)"),
    ],
)
def test_a_condition_that_cannot_be_met_is_named(condition, message):
    with pytest.raises(SamplingError) as caught:
        next(sample_robots(shipped("cubes"), LIBRARY, 1, where=[parse_condition(condition)]))
    assert str(caught.value) == f"robot 0 of 'cubes': 0 of 500 draws were accepted; {message}"


def test_what_failed_most_is_named(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 40)
    found = grammar("robot -> @weight(3) cubes | cartpole", "where mass > 900 or links > 3")
    with pytest.raises(SamplingError, match=r"40 failed at: where \(\(mass > 900\) or \(links > 3"):
        sample_robot(found, LIBRARY, 0)


def test_links_that_overlap_at_home_are_drawn_again(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 5)
    found = grammar("robot -> pedestal(spread=0.05) left:arm3 right:arm3")
    with pytest.raises(SamplingError, match="5 failed at: links overlap at home"):
        sample_robot(found, LIBRARY, 0)


def test_a_robot_that_fails_a_check_is_drawn_again(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 5)
    with pytest.raises(SamplingError, match="5 failed at: check tool-still"):
        sample_robot(grammar("robot -> pedestal left:arm3 plane"), LIBRARY, 0)


def test_a_recursion_that_went_on_for_too_long_is_drawn_again():
    found = grammar(
        "robot -> slides tail", "tail -> @weight(30) bead tail | jaw", "where links < 20"
    )
    drawn = list(sample_robots(found, LIBRARY, 3))
    assert sum(d.rejected.get("more than 100 parts", 0) for d in drawn) > 0


NAMES = ("fixed", "post", "pedestal", "slides", "beam", "bead", "arm3", "plane", "claw", "none")
ITEMS = st.builds(
    lambda port, name, value, repetition: (
        f"{port}{name}{value if name == 'beam' else ''}{repetition}"
    ),
    st.sampled_from(["", "", "", "left:", "top:"]),
    st.sampled_from([*NAMES, "a", "b"]),
    st.sampled_from(["", "(length=uniform(0.1, 0.3))", "(length=k, mount_yaw=90deg)"]),
    st.sampled_from(["", "", "{2}", "{1,3}"]),
)
ALTERNATIVES = st.lists(ITEMS, min_size=1, max_size=3).map(" ".join)
PRODUCTIONS = st.lists(ALTERNATIVES, min_size=1, max_size=2).map(" | ".join)
TEXTS = st.builds(
    lambda base, robot, a, b: f"let k = 0.2\nrobot -> {base} {robot}\na -> {a}\nb -> {b}\n",
    st.sampled_from(["fixed", "post", "pedestal", "slides"]),
    PRODUCTIONS,
    PRODUCTIONS,
    PRODUCTIONS,
)


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(TEXTS)
def test_a_small_grammar_makes_sound_robots_or_is_refused_with_a_reason(monkeypatch, text):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 2)
    found = grammar_from_text(text, "g")
    drawn, why = [], ""
    try:
        drawn = list(sample_robots(found, LIBRARY, 2))
    except MorphgenError as error:
        why = str(error)
    assert bool(drawn) != bool(why)
    assert "\n" not in why
    for one in drawn:
        assert unphysical(one.robot) == []
        assert {finding.severity for finding in check(one.robot)} <= {"info"}


# Few random grammars are sound, and how few is chance: that is no fault of the test.
@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.filter_too_much])
@given(TEXTS, st.integers(0, 3))
def test_what_is_found_sound_can_be_derived(text, seed):
    found = grammar_from_text(text, "g")
    assume(count_structures(found) <= 100)
    wrong = [f for f in check_grammar(found, LIBRARY) if "cannot be reached" not in f]
    assume(all("never used" in fault for fault in wrong))
    derive(found, LIBRARY, RandomChooser(np.random.default_rng(seed)))


@given(TEXTS)
def test_a_grammar_that_is_printed_and_read_prints_the_same(text):
    printed = grammar_text(grammar_from_text(text, "g"))
    assert grammar_text(grammar_from_text(printed, "g")) == printed


def test_names_have_six_digits():
    assert robot_name(shipped("cubes"), 17) == "cubes-000017"
    (drawn,) = sample_robots(shipped("cubes"), LIBRARY, 1)
    assert 'robot name="cubes-000000"' in urdf_text(drawn.robot, str)

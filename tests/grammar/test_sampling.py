"""Sampling is reproducible and yields only robots that pass the checks and conditions."""

import itertools

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from helpers.grammars import LIBRARY, grammar, shipped, unphysical
from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar import sampling
from morphgen.grammar.analysis import check_grammar, count_structures
from morphgen.grammar.derive import RandomChooser, derive
from morphgen.grammar.grammar_file import grammar_from_text, grammar_text
from morphgen.grammar.sampling import SamplingError, robot_name, sample_robot, sample_robots
from morphgen.grammar.syntax import parse_condition


def bodies(name, n, **options):
    return [str(drawn.derivation) for drawn in sample_robots(shipped(name), LIBRARY, n, **options)]


def test_a_robot_does_not_depend_on_the_number_of_samples():
    assert bodies("chain", 3) == bodies("chain", 7)[:3]
    alone = sample_robot(shipped("chain"), LIBRARY, 5)
    assert str(alone.derivation) == bodies("chain", 7)[5]
    assert (alone.index, alone.robot.name) == (5, "chain-000005")


def test_another_seed_gives_other_robots():
    assert not set(bodies("cubes", 5)) & set(bodies("cubes", 5, seed=1))


def test_robots_are_drawn_lazily():
    endless = sample_robots(shipped("cubes"), LIBRARY, 10**9)
    assert len(list(itertools.islice(endless, 2))) == 2


def test_a_sample_records_its_choices():
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


def test_a_rejected_draw_does_not_change_other_robots():
    free = bodies("cubes", 12)
    condition = parse_condition("mass < 0.5")
    kept = list(sample_robots(shipped("cubes"), LIBRARY, 12, where=[condition]))
    same = [d.index for d in kept if not d.rejected]
    assert 0 < len(same) < 12
    assert all(str(kept[i].derivation) == free[i] for i in same)


def test_conditions_in_the_grammar_apply():
    robot_grammar = grammar("robot -> cubes(size=choice(0.05, 0.1))", "where mass < 0.1")
    sizes = {
        dict(d.derivation.parameters)["size"] for d in sample_robots(robot_grammar, LIBRARY, 8)
    }
    assert sizes == {0.05}


@pytest.mark.parametrize(
    ("condition", "message"),
    [
        ("mass > 900", "500 failed at: where (mass > 900)"),
        ("dof == 2 and mass > 900 and reach > 0", "500 failed at: where (mass > 900)"),
    ],
)
def test_an_unsatisfiable_condition_is_named(condition, message):
    with pytest.raises(SamplingError) as caught:
        next(sample_robots(shipped("cubes"), LIBRARY, 1, where=[parse_condition(condition)]))
    assert str(caught.value) == f"robot 0 of 'cubes': 0 of 500 draws were accepted; {message}"


def test_the_most_frequent_reason_of_rejection_is_named(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 40)
    robot_grammar = grammar("robot -> @weight(3) cubes | cartpole", "where mass > 900 or links > 3")
    with pytest.raises(SamplingError, match=r"40 failed at: where \(\(mass > 900\) or \(links > 3"):
        sample_robot(robot_grammar, LIBRARY, 0)


def test_robots_with_overlapping_links_at_home_are_redrawn(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 5)
    robot_grammar = grammar("robot -> pedestal(spread=0.05) left:arm3 right:arm3")
    with pytest.raises(SamplingError, match="5 failed at: links overlap at home"):
        sample_robot(robot_grammar, LIBRARY, 0)


def test_robots_that_fail_a_check_are_redrawn(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 5)
    with pytest.raises(SamplingError, match="5 failed at: check tool-still"):
        sample_robot(grammar("robot -> pedestal left:arm3 plane"), LIBRARY, 0)


def test_too_deep_recursions_are_redrawn():
    robot_grammar = grammar(
        "robot -> slides tail", "tail -> @weight(30) bead tail | jaw", "where links < 20"
    )
    drawn = list(sample_robots(robot_grammar, LIBRARY, 3))
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
def test_random_small_grammars_yield_valid_robots_or_an_error(monkeypatch, text):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 2)
    grammar = grammar_from_text(text, "g")
    drawn, why = [], ""
    try:
        drawn = list(sample_robots(grammar, LIBRARY, 2))
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
def test_grammars_without_faults_can_be_derived(text, seed):
    grammar = grammar_from_text(text, "g")
    assume(count_structures(grammar) <= 100)
    wrong = [f for f in check_grammar(grammar, LIBRARY) if "cannot be reached" not in f]
    assume(all("never used" in fault for fault in wrong))
    derive(grammar, LIBRARY, RandomChooser(np.random.default_rng(seed)))


@given(TEXTS)
def test_random_grammars_round_trip_through_printing(text):
    printed = grammar_text(grammar_from_text(text, "g"))
    assert grammar_text(grammar_from_text(printed, "g")) == printed


def test_names_have_six_digits():
    assert robot_name(shipped("cubes"), 17) == "cubes-000017"
    (drawn,) = sample_robots(shipped("cubes"), LIBRARY, 1)
    assert 'robot name="cubes-000000"' in urdf_text(drawn.robot, str)

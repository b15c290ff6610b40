"""Sampling and mutation are reproducible and yield only robots that pass checks and conditions."""

import itertools
import json

import numpy as np
import pytest
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from helpers.grammars import CATEGORIES, LIBRARY, benchmark_counts, grammar, shipped, unphysical
from morphgen.checks import check
from morphgen.checks.conformance import conformance
from morphgen.errors import GrammarError, MorphgenError
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.rounding import round_number
from morphgen.grammar import sampling
from morphgen.grammar.analysis import check_grammar, count_structures
from morphgen.grammar.derivation import difference
from morphgen.grammar.derive import RandomChooser, derive
from morphgen.grammar.grammar_file import grammar_from_text, grammar_text
from morphgen.grammar.sampling import Sample, SamplingError, mutate, sample_robot, sample_robots
from morphgen.grammar.syntax import parse_condition


def bodies(name, n, **options):
    return [str(drawn.derivation) for drawn in sample_robots(shipped(name), LIBRARY, n, **options)]


def test_a_robot_does_not_depend_on_the_number_of_samples():
    assert bodies("chain", 3) == bodies("chain", 7)[:3]
    alone = sample_robot(shipped("chain"), LIBRARY, 5)
    assert str(alone.derivation) == bodies("chain", 7)[5]
    assert (alone.index, alone.robot.name) == (5, "chain-000005")
    assert len(list(itertools.islice(sample_robots(shipped("cubes"), LIBRARY, 10**9), 2))) == 2


def test_another_seed_gives_other_robots():
    assert not set(bodies("cubes", 5)) & set(bodies("cubes", 5, seed=1))


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


def test_the_most_frequent_reason_of_rejection_is_named(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 40)
    robot_grammar = grammar(
        "robot -> @weight(3) cubes | cartpole",
        "where dof > 0 and (mass > 900 or links > 3) and reach > 0",
    )
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


@settings(max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
@settings(max_examples=60, suppress_health_check=[HealthCheck.filter_too_much])
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


def as_in_index(choices):
    """Return choices as read back from a file."""
    return json.loads(json.dumps({key: round_number(value) for key, value in choices.items()}))


def neighbours(robot_grammar, origin, n, seed=0):
    choices, name = as_in_index(origin.choices), origin.robot.name
    return list(mutate(robot_grammar, LIBRARY, choices, n, seed=seed, name=name))


def assert_one_choice_differs(before, after):
    changed = [key for key in before if key in after and before[key] != after[key]]
    assert len(changed) == 1
    opened = changed[0].rstrip("#")
    assert all(key.startswith(opened) for key in before.keys() ^ after.keys())


@pytest.mark.parametrize("category", [name for name in CATEGORIES if name != "panda_variations"])
def test_a_neighbour_differs_in_one_choice_and_its_dependants(category):
    grammar = shipped(category)
    origin = sample_robot(grammar, LIBRARY, 3)
    for neighbour in neighbours(grammar, origin, 5):
        assert_one_choice_differs(as_in_index(origin.choices), as_in_index(neighbour.choices))
        assert neighbour.derivation != origin.derivation


def test_all_other_values_are_unchanged_to_the_last_digit():
    robot_grammar = grammar(
        "let r = uniform(0.031234567, 0.04)",
        "robot -> gantry(low=uniform(0.1, 0.2), stroke=r*17) plane(size=1.7*r/0.9)",
    )
    for index in range(10):
        origin = sample_robot(robot_grammar, LIBRARY, index)
        for neighbour in neighbours(robot_grammar, origin, 3, seed=index):
            lines = difference(origin.derivation, neighbour.derivation)
            names = {line[2:].split(" = ")[0] for line in lines}
            assert names in ({"gantry.low"}, {"gantry.stroke", "plane.size"})


def test_neighbours_satisfy_the_conditions():
    robot_grammar = grammar(
        "robot -> post beam(length=uniform(0.1, 0.3)){2,5} jaw", "where 0.5 < reach < 0.9"
    )
    origin = sample_robot(robot_grammar, LIBRARY, 0)
    drawn = neighbours(robot_grammar, origin, 10)
    assert all(0.5 < neighbour.properties.reach < 0.9 for neighbour in drawn)
    assert sum(len(neighbour.rejected) for neighbour in drawn) > 0


def test_neighbours_depend_on_the_seed_not_on_their_number():
    grammar = shipped("chain")
    origin = sample_robot(grammar, LIBRARY, 0)
    few, many = neighbours(grammar, origin, 2, seed=4), neighbours(grammar, origin, 5, seed=4)
    assert [str(n.derivation) for n in few] == [str(n.derivation) for n in many[:2]]
    assert [n.robot.name for n in few] == ["chain-000000-m0000", "chain-000000-m0001"]
    other = neighbours(grammar, origin, 2, seed=5)
    assert [str(n.derivation) for n in other] != [str(n.derivation) for n in few]


def test_a_grammar_without_choices_has_no_neighbours():
    only = grammar("robot -> cubes")
    with pytest.raises(GrammarError, match="leaves nothing to choose: no neighbours"):
        neighbours(only, sample_robot(only, LIBRARY, 0), 1)


def test_a_choice_without_effect_is_an_error(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 20)
    robot_grammar = grammar("robot -> cubes(size=choice(0.1, 0.1))")
    with pytest.raises(SamplingError, match="in 20 draws: 20 x nothing changed"):
        neighbours(robot_grammar, sample_robot(robot_grammar, LIBRARY, 0), 1)


def robot_faults(drawn: Sample, category):
    """Return the faults of a robot of a category."""
    robot = drawn.robot
    counts = (len(robot.links), len(robot.movable_joints))
    faults = unphysical(robot)
    if counts != benchmark_counts(category, drawn.derivation):
        faults.append(f"{counts} links and movable joints: {drawn.derivation}")
    faults += [f"{f.code} {f.where}" for f in check(robot) if f.severity != "info"]
    if [frame.name for frame in robot.frames] != ["tool"]:
        faults.append(f"frames {robot.frames}")
    return faults


@pytest.mark.parametrize(
    ("category", "n"),
    [  # the Panda has many meshes to load
        pytest.param(name, n, marks=[pytest.mark.slow] * (n > 1 or name == "panda_variations"))
        for name in CATEGORIES
        for n in (1, 100)
    ],
)
def test_robots_have_the_counts_of_the_benchmark_and_loaders_agree(category, n, tmp_path):
    grammar = shipped(category)
    for index in range(n):
        drawn = sample_robot(grammar, LIBRARY, index, seed=11)
        assert robot_faults(drawn, category) == []
        folder = write_bundle(drawn.robot, tmp_path / "robot", picture=False)
        report = conformance(folder, 20)
        assert report.passed, report
        assert [f.code for f in check(read_bundle(folder)) if f.severity != "info"] == []

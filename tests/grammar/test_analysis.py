"""Static analysis of grammars: counting structures, listing them, and reporting faults."""

import itertools
import math

import numpy as np
import pytest

from helpers.grammars import CATEGORIES, LIBRARY, grammar, shipped
from morphgen.errors import GrammarError
from morphgen.grammar.analysis import (
    check_grammar,
    count_structures,
    enumerate_structures,
    variables,
)
from morphgen.grammar.derive import RandomChooser, derive


def structures(robot_grammar, limit=None):
    return [str(d) for d in itertools.islice(enumerate_structures(robot_grammar, LIBRARY), limit)]


@pytest.mark.parametrize("name", CATEGORIES)
def test_shipped_grammars_are_sound(name):
    assert check_grammar(shipped(name), LIBRARY) == []


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["robot -> fixed urr5"], "g:1:16: 'urr5' is neither a symbol nor a part; did you mean"),
        (["robot -> fixed a(x=1)", "a -> ur5"], "g:1:16: 'a' is a symbol and takes no parameters"),
        (["robot -> gantry plane(sise=1)"], "g:1:28: 'plane' has no parameter 'sise'"),
        (["robot -> gantry plane(size=1kg)"], "g:1:28: size is in m, 1kg in kg"),
        (["robot -> gantry plane(size=uniform(0.1, 2))"], "g:1:28: plane.size=2: out of range"),
        (["let s = uniform(1, 4)", "robot -> gantry plane(size=s/2)"], "plane.size=2: out of"),
        (["robot -> slides hand(palm=0, fingers=uniform(2, 4))"], "hand.fingers=2.76393: not a wh"),
        (["let s = uniform(2, 1)", "robot -> cubes(size=s)"], "g:1:9: uniform(2, 1): low is above"),
        (["robot -> slides bead robot"], "g:1:1: 'robot' never ends: it always holds itself"),
        (["robot -> gantry a", "a -> plane | a"], "g:2:1: 'a' can be rewritten to itself alone"),
        (["robot -> cubes", "a -> cubes"], "g:2:1: 'a' cannot be reached from 'robot'"),
        (["let r = 1", "robot -> cubes"], "g:1:5: 'r' is never used"),
        (["robot -> pedestal up:ur5"], "g:1:22: 'pedestal' has no port 'up'"),
        (["robot -> gantry plane cube"], "g:1:23: nothing can be attached to 'plane': it has no"),
        (["robot -> cubes | ur5(mount_yaw=1)"], "'ur5' is not attached to a port: it has no"),
        (["robot -> yumi_gripper"], "g:1:1: 'yumi_gripper' needs a base: its mount"),
        (["robot -> @weight(0) cubes"], "g:1:1: all weights of 'robot' are zero"),
    ],
)
def test_a_fault_is_reported_with_line_and_column(lines, message):
    faults = check_grammar(grammar(*lines), LIBRARY)
    assert faults
    assert any(message in fault for fault in faults)
    assert all(fault.startswith("g:") and "\n" not in fault for fault in faults)


def test_all_faults_are_reported_together():
    wrong = grammar("let r = 1", "robot -> gantri plane(sise=1)", "a -> ur55")
    faults = [fault.split(": ")[0] for fault in check_grammar(wrong, LIBRARY)]
    assert faults == ["g:2:10", "g:2:28", "g:3:6", "g:3:1", "g:1:5"]


@pytest.mark.parametrize(
    "lines",
    [  # values that weights or other values name are used; a recursion may end
        ("let a = 1", "let b = a", "robot -> @weight(b) cubes | cartpole"),
        ("robot -> slides tail", "tail -> bead tail | bead"),
    ],
)
def test_sound_grammars_have_no_faults(lines):
    assert check_grammar(grammar(*lines), LIBRARY) == []


@pytest.mark.parametrize(
    ("lines", "number"),
    [
        (["robot -> cubes"], 1),
        (["robot -> cubes | cartpole | post"], 3),
        (["robot -> post beam{2,5}"], 4),
        (["robot -> post beam{3}"], 1),
        (["robot -> post link{1,3}", "link -> beam | bead"], 2 + 4 + 8),
        (["robot -> post link{1,2} ee", "link -> beam{1,2} | bead", "ee -> jaw | claw"], 24),
        (["robot -> base arm jaw", "base -> fixed | post", "arm -> ur5 | ur3 | beam"], 6),
        (["robot -> pedestal left:l right:l", "l -> a e", "a -> ur5 | ur3", "e -> jaw | claw"], 16),
        (["robot -> gantry ee", "ee -> @weight(0) plane | cube | jaw"], 2),
    ],
)
def test_the_structure_count_equals_the_number_of_distinct_listed_structures(lines, number):
    robot_grammar = grammar(*lines)
    listed = structures(robot_grammar)
    assert count_structures(robot_grammar) == number == len(listed) == len(set(listed))


def test_the_list_contains_exactly_the_structures_that_sampling_draws():
    robot_grammar = grammar(
        "robot -> post link{1,2} ee", "link -> beam{1,2} | bead", "ee -> jaw | claw"
    )
    rng = np.random.default_rng(0)
    drawn = {str(derive(robot_grammar, LIBRARY, RandomChooser(rng))) for _ in range(600)}
    assert drawn == set(structures(robot_grammar))


def test_duplicate_alternatives_are_listed_once():
    robot_grammar = grammar("robot -> gantry ee", "ee -> plane | plane | cube")
    assert count_structures(robot_grammar) == 3
    assert len(structures(robot_grammar)) == 2


def test_structures_of_a_recursive_grammar_are_listed_by_size():
    robot_grammar = grammar("robot -> slides tail", "tail -> bead | beam tail")
    assert math.isinf(count_structures(robot_grammar))
    listed = structures(robot_grammar, 6)
    assert [text.count("=bead") + text.count("=beam") for text in listed] == [1, 2, 3, 4, 5, 6]
    assert len(set(listed)) == 6


def test_an_impossible_structure_raises_when_it_is_reached():
    wrong = grammar("robot -> gantry ee", "ee -> plane | plane cube")
    listed = enumerate_structures(wrong, LIBRARY)
    assert next(listed).part == "gantry"
    with pytest.raises(GrammarError, match="g:2:21: nothing can be attached to 'plane'"):
        next(listed)


def test_shipped_grammars_have_the_documented_number_of_structures():
    expected = {"chain": 6, "nlink": 4, "planar_arm": 8, "prims": 4, "arm3": 1}
    assert {name: count_structures(shipped(name)) for name in expected} == expected


def test_every_random_choice_is_listed_with_its_distribution():
    random_choices = variables(
        grammar(
            "let r = uniform(1cm, 2cm)",
            "let n = 3",
            "robot -> slides(radius=r) link{2,3}",
            "link -> bead(radius=r, rod=choice(2cm, r) + uniform(0, 5*r))",
        )
    )
    assert [(v.location, v.text, v.distribution.is_continuous) for v in random_choices] == [
        ("let r", "uniform(1cm, 2cm)", True),
        ("link: bead.rod", "choice(2cm, r)", False),
        ("link: bead.rod", "uniform(0, (5 * r))", True),
    ]
    assert random_choices[2].distribution.bounds == pytest.approx((0, 0.075))

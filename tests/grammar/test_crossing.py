"""Crossing mixes the choices of two robots, and draws at most one of them again."""

import pytest

from helpers.grammars import LIBRARY, grammar, shipped
from morphgen.grammar.sampling import SamplingError, cross, sample_robot


def children(robot_grammar, a, b, n=6, seed=0):
    parents = (a.choices, b.choices)
    return list(cross(robot_grammar, LIBRARY, parents, n, seed=seed, name="both"))


def is_mixed(value, first, second):
    """Return whether a choice is that of a parent, or a value between both."""
    low, high = sorted((first, second))
    is_whole = float(low).is_integer() and float(high).is_integer()
    return value in (low, high) if is_whole else low - 1e-9 <= value <= high + 1e-9


@pytest.mark.parametrize("category", ["arm3", "chain", "planar_arm"])
def test_at_most_one_choice_of_a_child_is_not_a_mixture(category):
    robot_grammar = shipped(category)
    a, b = (sample_robot(robot_grammar, LIBRARY, i) for i in (2, 5))
    offspring = children(robot_grammar, a, b, n=12)
    mixtures = []
    for child in offspring:
        assert child.derivation not in (a.derivation, b.derivation)
        shared = child.choices.keys() & a.choices.keys() & b.choices.keys()
        mixed = [is_mixed(child.choices[key], a.choices[key], b.choices[key]) for key in shared]
        assert sum(mixed) >= len(mixed) - 1
        mixtures.append(all(mixed))
    assert any(mixtures)
    assert [child.robot.name for child in offspring] == [f"both-x{i:04d}" for i in range(12)]


def test_child_i_does_not_depend_on_the_number_of_children():
    robot_grammar = shipped("planar_arm")
    a, b = (sample_robot(robot_grammar, LIBRARY, i) for i in (2, 5))
    few, many = (children(robot_grammar, a, b, n=n) for n in (2, 4))
    assert [child.derivation for child in few] == [child.derivation for child in many[:2]]
    others = children(robot_grammar, a, b, n=4, seed=1)
    assert [child.derivation for child in others] != [child.derivation for child in many]


def test_parents_that_differ_in_one_alternative_have_children():
    robot_grammar = grammar("robot -> gantry(low=uniform(0.1, 0.2)) tip", "tip -> plane | cube")
    a = sample_robot(robot_grammar, LIBRARY, 0)
    b = next(
        robot
        for robot in (sample_robot(robot_grammar, LIBRARY, i) for i in range(20))
        if robot.choices["robot/1.tip"] != a.choices["robot/1.tip"]
    )
    same = {**b.choices, **{key: a.choices[key] for key in a.choices if key.endswith("low")}}
    parents = (a.choices, same)
    assert len(list(cross(robot_grammar, LIBRARY, parents, 3, name="both"))) == 3


def test_a_grammar_without_choices_has_no_children():
    robot_grammar = grammar("robot -> gantry plane")
    a = sample_robot(robot_grammar, LIBRARY, 0)
    with pytest.raises(SamplingError, match="500 x nothing changed"):
        children(robot_grammar, a, a)

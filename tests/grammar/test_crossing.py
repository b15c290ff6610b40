"""Crossing takes each choice from one of two robots."""

import pytest

from helpers.grammars import LIBRARY, grammar, shipped
from morphgen.grammar.sampling import SamplingError, cross, sample_robot


def children(robot_grammar, a, b, n=6, seed=0):
    parents = (a.choices, b.choices)
    return list(cross(robot_grammar, LIBRARY, parents, n, seed=seed, name="both"))


@pytest.mark.parametrize("category", ["arm3", "chain", "planar_arm"])
def test_each_choice_of_a_child_is_that_of_a_parent_where_both_made_it(category):
    robot_grammar = shipped(category)
    a, b = (sample_robot(robot_grammar, LIBRARY, i) for i in (2, 5))
    offspring = children(robot_grammar, a, b)
    for child in offspring:
        assert child.derivation not in (a.derivation, b.derivation)
        for key in child.choices.keys() & a.choices.keys() & b.choices.keys():
            assert child.choices[key] in (a.choices[key], b.choices[key])
    assert [child.robot.name for child in offspring] == [f"both-x{i:04d}" for i in range(6)]


def test_child_i_does_not_depend_on_the_number_of_children():
    robot_grammar = shipped("planar_arm")
    a, b = (sample_robot(robot_grammar, LIBRARY, i) for i in (2, 5))
    few, many = (children(robot_grammar, a, b, n=n) for n in (2, 4))
    assert [child.derivation for child in few] == [child.derivation for child in many[:2]]
    others = children(robot_grammar, a, b, n=4, seed=1)
    assert [child.derivation for child in others] != [child.derivation for child in many]


def test_parents_without_a_difference_have_no_children():
    robot_grammar = grammar("robot -> gantry(low=uniform(0.1, 0.2)) plane")
    a = sample_robot(robot_grammar, LIBRARY, 0)
    with pytest.raises(SamplingError, match="500 x nothing changed"):
        children(robot_grammar, a, a)

"""Mutation redraws one choice of a robot's derivation."""

import json

import pytest

from helpers.grammars import CATEGORIES, LIBRARY, grammar, shipped
from morphgen.errors import GrammarError
from morphgen.formats.rounding import round_number
from morphgen.grammar import sampling
from morphgen.grammar.derivation import difference
from morphgen.grammar.sampling import SamplingError, mutate, sample_robot


def as_in_index(choices):
    """Return choices as read back from a file."""
    return json.loads(json.dumps({key: round_number(value) for key, value in choices.items()}))


def neighbours(robot_grammar, origin, n, seed=0):
    return list(
        mutate(
            robot_grammar,
            LIBRARY,
            as_in_index(origin.choices),
            n,
            seed=seed,
            name=origin.robot.name,
        )
    )


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


def test_choices_rounded_in_a_file_are_kept():
    robot_grammar = grammar(
        "robot -> gantry plane(size=uniform(0.1, 0.2), mount_yaw=choice(60deg, 60deg, 30deg))"
    )
    turned = [
        i for i in range(20) if max(sample_robot(robot_grammar, LIBRARY, i).choices.values()) > 1
    ]
    assert turned
    for index in turned[:5]:
        origin = sample_robot(robot_grammar, LIBRARY, index)
        for neighbour in neighbours(robot_grammar, origin, 4):
            assert_one_choice_differs(as_in_index(origin.choices), as_in_index(neighbour.choices))


def test_a_new_alternative_draws_its_own_parameters():
    robot_grammar = grammar("robot -> gantry ee", "ee -> plane(size=uniform(0.1, 0.2)) | stick")
    origin = next(
        o
        for o in (sample_robot(robot_grammar, LIBRARY, i) for i in range(9))
        if "stick" in str(o.derivation)
    )
    for neighbour in neighbours(robot_grammar, origin, 3):
        assert set(neighbour.choices) == {"robot/1.ee", "robot/1.ee/plane.size"}


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
    with pytest.raises(GrammarError, match="leaves nothing to choose: no neighbours"):
        neighbours(
            grammar("robot -> cubes"), sample_robot(grammar("robot -> cubes"), LIBRARY, 0), 1
        )


def test_a_choice_without_effect_is_an_error(monkeypatch):
    monkeypatch.setattr(sampling, "MAX_ATTEMPTS", 20)
    robot_grammar = grammar("robot -> cubes(size=choice(0.1, 0.1))")
    with pytest.raises(SamplingError, match="in 20 draws: 20 x nothing changed"):
        neighbours(robot_grammar, sample_robot(robot_grammar, LIBRARY, 0), 1)

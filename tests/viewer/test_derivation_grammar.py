"""Grammars around robots that no grammar has given."""

import pytest

from morphgen.grammar.analysis import check_grammar
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.grammar_file import find_grammar, grammar_from_text, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request
from morphgen.grammar.sampling import sample_robot
from morphgen.viewer.pages.compose_grammar import grammar_around, make_individual, mutants

LIBRARY = default_library()


def around(derivation):
    text = grammar_around(derivation, LIBRARY)
    grammar = grammar_from_text(text, "around")
    assert check_grammar(grammar, LIBRARY) == []
    return grammar, text, make_individual(grammar, LIBRARY, {})


@pytest.mark.parametrize(
    "words",
    ["arm=ur5 ee=plane", "base=gantry ee=cube ee.size=0.12", "base=pedestal arm=arm3", "ee=jaw"],
)
def test_the_typical_robot_is_that_of_the_words(words):
    derivation = parse_request(words.split(), LIBRARY)
    assert around(derivation)[2].derivation == derivation


def test_robots_with_several_limbs_keep_their_parts_and_ports():
    words = "base=pedestal left.arm=ur5 left.ee=plane right.arm=panda arm=ur3 ee=cube"
    derivation = parse_request(words.split(), LIBRARY)
    typical = around(derivation)[2].derivation

    def limbs(node):
        return {
            (port, child.part, child.parameters, frozenset(limbs(child)))
            for port, child in node.children
        }

    assert typical.part == "pedestal"
    assert limbs(typical) == limbs(derivation)


def test_robots_of_grammars_have_grammars_around_them():
    planar_arm = load_grammar(find_grammar("planar_arm", LIBRARY.folders), LIBRARY.folders)
    derivation = sample_robot(planar_arm, LIBRARY, 1).derivation
    typical = around(derivation)[2].derivation
    # Symbols cannot have the name of a part, so the post is called post2.
    assert [(node.part, node.parameters) for node in typical.walk()] == [
        (node.part, node.parameters) for node in derivation.walk()
    ]


def test_what_the_robot_does_not_use_stays_as_it_is():
    _, text, individual = around(parse_request(["arm=ur5", "ee.mount_yaw=0.5", "ee=cube"], LIBRARY))
    assert "base -> fixed(spread=0.6)\n" in text  # the distance between ports without a limb
    assert "cube(size=normal(0.1, 0.03, 0.02, 0.5), mount_yaw=0.5)" in text
    assert "| panda\n" in text
    assert "yumi(" not in text
    assert "none" not in text
    assert len(individual.choices) == 3  # arm, end-effector, and size


def test_integers_change_by_one_or_two():
    _, text, _ = around(parse_request(["arm=ur5", "ee=hand"], LIBRARY))
    assert "hand(fingers=choice(3, 2, 4, 5), phalanges=choice(3, 2), " in text


def test_mutants_differ_from_the_robot_in_one_choice():
    grammar, _, parent = around(parse_request(["base=gantry", "ee=cube"], LIBRARY))
    generation = mutants(grammar, LIBRARY.folders, parent.choices, 1)
    assert len({mutant.derivation.digest for mutant in generation} | {parent.derivation.digest}) > 5


def test_a_body_of_a_grammar_has_one():
    derivation = parse_derivation("robot=cartpole(length=0.6, mass=0.7, travel=2)")
    _, text, individual = around(derivation)
    assert individual.derivation.part == "cartpole"
    assert "normal(0.6," in text

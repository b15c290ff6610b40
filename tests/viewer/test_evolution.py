"""Mutants of robots on the compose page, and grammars around robots that no grammar has given."""

import pytest

from helpers.pages import pointer
from helpers.viser_client import PlainClient
from morphgen.grammar.analysis import check_grammar
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.grammar_file import find_grammar, grammar_from_text, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_request
from morphgen.grammar.sampling import sample_robot
from morphgen.viewer.app.address import AddressError, pack_text
from morphgen.viewer.pages.compose_grammar import (
    NUM_OFFSPRING,
    change_lines,
    grammar_around,
    make_individual,
    mutants,
    pack_choices,
    unpack_choices,
)

LIBRARY = default_library()


@pytest.fixture(scope="module")
def planar_arm():
    return load_grammar(find_grammar("planar_arm", LIBRARY.folders), LIBRARY.folders)


def test_packed_choices_give_the_same_robot(planar_arm):
    sample = sample_robot(planar_arm, LIBRARY, 1)
    choices = unpack_choices(pack_choices(sample.choices))
    individual = make_individual(planar_arm, LIBRARY, choices)
    assert individual.derivation == sample.derivation
    again = make_individual(planar_arm, LIBRARY, individual.choices)
    assert again.robot.name == individual.robot.name


def test_a_generation_has_mutants_of_a_robot(planar_arm):
    sample = sample_robot(planar_arm, LIBRARY, 1)
    generation = mutants(planar_arm, LIBRARY.folders, sample.choices, 3)
    assert len(generation) == NUM_OFFSPRING
    assert all(mutant.derivation != sample.derivation for mutant in generation)


@pytest.mark.parametrize(
    "text", ["!", pack_text("[1]"), pack_text('{"a": "b"}'), pack_text('{"a": Infinity}')]
)
def test_invalid_choices_of_an_address_are_refused(text):
    with pytest.raises(AddressError, match="readable"):
        unpack_choices(text)


def test_changes_of_a_derivation_are_lines():
    before = parse_derivation("post=post(height=0.05)[top: beam1=beam(length=0.1971947)]")
    after = parse_derivation("post=post(height=0.05)[top: beam1=beam(length=0.3)]")
    assert change_lines(before, after) == ["beam1.length 0.197 to 0.3"]
    longer = parse_derivation(
        "post=post(height=0.05)[top: beam1=beam(length=0.3)[end: beam2=beam(length=0.1)]]"
    )
    assert change_lines(after, longer) == ["+ beam2 (beam on beam1:end)"]


def test_a_robot_of_a_set_evolves_and_its_offspring_is_in_the_address(shared_viewer):
    with PlainClient(shared_viewer.port, "?compose=robots/prims/prims-000001") as client:
        client.control("Number", "generation")
        buttons = client.control("ButtonGroup", "show")
        client.shows("to go on with it")
        client.change(buttons, "mutants")
        client.shows('data-do="adopt" data-value="8"')
        client.until(lambda: client.addresses[-1][1].endswith("&evolve=1"))
        assert "&choices=" in client.addresses[-1][1]
        frame = client.until(
            lambda: next((m for m in client.messages if m.get("name") == "/offspring4"), None)
        )
        client.send(pointer("Click", frame))
        client.until(lambda: client.addresses[-1][1].endswith("&evolve=2"))
        client.change(buttons, "none")
        client.until(lambda: "evolve" not in client.addresses[-1][1])


def test_mutants_of_a_robot_without_a_grammar_need_no_other_button(shared_viewer):
    with PlainClient(shared_viewer.port, "?compose=base=gantry ee=cube") as client:
        client.shows("This robot has no grammar whose choices could be drawn again")
        client.change(client.control("ButtonGroup", "show"), "mutants")
        client.shows('data-do="adopt" data-value="8"')


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

"""Generations of robots on the compose page, and their history."""

import numpy as np
import pytest

from helpers.viser_client import PlainClient
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import sample_robot
from morphgen.viewer.app.address import AddressError, pack_text
from morphgen.viewer.pages.compose import Facts, change_text
from morphgen.viewer.pages.compose_grammar import (
    NUM_OFFSPRING,
    change_lines,
    make_individual,
    mutants,
    pack_choices,
    unpack_choices,
)
from morphgen.viewer.scene.robot import hit_robot

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


def test_changes_are_said_in_one_line():
    before, after = Facts(5, 1.0, 1.084), Facts(6, 1.24, 1.678)
    assert change_text(before, after) == "5 to 6 DoF, reach 1.08 to 1.68 m, mass +0.24 kg"
    assert change_text(before, Facts(5, 1.001, None)) == ""


def test_changes_of_a_derivation_are_lines():
    before = parse_derivation("post=post(height=0.05)[top: beam1=beam(length=0.1971947)]")
    after = parse_derivation("post=post(height=0.05)[top: beam1=beam(length=0.3)]")
    assert change_lines(before, after) == ["beam1.length 0.197 to 0.3"]
    longer = parse_derivation(
        "post=post(height=0.05)[top: beam1=beam(length=0.3)[end: beam2=beam(length=0.1)]]"
    )
    assert change_lines(after, longer) == ["+ beam2 (beam on beam1:end)"]


def test_a_ray_hits_the_nearest_box():
    boxes = np.array([[[0, 0, 0], [1, 1, 1]], [[2, 0, 0], [3, 1, 1]]], dtype=float)
    inside = np.array([-1.0, 0.5, 0.5])
    assert hit_robot(boxes, inside, np.array([1.0, 0, 0])) == 0
    assert hit_robot(boxes, np.array([9.0, 0.5, 0.5]), np.array([-1.0, 0, 0])) == 1
    assert hit_robot(boxes, inside, np.array([-1.0, 0, 0])) is None
    assert hit_robot(boxes, inside, np.array([0, 0, 1.0])) is None


def test_a_robot_of_a_set_evolves_and_its_offspring_is_in_the_address(shared_viewer):
    with PlainClient(shared_viewer.port, "?compose=robots/prims/prims-000001") as client:
        client.control("Number", "generation")
        buttons = client.control("ButtonGroup", "show")
        client.shows("to go on with it")
        client.change(buttons, "mutants")
        client.shows('data-do="adopt" data-value="8"')
        client.until(lambda: "evolve=1" in client.text)


def test_mutants_of_a_robot_without_a_grammar_need_no_other_button(shared_viewer):
    with PlainClient(shared_viewer.port, "?compose=base=gantry ee=cube") as client:
        client.shows("This robot has no grammar whose choices could be drawn again")
        client.change(client.control("ButtonGroup", "show"), "mutants")
        client.shows('data-do="adopt" data-value="8"')

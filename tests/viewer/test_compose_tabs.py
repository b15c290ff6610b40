"""The tabs of the compose page: words by parts and parameters, derivations, and grammars."""

from urllib.parse import unquote

import pytest

from helpers.viser_client import PlainClient
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.syntax import parse_derivation
from morphgen.viewer.pages import compose as pages

LIBRARY = default_library()
WORDS = "base=pedestal left.arm=ur5 left.ee=plane right.ee=stick left.ee.size=0.1 base.height=0.7"


def changed(text, key, value):
    return joined(pages.with_word(pages.split_words(text), key, value, LIBRARY))


def joined(words):
    return " ".join(f"{key}={value}" for key, value in words.items())


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ("=", "is not of the form key=value"),
        ("arm=ur5 ee.size=1", "ee.size=1: no part is chosen"),
        ("arm=ur5 arm.size=1", "arm.size: "),
        ("arm=ur6", "did you mean"),
        ("base=fixd", "did you mean"),
    ],
)
def test_invalid_words_are_rejected(words, why, shared_viewer):
    with PlainClient(shared_viewer.port, f"?compose={words}") as client:
        client.shows(why)


@pytest.mark.parametrize(
    ("words", "slots"),
    [
        ("ee=stick", "arm ee left.arm left.ee right.arm right.ee"),
        ("arm=ur5", "arm ee left.arm right.arm"),
        ("arm=ur5 left.arm=ur5", "arm ee left.arm left.ee right.arm"),
        ("arm=yumi", "arm left.ee right.ee left.arm right.arm"),
        ("base=gantry arm=ur5", "arm ee"),
    ],
)
def test_parts_offer_slots_and_each_can_be_filled(words, slots):
    assert pages.slots_of(pages.split_words(words), LIBRARY) == slots.split()
    for slot in slots.split():
        part = "ur5" if slot.endswith("arm") else "stick"
        filled = changed(words, slot, part)
        assert f"{slot}={part}" in filled.split()
        parse_words(filled.split(), LIBRARY)


def sliders(client, last):
    client.control("Slider", last)
    messages = [m["props"] for m in client.messages if m["type"] == "GuiSliderMessage"]
    return {props["label"]: props for props in messages}


def test_a_typed_number_draws_that_robot_and_a_grammar_is_saved(shared_viewer):
    with PlainClient(shared_viewer.port, "?compose=planar_arm") as client:
        client.change(client.control("Number", "robot number"), 2)
        client.shows("planar_arm-000002")
        client.until(lambda: client.addresses[-1][1] == "?compose=planar_arm&seed=0&number=2")
        client.change(client.control("Button", "Save the grammar"))
        client.shows("planar_arm.grammar")


def test_a_robot_of_a_set_offers_the_grammar_of_the_set(shared_viewer):
    with PlainClient(shared_viewer.port, "?compose=robots/prims/prims-000001&evolve=2") as client:
        client.control("Number", "robot number")
        client.shows("robots/prims/grammar.grammar")
        client.until(lambda: client.addresses and "evolve" not in client.addresses[-1][1])


def test_every_parameter_has_a_slider_with_its_range(shared_viewer):
    query = "?compose=arm=arm3 base=pedestal arm.length=0.4"
    with PlainClient(shared_viewer.port, query) as client:
        shown = sliders(client, "mount yaw (rad)")
        names = list(shown)
        assert names.index("mount yaw (rad)") > names.index("wrist")  # the base has no mount
        length = shown["length (m)"]
        assert (length["min"], length["max"]) == (0.1, 0.5)
        assert shown["wrist"]["step"] == 1.0
        assert [mark["label"] for mark in shown["mount yaw (rad)"]["_marks"]] == ["-6.28", "6.28"]
        client.shows('"?compose=base=pedestal%20arm=arm3%20arm.length=0.4"')
        client.change(client.control("Slider", "length (m)"), 0.3)
        client.shows('"?compose=base=pedestal%20arm=arm3"')  # the default


def test_changing_a_part_resets_its_parameters():
    other = changed(WORDS, "left.ee", "stick").split()
    assert "base.height=0.7" in other
    assert "left.ee.size=0.1" not in other
    assert "left.arm" not in changed(WORDS, "left.arm", "")


def test_changing_the_base_keeps_limbs_with_matching_ports():
    words = "base=pedestal arm=ur5 left.arm=ur5 left.ee=stick"
    assert changed(words, "base", "gantry") == "base=gantry arm=ur5"
    assert changed(words, "base", "planar") == words.replace("pedestal", "planar")


@pytest.mark.parametrize("words", [WORDS, "base=planar ee=cube", "arm=arm3 ee=claw ee.mount_yaw=1"])
def test_a_derivation_of_words_is_edited_by_its_parts(words):
    derivation, _ = parse_words(words.split(), LIBRARY)
    again = joined(pages.words_of(derivation, LIBRARY))
    assert parse_words(again.split(), LIBRARY)[0] == derivation


@pytest.mark.parametrize(
    "text", ["arm3=arm3(length=0.3)[flange: claw=claw]", "body=cubes(size=0.1, travel=1)"]
)
def test_a_derivation_of_another_shape_has_no_words(text):
    assert pages.words_of(parse_derivation(text), LIBRARY) is None


def test_a_derivation_has_a_slider_for_each_of_its_values(shared_viewer):
    query = "?compose=derivation:post=post(height=0.05)[top: beam1=beam(length=0.2)]"
    with PlainClient(shared_viewer.port, query) as client:
        assert list(sliders(client, "length (m)"))[:2] == ["height (m)", "length (m)"]
        client.change(client.control("Slider", "length (m)"), 0.3)
        client.until(lambda: "beam(length=0.3)" in unquote(client.addresses[-1][1]))

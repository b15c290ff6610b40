"""``key=value`` words: parsed to a derivation, or fixing choices of a grammar."""

import pytest

from helpers.grammars import LIBRARY, grammar, shipped
from morphgen.errors import MorphgenError
from morphgen.grammar.derive import FirstChooser, derive
from morphgen.grammar.request import default_name, parse_request, parse_words, pin
from morphgen.grammar.sampling import sample_robots


def derived(text):
    return parse_request(text.split(), LIBRARY)


def test_an_arm_has_a_fixed_base_and_no_end_effector_by_default():
    assert str(derived("arm=ur5")) == "base=fixed(spread=0.6)[top: arm=ur5[flange: ee=none]]"


def test_order_of_words_does_not_matter():
    a = derived("arm=ur5 ee=plane ee.size=80mm")
    assert a == derived("ee.size=0.08 ee=plane arm=ur5")
    assert a.digest == derived("ee.size=80mm ee=plane base=fixed arm=ur5").digest
    limbs = ["left.arm=ur5", "left.ee=stick", "right.arm=lwr", "right.ee=plane"]
    assert derived(" ".join(limbs)) == derived(" ".join(limbs[::-1]))


def test_limbs_attach_to_named_ports():
    text = "base=pedestal left.arm=ur5 left.ee=stick right.arm=xarm7 right.ee=panda_hand"
    derivation = derived(text)
    assert [port for port, _ in derivation.children] == ["left", "right"]
    labels = [node.label for node in derivation.walk()]
    assert labels == ["base", "left_arm", "left_ee", "right_arm", "right_ee"]
    assert default_name(derivation, LIBRARY) == "pedestal-left-ur5-stick-right-xarm7-panda_hand"


def test_an_arm_with_two_ports_takes_an_end_effector_on_each():
    derivation = derived("arm=yumi left.ee=yumi_gripper")
    assert [node.label for node in derivation.walk()] == ["base", "arm", "left_ee", "right_ee"]
    assert [node.part for node in derivation.walk()][2:] == ["yumi_gripper", "none"]


def test_an_end_effector_may_attach_to_the_base():
    assert default_name(derived("base=gantry ee=plane"), LIBRARY) == "gantry-plane"


def test_different_robots_have_different_names():
    ports = ("left.ee", "right.ee", "ee")
    texts = ["arm=yumi left.ee=stick", "arm=yumi right.ee=stick"]
    texts += [f"base=pedestal {port}=stick" for port in ports]
    assert len({default_name(derived(text), LIBRARY) for text in texts}) == len(texts)


def test_the_name_marks_changed_parameters():
    plain = default_name(derived("arm=ur5 ee=plane"), LIBRARY)
    small = default_name(derived("arm=ur5 ee=plane ee.size=80mm"), LIBRARY)
    turned = default_name(derived("arm=ur5 ee=plane ee.mount_yaw=90deg"), LIBRARY)
    assert plain == "ur5-plane"
    assert small.startswith("ur5-plane-")
    assert len({plain, small, turned}) == 3


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm=ur55", "unknown arm 'ur55'; did you mean 'ur5'"),
        ("arm=ur5 ee=plane ee.sise=1", "no parameter 'sise'; did you mean 'size'"),
        ("arm=ur5 arm=ur3", "arm is given twice"),
        ("arm=ur5 ee.size=1", "no part is chosen for 'ee'"),
        ("arm=ur5 legs=4", "legs=4: unknown key 'legs'; valid: arm, base, ee, object, a limb such"),
        ("arm=ur5 ee=plane ee_size=80mm", "unknown key 'ee_size'; did you mean 'ee.size'? valid: "),
        ("arm=ur5 ee=plane e.size=80mm", "chosen for 'e'; did you mean 'ee.size'? valid: arm"),
        ("left.arm=ur5 left.ee=plane left_ee_size=1", "did you mean 'left.ee.size'"),
        ("arm", "not of the form key=value"),
        ("base=fixed", "nothing to compose"),
        ("up.arm=ur5", "'fixed' has no port 'up'"),
        ("a.b.arm=ur5", "PORT.arm"),
        ("arm=yumi ee=plane", "'yumi' has no port 'flange'"),
    ],
)
def test_invalid_requests_are_errors(text, message):
    with pytest.raises(MorphgenError, match=r"^[^\n]*$") as caught:
        derived(text)
    assert message in str(caught.value)


def test_a_grammar_names_the_parameter_that_was_meant():
    with pytest.raises(MorphgenError, match=r"no symbol 'claw_size'; did you mean 'claw\.size'"):
        parse_words(["arm3", "claw_size=1"], LIBRARY)


def parts(links_grammar, *words):
    tree = derive(pin(links_grammar, words, LIBRARY), LIBRARY, FirstChooser())
    return [node.part for node in tree.walk()]


def values(links_grammar, *words):
    tree = derive(pin(links_grammar, words, LIBRARY), LIBRARY, FirstChooser())
    return {node.label: dict(node.parameters) for node in tree.walk()}


@pytest.fixture(scope="module")
def links_grammar():
    return grammar(
        "let r = uniform(1cm, 2cm)",
        "robot -> base links ee",
        "base -> slides | gantry",
        "links -> bead(radius=r, rod=uniform(3cm, 5cm)){2,4} | beam",
        "ee -> plane | stick(length=uniform(0.1, 0.2))",
    )


def test_a_symbol_can_be_pinned_to_an_alternative_and_a_repetition_to_a_count(links_grammar):
    assert parts(links_grammar) == ["slides", "bead", "bead", "plane"]
    assert parts(links_grammar, "links=4").count("bead") == 4
    pinned = parts(links_grammar, "base=gantry", "links=beam", "ee=stick")
    assert pinned == ["gantry", "beam", "stick"]


def test_a_parameter_is_pinned_for_every_instance_of_the_part(links_grammar):
    pinned = values(links_grammar, "bead.rod=80mm", "slides.low=0.3", "plane.mount_yaw=90deg")
    assert pinned["ee"]["mount_yaw"] == pytest.approx(1.57079632679)
    assert [pinned[bead]["rod"] for bead in ("bead1", "bead2")] == [0.08, 0.08]
    assert pinned["bead1"]["radius"] == pytest.approx(0.015)
    assert pinned["base"]["low"] == 0.3


@pytest.mark.parametrize("text", ["r=0.02", "r=20mm", "r=+2cm"])
def test_a_let_can_be_pinned_with_or_without_a_unit(links_grammar, text):
    assert values(links_grammar, text)["bead1"]["radius"] == pytest.approx(0.02)


def test_the_order_of_words_does_not_matter(links_grammar):
    words = ["links=3", "bead.rod=80mm", "ee=stick", "r=2cm"]
    assert values(links_grammar, *words) == values(links_grammar, *reversed(words))


def test_pinned_choices_are_the_same_in_every_sample(links_grammar):
    drawn = list(sample_robots(pin(links_grammar, ["links=2", "r=2cm"], LIBRARY), LIBRARY, 3))
    assert {str(d.derivation).count("=bead") for d in drawn} == {2}
    assert all("radius=0.02" in str(d.derivation) for d in drawn)


@pytest.mark.parametrize(
    ("word", "message"),
    [
        ("links", "'links' is not of the form key=value, such as beads=5"),
        ("linsk=3", "linsk=3: no symbol 'linsk'; did you mean 'links'? valid: base, ee, links, r"),
        ("links=7", "links=7: expected 2 to 4"),
        ("base=2", "base=2: 'base' has 0 repetitions to pin, not one"),
        ("ee=spoon", "ee=spoon: no such alternative; valid: plane, stick"),
        ("bead.rood=1cm", "'bead' has no parameter 'rood'; did you mean 'rod'? valid: mount_yaw"),
        ("baed.rod=1cm", "baed.rod: no part 'baed' in 'g'; did you mean 'bead'?"),
        ("r=wide", "r=wide: not a number, such as 0.02 or 20mm"),
        ("r=2inch", "r=2inch:1:1: unknown unit 'inch'"),
        ("r=2cm+", "r=2cm+:1:5: found the end, expected"),
    ],
)
def test_an_unknown_pin_is_an_error(links_grammar, word, message):
    with pytest.raises(MorphgenError, match=r"^[^\n]*$") as caught:
        pin(links_grammar, [word], LIBRARY)
    assert message in str(caught.value)


def test_a_pinned_value_with_a_wrong_unit_is_an_error_at_its_use(links_grammar):
    with pytest.raises(MorphgenError, match="radius is in m, r in rad"):
        values(links_grammar, "r=2deg")


def test_words_may_begin_with_a_grammar():
    derivation, name = parse_words(["chain", "beads=5", "bead.radius=0.02"], LIBRARY)
    assert [node.part for node in derivation.walk()] == ["slides", *["bead"] * 5]
    assert name.startswith("chain-")
    assert parse_words(["chain"], LIBRARY)[1] == "chain"


def test_only_a_repetition_with_a_range_can_be_pinned():
    two = grammar("robot -> post links", "links -> beam{1,2} bead{1,2} | jaw")
    with pytest.raises(MorphgenError, match="'links' has 2 repetitions to pin, not one"):
        parts(two, "links=2")
    assert parts(shipped("nlink"), "links=3").count("beam") == 3

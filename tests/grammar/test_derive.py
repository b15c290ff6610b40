"""Requests and the derivations that they give."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from helpers.grammars import LIBRARY, grammar, shipped
from morphgen.errors import GrammarError, MorphgenError
from morphgen.grammar.derive import (
    Chooser,
    RandomChooser,
    TooManyPartsError,
    derive,
)
from morphgen.grammar.request import default_name, parse_request, parse_words, pin
from morphgen.grammar.syntax import MAX_PARTS, Derivation, parse_derivation


def first(*lines):
    return derive(grammar(*lines), LIBRARY, Chooser())


def draw(robot_grammar, seed=0):
    return derive(robot_grammar, LIBRARY, RandomChooser(np.random.default_rng(seed)))


def labels(derivation):
    return [node.label for node in derivation.walk()]


def places(derivation):
    """Return label, parent and port of every part but the first."""
    nodes = derivation.walk()
    return [f"{c.label}@{node.label}:{port}" for node in nodes for port, c in node.children]


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        # The label of a symbol of one part, and of the parts of a symbol of several.
        (["robot -> base arm", "base -> fixed", "arm -> any", "any -> ur5"], "base arm"),
        (["robot -> fixed limb", "limb -> ur5 ee", "ee -> stick"], "fixed ur5 ee"),
        # Repeated parts are numbered, even if there is only one.
        (["robot -> post beam{3} plane"], "post beam1 beam2 beam3 plane"),
        (["robot -> post beam{1}"], "post beam1"),
        (["robot -> post a{2}", "a -> beam bead"], "post a1_beam a1_bead a2_beam a2_bead"),
        (["robot -> post beam beam beam"], "post beam beam_2 beam_3"),
    ],
)
def test_labels_follow_symbols_and_copies(lines, expected):
    assert labels(first(*lines)) == expected.split()


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        # Labels of a limb start with its port.
        (
            ["robot -> pedestal left:limb right:limb", "limb -> arm ee", "arm -> ur5", "ee -> jaw"],
            "left_arm@pedestal:left right_arm@pedestal:right "
            "left_ee@left_arm:flange right_ee@right_arm:flange",
        ),
        # Items without a port attach to the trunk, not to a limb.
        (
            ["robot -> pedestal left:ur5 panda stick"],
            "left_ur5@pedestal:left panda@pedestal:top stick@panda:flange",
        ),
        # Ports can be named inside the symbol of their part.
        (
            ["robot -> fixed torso", "torso -> yumi left:yumi_gripper right:none"],
            "yumi@fixed:top left_yumi_gripper@yumi:left right_none@yumi:right",
        ),
    ],
)
def test_parts_attach_to_ports_which_label_limbs(lines, expected):
    assert places(first(*lines)) == expected.split()


def test_all_parameters_are_recorded_and_mount_yaw_only_if_set():
    tree = first("let r = 3cm", "robot -> gantry plane(size=2*r) ")
    assert dict(tree.children[0][1].parameters) == {"size": 0.06, "thickness": 0.01}
    turned = first("robot -> gantry plane(mount_yaw=90deg)")
    assert dict(turned.children[0][1].parameters)["mount_yaw"] == pytest.approx(np.pi / 2)
    assert "mount_yaw" not in str(first("robot -> gantry plane(mount_yaw=0)"))
    whole = first("robot -> gantry plane(mount_yaw=360deg)")  # in range after rounding
    assert "mount_yaw=6.28318530718" in str(whole)


def test_a_let_is_drawn_once_and_an_argument_once_per_copy():
    shared = draw(grammar("let r = uniform(0.1, 0.5)", "robot -> post beam(length=r){4}"))
    per_copy = draw(grammar("robot -> post beam(length=uniform(0.1, 0.5)){4}"))
    lengths = [[n.parameters[0][1] for n in tree.walk()][1:] for tree in (shared, per_copy)]
    assert len(set(lengths[0])) == 1
    assert len(set(lengths[1])) == 4


def test_two_distributions_in_one_expression_are_drawn_independently():
    recorded = RandomChooser(np.random.default_rng(0))
    robot_grammar = grammar("robot -> gantry plane(size=uniform(0.1, 0.2) + uniform(0.1, 0.2))")
    derive(robot_grammar, LIBRARY, recorded)
    assert list(recorded.choices) == ["robot/1.plane.size", "robot/1.plane.size~2"]


def test_the_first_chooser_takes_the_first_possible_alternative_and_the_smallest_count():
    tree = first(
        "robot -> post links ee",
        "links -> beam(length=uniform(0.1, 0.5)){2,5}",
        "ee -> @weight(0) jaw | claw(size=choice(0.03, 0.05)) | plane",
    )
    assert labels(tree) == ["post", "beam1", "beam2", "ee"]
    assert dict(tree.children[0][1].parameters)["length"] == pytest.approx(0.3)
    assert [node.part for node in tree.walk()][-1] == "claw"


def test_weights_are_relative_probabilities():
    robot_grammar = grammar(
        "robot -> @weight(3) cubes | @weight(2*0.5) cartpole | @weight(0) gantry | post"
    )
    rng = np.random.default_rng(0)
    parts = [derive(robot_grammar, LIBRARY, RandomChooser(rng)).part for _ in range(2000)]
    shares = [parts.count(part) / 2000 for part in ("cubes", "cartpole", "gantry", "post")]
    assert shares == pytest.approx([0.6, 0.2, 0, 0.2], abs=0.04)
    assert shares[2] == 0


def test_a_weight_may_be_random():
    robot_grammar = grammar(
        "let w = choice(0, 1)",
        "robot -> @weight(w) cubes | @weight(1 - w) cartpole | @weight(0) post",
    )
    for seed in range(20):
        recorded = RandomChooser(np.random.default_rng(seed))
        part = derive(robot_grammar, LIBRARY, recorded).part
        assert part == ("cubes" if recorded.choices["let w"] else "cartpole")


def test_repetition_counts_are_uniform():
    robot_grammar = grammar("robot -> post beam{2,4}")
    rng = np.random.default_rng(0)
    drawn = [derive(robot_grammar, LIBRARY, RandomChooser(rng)) for _ in range(900)]
    counts = [len(labels(tree)) - 1 for tree in drawn]
    assert [counts.count(n) / 900 for n in (2, 3, 4)] == pytest.approx([1 / 3] * 3, abs=0.05)


@pytest.mark.parametrize(
    "lines",
    [
        ("robot -> slides tail", "tail -> bead tail"),
        ("robot -> slides tail", "tail -> tail"),
        ("robot -> slides a", "a -> bead b", "b -> bead a"),
    ],
)
def test_an_endless_recursion_is_an_error(lines):
    with pytest.raises(TooManyPartsError, match=r"^g:\d:\d: "):
        first(*lines)


def test_no_robot_has_more_parts_than_allowed():
    robot_grammar = grammar("robot -> slides bead{99}")
    assert sum(1 for _ in derive(robot_grammar, LIBRARY, Chooser()).walk()) == MAX_PARTS == 100
    with pytest.raises(TooManyPartsError, match="more than 100 parts: does it end"):
        first("robot -> slides bead{100}")


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["robot -> gantry plane(size=9)"], "1:28: plane.size=9: out of range; expected 0.02 to"),
        (["robot -> fixed hand(fingers=2.5)"], "1:29: hand.fingers=2.5: not a whole number"),
        (["robot -> fixed yumi stick"], "1:21: name the port of 'yumi', such as left:stick"),
        (["robot -> pedestal left:ur5 left:ur3"], "1:33: port 'left' of 'pedestal' is already"),
        (["robot -> @weight(-1) ur5 | panda"], "g:1:18: a weight is negative: -1"),
        (["let r = q", "robot -> cubes"], "g:1:9: unknown value 'q'"),
    ],
)
def test_derivation_errors_have_a_position(lines, message):
    with pytest.raises(GrammarError, match=r"^g:[^\n]*$") as caught:
        first(*lines)
    assert message in str(caught.value)


def test_labels_are_unique_for_random_derivations():
    robot_grammar = grammar(
        "robot -> pedestal left:limb right:limb limb",
        "limb -> beam{1,3} | beam2 beam1 | limb beam",
        "beam1 -> beam",
        "beam2 -> beam",
    )
    for seed in range(50):
        names = labels(draw(robot_grammar, seed))
        assert len(set(names)) == len(names)


NAMES = st.from_regex(r"[a-z_][a-z0-9_]{0,8}", fullmatch=True)
VALUES = st.tuples(NAMES, st.floats(-1e3, 1e3).map(lambda x: float(f"{x:.12g}")))


def some(entries):
    return st.lists(entries, max_size=3).map(tuple)


PARAMETERS = some(VALUES)
TREES = st.recursive(
    st.builds(Derivation, NAMES, NAMES, PARAMETERS),
    lambda below: st.builds(Derivation, NAMES, NAMES, PARAMETERS, some(st.tuples(NAMES, below))),
    max_leaves=8,
)


@settings(max_examples=50)
@given(TREES)
def test_printing_and_parsing_a_derivation_round_trips(tree):
    assert str(parse_derivation(str(tree))) == str(tree)
    assert parse_derivation(str(tree)).digest == tree.digest


@pytest.mark.parametrize("text", ["", "arm", "arm=ur5(", "arm=ur5[top ee=x]", "a=b(c=d)", "a=b]"])
def test_invalid_derivations_are_errors_with_a_position(text):
    with pytest.raises(GrammarError, match=r"^card:1:\d+: invalid derivation"):
        parse_derivation(text, "card")


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
    assert labels(derivation) == ["base", "left_arm", "left_ee", "right_arm", "right_ee"]
    assert default_name(derivation, LIBRARY) == "pedestal-left-ur5-stick-right-xarm7-panda_hand"


def test_an_arm_with_two_ports_takes_an_end_effector_on_each():
    derivation = derived("arm=yumi left.ee=yumi_gripper")
    assert labels(derivation) == ["base", "arm", "left_ee", "right_ee"]
    assert [node.part for node in derivation.walk()][2:] == ["yumi_gripper", "none"]


def test_different_robots_have_different_names_of_their_parts_and_a_mark_of_changed_parameters():
    texts = ["arm=ur5 ee=plane", "arm=ur5 ee=plane ee.size=80mm", "base=gantry ee=plane"]
    texts += ["arm=ur5 ee=plane ee.mount_yaw=90deg"]
    texts += [f"arm=yumi {port}.ee=stick" for port in ("left", "right")]
    texts += [f"base=pedestal {port}=stick" for port in ("left.ee", "right.ee", "ee")]
    names = [default_name(derived(text), LIBRARY) for text in texts]
    assert len(set(names)) == len(texts)
    assert (names[0], names[2]) == ("ur5-plane", "gantry-plane")
    assert names[1].startswith("ur5-plane-")


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


def pinned_nodes(links_grammar, *words):
    return derive(pin(links_grammar, words, LIBRARY), LIBRARY, Chooser()).walk()


def parts(*grammar_and_words):
    return [node.part for node in pinned_nodes(*grammar_and_words)]


def values(*grammar_and_words):
    return {node.label: dict(node.parameters) for node in pinned_nodes(*grammar_and_words)}


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

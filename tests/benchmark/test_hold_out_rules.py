"""Rules of what a split holds out, and the patterns of the robots that it draws from."""

import pytest

from morphgen.benchmark.hold_out import held_out_parts, parse_rules, parts_name, unique_names
from morphgen.benchmark.regimes import pattern_robots
from morphgen.errors import BenchmarkError, CompositionError, PartError
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words

LIBRARY = default_library()


def robot(words):
    return parse_words(words.split(), LIBRARY)[0]


@pytest.mark.parametrize(
    ("rule", "words", "holds"),
    [
        ("arm=kinova*", "arm=kinova_gen3 ee=plane", True),
        ("arm=kinova*", "arm=mico ee=plane", False),
        ("ee=plane", "arm=lwr ee=plane", True),
        ("arm=plane", "arm=lwr ee=plane", None),
        ("base=fixed", "arm=lwr", True),
        ("manufacturer=kinova", "arm=mico ee=plane", True),
        ("manufacturer=Kin*", "arm=lwr ee=jaco_fingers", True),
        ("arm.manufacturer=Kinova", "arm=lwr ee=jaco_fingers", False),
        ("manufacturer=*", "arm=arm3 ee=plane", False),
        ("arm=lwr+ee=plane", "arm=lwr ee=plane", True),
        ("arm=lwr+ee=plane", "arm=lwr ee=stick", False),
        ("arm3.length=0.3..0.4", "arm=arm3 ee=plane arm.length=0.4", True),
        ("arm3.length=0.3..0.4", "arm=arm3 ee=plane arm.length=0.401", False),
        ("arm3.length=..25cm", "arm=arm3 arm.length=0.2", None),
        ("ee.size=5cm..0.2", "arm=lwr ee=plane", True),
        ("ee.size=5cm..0.2", "arm=lwr ee=stick", False),
        ("ee.mount_yaw=45deg..90deg", "arm=lwr ee=plane ee.mount_yaw=1", True),
        ("ee.mount_yaw=45deg..90deg", "arm=lwr ee=plane", False),
        ("hand.fingers=3..3", "arm=lwr ee=hand", True),
    ],
)
def test_a_rule_holds_for_robots_with_what_it_names(rule, words, holds):
    if holds is None:
        with pytest.raises(BenchmarkError):
            parse_rules([rule], LIBRARY)
        return
    (parsed,) = parse_rules([rule], LIBRARY)
    assert parsed.holds(robot(words), LIBRARY) is holds


def test_the_text_of_a_rule_gives_the_same_rule():
    texts = [
        "arm=kinova*", "manufacturer=Kinova", "arm.manufacturer=ABB", "arm3.length=30cm..0.4",
        "arm=ur5+ee=plane",
    ]  # fmt: skip
    rules = parse_rules([",".join(texts)], LIBRARY)
    assert parse_rules([str(rule) for rule in rules], LIBRARY) == rules
    assert [str(rule) for rule in rules][3:] == ["arm3.length=0.3..0.4", "arm=ur5+ee=plane"]


def test_only_rules_of_one_part_hold_out_the_part_itself():
    rules = parse_rules(["ee=stick", "arm=lwr+ee=plane", "lwr.upper=0.3..0.5"], LIBRARY)
    assert held_out_parts(rules, robot("arm=lwr ee=stick"), LIBRARY) == {"stick"}
    assert held_out_parts(rules, robot("arm=lwr ee=plane"), LIBRARY) == set()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm=kinva*", "--hold-out arm=kinva*: no arm matches 'kinva*'; did you mean"),
        ("amr=ur5", "unknown key 'amr'; did you mean 'arm'? valid: arm, base, body, ee, manu"),
        ("arm", "--hold-out arm: expected KEY=VALUE, such as arm=kinova*, manufacturer=Kinova"),
        ("arm=ur5,", "--hold-out arm=ur5,: empty rule: expected KEY=VALUE"),
        ("arm=ur5+", "empty rule: expected KEY=VALUE"),
        ("arm=ur5,arm=ur5", "arm=ur5 is there twice"),
        ("manufacturer=Kinvoa", "no manufacturer 'Kinvoa'; did you mean 'Kinova'? valid: ABB"),
        ("ee.manufacturer=KUKA", "no manufacturer 'KUKA'; "),
        ("amr3.length=0.1..0.2", "no part matches 'amr3'; did you mean 'arm3'"),
        ("arm3.lenght=0.1..0.2", "arm3 has no parameter 'lenght'; did you mean 'length'? valid"),
        ("arm3.length=0.3", "'0.3' is no range; expected LOW..HIGH, such as 0.3..0.4"),
        ("arm3.length=0.3..0.9", "arm3.length=0.9: out of range; expected 0.1 to 0.5 m"),
        ("arm3.length=0.3..x", "arm3.length=x: not a number; expected 0.1 to 0.5 m"),
        ("arm3.length=0.3..10deg", "wrong unit 'deg'"),
        ("arm3.length=0.4..0.3", "0.4 is above 0.3"),
        ("hand.fingers=2..2.5", "not a whole number"),
        ("ee.*=1..2", "ee has no parameter '*'"),
    ],
)
def test_an_invalid_rule_is_an_error_that_names_it(text, message):
    with pytest.raises(BenchmarkError) as caught:
        parse_rules([text], LIBRARY)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"--hold-out {text}")


def test_a_wildcard_stands_for_the_parts_that_fit():
    names = [each.name for each in pattern_robots("arm={lwr,yumi*} ee=pl*", LIBRARY)]
    assert names == ["lwr-plane", "yumi_left-plane", "yumi_right-plane"]
    assert len(pattern_robots("arm=lwr ee=*", LIBRARY)) == len(LIBRARY.names("ee")) - 1
    with pytest.raises(CompositionError, match="'yumi' has no port 'flange'"):
        pattern_robots("arm={lwr,yumi} ee=plane", LIBRARY)
    with pytest.raises(CompositionError, match="'yumi' has no port 'flange'"):
        pattern_robots("arm=yumi ee=*", LIBRARY)
    with pytest.raises(BenchmarkError, match=r"--from 'arm=q\*': no arm matches 'q\*'"):
        pattern_robots("arm=q*", LIBRARY)
    with pytest.raises(PartError, match="unknown ee 'plne'"):
        pattern_robots("arm=* ee=plne", LIBRARY)


def test_robots_are_named_after_their_parts():
    assert parts_name(robot("arm=kinova_gen3 ee=plane")) == "kinova_gen3+plane"
    assert parts_name(robot("base=gantry arm=lwr")) == "gantry+lwr"
    two = robot("base=pedestal left.arm=lwr left.ee=plane right.arm=lwr right.ee=plane")
    assert parts_name(two) == "pedestal+left-lwr+left-plane+right-lwr+right-plane"
    chain = parse_derivation("a=slides[top: b=bead[end: c=bead[end: d=claw]]]")
    assert parts_name(chain) == "slides+2xbead+claw"
    assert parts_name(parse_derivation("base=fixed")) == "fixed"
    assert unique_names([chain, two, chain, chain])[2:] == [
        "slides+2xbead+claw-2",
        "slides+2xbead+claw-3",
    ]

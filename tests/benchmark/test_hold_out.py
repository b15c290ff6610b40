"""Splits by what they hold out: rules, patterns, strata, repeated robots, errors and audits."""

from collections import Counter
from dataclasses import replace

import pytest

from helpers.splits import LIBRARY, member, order, split
from morphgen.benchmark.hold_out import (
    hold_out,
    hold_out_findings,
    parse_rules,
    parts_name,
    unique_names,
)
from morphgen.benchmark.regimes import expand, pattern_robots
from morphgen.benchmark.survey import audit
from morphgen.errors import BenchmarkError, CompositionError, PartError
from morphgen.grammar.request import parse_words
from morphgen.grammar.syntax import parse_derivation
from morphgen.splits.split import (
    Member,
    RobotFactory,
    compose_member,
    parse_split,
    split_id,
    split_text,
)

pytestmark = pytest.mark.usefixtures("composed_once")

ARMS = ("arm3", "arm5", "arm_ed", "lwr")
EES = ("cube", "cylinder", "plane", "sphere", "stick")
PRIMITIVE = f"arm={{{','.join(ARMS)}}} ee={{{','.join(EES)}}}"
"""Twenty robots without meshes, which are fast to compose."""


def made(rules, *train, patterns=(PRIMITIVE,), **changes):
    """Return the largest split of a request."""
    return hold_out(order(*train, **changes), rules, LIBRARY, patterns=patterns)[-1]


def part_counts(members, kind):
    counts = Counter()
    for each in members:
        nodes = parse_derivation(each.derivation).walk()
        counts.update(n.part for n in nodes if LIBRARY.manifest(n.part).kind == kind)
    return counts


def require_sound(example, rules):
    """Assert that the sides obey the rules, that no robot is there twice and that it passes."""
    parsed = parse_rules(rules, LIBRARY)
    for side, is_held_out in ((example.train, False), (example.test, True)):
        for each in side:
            derivation = parse_derivation(each.derivation)
            assert any(rule.holds(derivation, LIBRARY) for rule in parsed) is is_held_out
    hashes = [each.robot_hash for each in (*example.train, *example.test)]
    assert len(hashes) == len(set(hashes))
    report = audit(example, LIBRARY)
    assert (report.findings, report.passed(strict=True)) == ((), True)


def test_parts_are_held_out_and_each_appears_before_one_appears_twice():
    example = made(["ee=plane"], 8, test=4)
    require_sound(example, ["ee=plane"])
    assert example.regime == "hold-out"
    assert set(part_counts(example.train, "arm").values()) == {2}
    assert set(part_counts(example.train, "ee").values()) == {2}
    assert set(part_counts(example.test, "arm").values()) == {1}
    assert {m.name.partition("+")[2] for m in example.test} == {"plane"}
    for each in (*example.train, *example.test):
        nodes = parse_derivation(each.derivation).walk()
        assert each.name == "+".join(n.part for n in nodes if n.part != "fixed")
    assert compose_member(example.test[0], LIBRARY).name == example.test[0].name


def test_each_rule_is_tested_before_one_is_tested_twice():
    rules = ["arm=lwr", "ee=stick", "arm=arm3+ee=plane"]
    example = made(rules, 4, test=3)
    require_sound(example, rules)
    parsed = parse_rules(rules, LIBRARY)
    for rule in parsed:
        assert any(rule.holds(parse_derivation(m.derivation), LIBRARY) for m in example.test)


def test_both_parts_of_a_held_out_pair_are_trained():
    for seed in range(3):
        example = made(["arm=lwr+ee=plane"], 2, seed=seed)
        require_sound(example, ["arm=lwr+ee=plane"])
        (test,) = example.test
        assert test.name == "lwr+plane"
        assert "lwr" in part_counts(example.train, "arm")
        assert "plane" in part_counts(example.train, "ee")


def test_the_same_body_of_two_parts_is_drawn_once(monkeypatch):
    make = RobotFactory.__call__

    def with_equal_hashes(self, recipe):
        robot = make(self, recipe)
        return replace(robot, hash="0" * 32) if "cube" in robot.name else robot

    monkeypatch.setattr(RobotFactory, "__call__", with_equal_hashes)
    message = r"--train 9: only 7 different robots without arm=lwr exist \(2 rejected: 2 with the s"
    with pytest.raises(BenchmarkError, match=message):
        made(["arm=lwr"], 9, patterns=("arm={arm3,arm5,arm_ed,lwr} ee={cube,plane,stick}",))


@pytest.mark.slow
def test_the_seed_gives_the_same_robots_in_any_number_of_processes():
    def splits(seed, jobs):
        wanted = order(8, test=2, seed=seed)
        return hold_out(wanted, ["ee=plane"], LIBRARY, patterns=[PRIMITIVE], jobs=jobs)

    assert splits(3, 1) == splits(3, 2)
    assert splits(3, 1) != splits(4, 1)


def test_nested_sizes_share_the_test_robots_and_train_all_their_parts():
    small, large = hold_out(order(3, 6, test=2), ["ee=plane"], LIBRARY, patterns=[PRIMITIVE])
    assert small.train == large.train[:3]
    assert small.test == large.test
    for each in (small, large):
        require_sound(each, ["ee=plane"])


@pytest.mark.parametrize(
    ("rules", "sizes", "changes", "message"),
    [
        (["ee=plane"], (17,), {}, "--train 17: only 16 different robots without ee=plane exist; "),
        (["ee=plane"], (4,), {"test": 5}, "--test 5: only 4 different robots with ee=plane, whose"),
        (["ee=plane", "ee=cube"], (4,), {}, "--test 1: 2 rules are held out, and each needs a te"),
        (["ee=*"], (4,), {}, "--train 4: no different robots without ee=* exist; ask for fewer"),
        (["arm=ur5"], (4,), {}, "--test 1: no different robots with arm=ur5, whose other parts"),
        (["arm=ur5", "ee=plane"], (4,), {"test": 2}, "--hold-out arm=ur5: no robots with it, who"),
        (["ee=plane"], (1,), {"test": 2}, "--train 1: no train robot has "),
        (["ee=plane"], (), {}, "--train and --test start at 1"),
        ([], (4,), {}, "--hold-out: nothing is held out; expected such as arm=kinova*"),
    ],
)
def test_an_impossible_request_is_an_error_that_says_what_exists(rules, sizes, changes, message):
    with pytest.raises(BenchmarkError) as caught:
        made(rules, *sizes, **changes)
    assert message in str(caught.value)


def test_robots_with_too_many_links_are_left_out_and_counted():
    patterns = ("arm=arm3 ee={cube,plane,stick,hand}",)
    example = made(["ee=plane"], 2, max_links=10, patterns=patterns)
    assert part_counts(example.train, "ee") == {"cube": 1, "stick": 1}
    assert example.provenance.get("left_out") in (None, {"more than 10 links": 1})
    message = r"\(1 rejected: 1 with more than 10 links; see --max-links\); ask"
    with pytest.raises(BenchmarkError, match=message):
        made(["ee=hand"], 2, max_links=10, patterns=patterns)


def test_the_file_has_hold_out_rules(tmp_path):
    example = made(["ee=plane,manufacturer=KUKA*"], 4, test=2)
    text = split_text(example)
    assert "  hold_out: [ee=plane, manufacturer=KUKA*]\n" in text
    stored = parse_split(text, tmp_path / "a.yaml")
    assert stored.id == split_id(stored.split)
    assert stored.split == replace(example, provenance=stored.split.provenance)
    assert stored.split.provenance == example.provenance


RULES = {"hold_out": ["ee=plane"]}
TRAIN = ("arm=lwr ee=cube", "arm=arm3 ee=cube")
TESTED = "arm=lwr ee=plane"


def uncomposed(words):
    """Return a split member whose robot is not composed."""
    derivation, name = parse_words(words.split(), LIBRARY)
    return Member(name, "composed", str(derivation), "reach", False, "0" * 32)


def stated(train, test, provenance=RULES, regime="hold-out"):
    """Return a split that says what it holds out, of robots that are not composed."""
    sides = (map(uncomposed, train), map(uncomposed, test))
    return split(*sides, regime=regime, provenance=provenance)


def codes(*sides_and_rules):
    findings = hold_out_findings(stated(*sides_and_rules), LIBRARY)
    return [(f.code, f.severity, f.where) for f in findings]


@pytest.mark.parametrize(
    ("train", "test", "rules", "code", "where"),
    [
        ("arm=arm3 ee=plane", TESTED, "ee=plane", "held-out-trained", "train robot arm3-plane"),
        (TRAIN[0], TRAIN[0], "ee=plane", "held-out-absent", "test robot lwr-cube"),
        (TRAIN[0], "arm=arm_ed ee=plane", "ee=plane", "part-unseen", "test robot arm_ed-plane"),
        (TRAIN[0], TESTED, "ee=plane,arm=ur5", "held-out-untested", "rule arm=ur5"),
        (TRAIN[0], TESTED, "arm=lwr+ee=plane", "part-unseen", "test robot lwr-plane"),
    ],
)
def test_the_audit_finds_each_violation(train, test, rules, code, where):
    assert codes(TRAIN, [TESTED]) == []
    sides = [*TRAIN, train], dict.fromkeys((TESTED, test))
    assert codes(*sides, {"hold_out": rules.split(",")}) == [(code, "error", where)]


def test_a_split_of_another_regime_may_say_what_it_holds_out():
    train = ["base=gantry ee=plane", "base=planar ee=cube", member("base=gantry ee=plane", "again")]
    example = split(train, ["base=planar ee=plane"], provenance={"hold_out": ["base=planar"]})
    found = {(f.code, f.severity, f.where) for f in audit(example, LIBRARY).findings}
    assert ("held-out-trained", "error", "train robot planar-cube") in found
    assert ("body-repeated", "error", "train robot again") in found


@pytest.mark.parametrize("rules", [None, "ee=plane", [1], [], ["ee=plnae"]])
def test_a_malformed_hold_out_is_an_error_that_names_the_split(rules):
    provenance = {} if rules is None else {"hold_out": rules}
    with pytest.raises(BenchmarkError, match="split 'mine/some': made: hold_out"):
        codes(TRAIN, ["arm=lwr ee=plane"], provenance)


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
        ("manufacturer=*", "arm=arm3 ee=plane", False),
        ("arm=lwr+ee=plane", "arm=lwr ee=plane", True),
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
    texts = "arm=kinova*,manufacturer=ABB"
    rules = parse_rules([f"{texts},arm=ur5+ee=plane"], LIBRARY)
    assert parse_rules([str(rule) for rule in rules], LIBRARY) == rules
    assert [str(rule) for rule in rules][1:] == ["manufacturer=ABB", "arm=ur5+ee=plane"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("arm=kinva*", "--hold-out arm=kinva*: no arm matches 'kinva*'; did you mean"),
        ("amr=ur5", "unknown key 'amr'; did you mean 'arm'? valid: arm, base, body, ee, manu"),
        ("arm3.length=0.3..0.4", "a range of a parameter is a rule of morphgen 0.3 alone; audit"),
        ("arm", "--hold-out arm: expected KEY=VALUE, such as arm=kinova*, manufacturer=Kinova"),
        ("arm=ur5,", "--hold-out arm=ur5,: empty rule: expected KEY=VALUE"),
        ("arm=ur5,arm=ur5", "arm=ur5 is there twice"),
        ("manufacturer=Kinvoa", "no manufacturer matches 'Kinvoa'; did you mean 'Kinova'?"),
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
    repeated = [f"slides+2xbead+claw-{number}" for number in (2, 3)]
    assert unique_names([chain, two, chain, chain])[2:] == repeated


def test_braces_are_expanded():
    assert expand("arm={ur5,lwr} ee=plane") == [("arm=ur5", "ee=plane"), ("arm=lwr", "ee=plane")]
    assert expand(" arm={ ur5 , lwr }  ") == [("arm=ur5",), ("arm=lwr",)]
    sizes = [words for (words,) in expand("ee.size={5,10}{cm,mm}")]
    assert sizes == ["ee.size=5cm", "ee.size=5mm", "ee.size=10cm", "ee.size=10mm"]
    assert expand("arm=ur5") == [("arm=ur5",)]


@pytest.mark.parametrize(
    ("pattern", "message"),
    [
        ("arm={ur5,lwr ee=plane", "a brace is not closed, or opened twice"),
        ("arm={ur5,{lwr}}", "a brace is not closed, or opened twice"),
        ("arm={ur5,,lwr}", r"{ur5,,lwr} has an empty choice"),
        ("arm={ur5,lwr,ur5}", "{ur5,lwr,ur5} has 'ur5' twice"),
        (" ", "--from is empty"),
    ],
)
def test_invalid_braces_are_errors(pattern, message):
    with pytest.raises(BenchmarkError) as caught:
        expand(pattern)
    assert message in str(caught.value)

"""Generating splits from what they hold out: sides, strata, repeated robots, errors and audits."""

from collections import Counter
from dataclasses import replace

import pytest

from helpers.grammars import grammar, shipped
from helpers.splits import member, split
from morphgen.benchmark import hold_out as hold_out_search
from morphgen.benchmark.audit import audit
from morphgen.benchmark.generate import SplitRequest
from morphgen.benchmark.hold_out import hold_out, hold_out_findings, parse_rules, related_parts
from morphgen.benchmark.regimes import parameters
from morphgen.benchmark.split import Member, compose_member, split_id
from morphgen.benchmark.split_file import parse_split, split_text
from morphgen.errors import BenchmarkError
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words

LIBRARY = default_library()
ARMS = ("arm3", "arm5", "arm_ed", "lwr")
EES = ("cube", "cylinder", "plane", "sphere", "stick")
PRIMITIVE = f"arm={{{','.join(ARMS)}}} ee={{{','.join(EES)}}}"
"""Twenty robots without meshes, which are fast to compose."""


def request(*train, test=1, **changes):
    return SplitRequest("mine", train, test, **changes)


def made(rules, *train, patterns=(PRIMITIVE,), grammars=(), **changes):
    """Return the largest split of a request."""
    return hold_out(
        request(*train, **changes), rules, LIBRARY, patterns=patterns, grammars=grammars
    )[-1]


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
        assert each.name == "+".join(
            n.part for n in parse_derivation(each.derivation).walk() if n.part != "fixed"
        )
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
        assert {"lwr", "plane"} <= {
            *part_counts(example.train, "arm"), *part_counts(example.train, "ee")
        }  # fmt: skip


def test_a_manufacturer_is_held_out():
    example = made(["manufacturer=kuka"], 4, test=2)
    require_sound(example, ["manufacturer=kuka"])
    assert set(part_counts(example.test, "arm")) == {"lwr"}


def lengths(members):
    return [parameters(parse_derivation(m.derivation), LIBRARY) for m in members]


@pytest.mark.parametrize("source", ["grammar", "pattern"])
def test_a_range_of_a_parameter_is_held_out(source):
    rules = ["arm3.length=0.3..0.4"]
    if source == "grammar":
        example = made(rules, 5, test=2, patterns=(), grammars=[shipped("arm3")])
        values = {side: [v["0.length"] for v in lengths(example.side(side))] for side in
                  ("train", "test")}  # fmt: skip
        assert [m.name for m in example.train[:2]] == ["arm3+claw", "arm3+claw-2"]
        assert [m.name for m in example.test] == ["arm3+claw-6", "arm3+claw-7"]
        assert "arm3" in example.provenance["grammars"]
    else:
        example = made(rules, 5, test=2, patterns=("arm=arm3 ee={cube,plane}",))
        values = {side: [v["1.length"] for v in lengths(example.side(side))] for side in
                  ("train", "test")}  # fmt: skip
    require_sound(example, rules)
    assert all(0.3 <= value <= 0.4 for value in values["test"])
    assert not any(0.3 <= value <= 0.4 for value in values["train"])
    assert len(set(values["train"])) == 5


def test_two_ranges_of_a_parameter_both_have_test_robots():
    rules = ["arm3.length=0.15..0.2", "arm3.length=0.4..0.45"]
    example = made(rules, 3, test=2, patterns=("arm=arm3 ee={cube,plane}",))
    require_sound(example, rules)
    low, high = sorted(v["1.length"] for v in lengths(example.test))
    assert 0.15 <= low <= 0.2
    assert 0.4 <= high <= 0.45


def test_values_that_a_pattern_sets_are_kept():
    pattern = "arm=arm3 arm.length={0.2,0.35} ee={cube,plane}"
    example = made(["arm3.length=0.3..0.4"], 2, test=2, patterns=(pattern,))
    assert {v["1.length"] for v in lengths(example.test)} == {0.35}
    assert {v["1.length"] for v in lengths(example.train)} == {0.2}


def test_draws_from_a_grammar_are_stratified_over_its_parts():
    rare = grammar(
        "robot -> arm ee",
        "arm -> @weight(50) arm3 | lwr | arm_ed",
        "ee -> plane(size=uniform(0.05, 0.2)) | cube(size=uniform(0.05, 0.2))",
    )
    example = made(["arm=lwr"], 4, test=2, patterns=(), grammars=[rare])
    require_sound(example, ["arm=lwr"])
    assert part_counts(example.train, "arm") == {"arm3": 2, "arm_ed": 2}
    assert part_counts(example.train, "ee") == {"plane": 2, "cube": 2}
    assert example.train[0].category == "g"


def test_repeated_robots_of_a_grammar_are_not_drawn():
    few = grammar("robot -> arm plane(size=choice(0.1, 0.2))", "arm -> arm3 | lwr | arm_ed")
    require_sound(made(["arm=lwr"], 4, test=2, patterns=(), grammars=[few]), ["arm=lwr"])
    with pytest.raises(
        BenchmarkError, match=r"--train 5: only 4 different robots without arm=lwr exist; ask"
    ):
        made(["arm=lwr"], 5, patterns=(), grammars=[few])


def test_the_same_body_of_two_parts_is_drawn_once(monkeypatch):
    compose = hold_out_search.ComposeDraft.__call__

    def with_equal_hashes(self, draft):
        robot = compose(self, draft)
        return replace(robot, hash="0" * 32) if "cube" in robot.name else robot

    monkeypatch.setattr(hold_out_search.ComposeDraft, "__call__", with_equal_hashes)
    with pytest.raises(BenchmarkError) as caught:
        made(["arm=lwr"], 9, patterns=("arm={arm3,arm5,arm_ed,lwr} ee={cube,plane,stick}",))
    assert (
        "--train 9: only 7 different robots without arm=lwr exist (2 rejected: 2 with the sa"
        in (str(caught.value))
    )


def test_the_seed_gives_the_same_bytes_and_another_seed_other_robots():
    first, again, other = (
        split_text(made(["ee=plane"], 4, test=2, seed=seed)) for seed in (3, 3, 4)
    )
    assert first == again
    assert first != other


@pytest.mark.slow
def test_the_number_of_processes_does_not_matter():
    one, two = (
        hold_out(request(8, test=2), ["ee=plane"], LIBRARY, patterns=[PRIMITIVE], jobs=jobs)
        for jobs in (1, 2)
    )
    assert one == two


def test_nested_sizes_share_the_test_robots_and_train_all_their_parts():
    small, large = hold_out(request(3, 6, test=2), ["ee=plane"], LIBRARY, patterns=[PRIMITIVE])
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
        (["ee=plane"], (), {}, "--train: say how many robots to train on"),
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
    assert example.provenance.get("left_out", {"more than 10 links": 1}) == {
        "more than 10 links": 1
    }
    with pytest.raises(
        BenchmarkError, match=r"\(1 rejected: 1 with more than 10 links; see --max-links\); ask"
    ):
        made(["ee=hand"], 2, max_links=10, patterns=patterns)


def test_the_file_has_hold_out_rules(tmp_path):
    example = made(["ee=plane,arm3.length=30cm..0.4"], 4, test=2)
    text = split_text(example)
    assert "  hold_out: [ee=plane, arm3.length=0.3..0.4]\n" in text
    stored = parse_split(text, tmp_path / "a.yaml")
    assert stored.id == split_id(stored.split)
    assert stored.split == replace(example, provenance=stored.split.provenance)
    assert stored.split.provenance == example.provenance


RULES = {"hold_out": ["ee=plane"]}
TRAIN = ("arm=lwr ee=cube", "arm=arm3 ee=cube")


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


def test_the_audit_finds_each_violation():
    test = "arm=lwr ee=plane"
    assert codes(TRAIN, [test]) == []
    assert codes([*TRAIN, "arm=arm3 ee=plane"], [test]) == [
        ("held-out-trained", "error", "train robot arm3-plane")
    ]
    assert codes(TRAIN, [test, TRAIN[0]]) == [("held-out-absent", "error", "test robot lwr-cube")]
    assert codes(TRAIN, ["arm=arm_ed ee=plane"]) == [
        ("part-unseen", "error", "test robot arm_ed-plane")
    ]
    assert codes(TRAIN, [test], {"hold_out": ["ee=plane", "arm=ur5"]}) == [
        ("held-out-untested", "error", "rule arm=ur5")
    ]
    pair = {"hold_out": ["arm=lwr+ee=plane"]}
    assert codes(TRAIN, [test], pair) == [("part-unseen", "error", "test robot lwr-plane")]


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


def test_trained_parts_of_the_held_out_manufacturer_are_named():
    def related(rule, train, test):
        return related_parts(stated([train], [test], {"hold_out": [rule]}), LIBRARY)

    arms = ("arm=mico ee=plane", "arm=kinova_gen3 ee=plane")
    assert related("arm=kinova*", *arms) == {"arm.manufacturer=Kinova": ("mico",)}
    assert related("arm=kinova*+ee=plane", *arms) == {}
    assert related("arm=lwr", "arm=arm3 ee=plane", "arm=lwr ee=plane") == {}

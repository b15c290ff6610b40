"""Auditing a split: leaks between train and test, broken regime rules and unmet promises."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.splits import LIBRARY, TEST, TRAIN, combined, member, split
from morphgen.benchmark.audit import audit
from morphgen.benchmark.similarity import MEASURES, NearThresholds, features, is_near
from morphgen.benchmark.survey import survey_split
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.sampling import sample_robot
from morphgen.progress import show_progress


def finding_keys(example_split, **options):
    """Return code and location of every finding."""
    return [(each.code, each.where) for each in audit(example_split, LIBRARY, **options).findings]


def test_a_valid_split_passes():
    report = audit(combined(), LIBRARY)
    assert (report.findings, report.accepted, report.passed(strict=True)) == ((), (), True)


def test_the_same_robot_in_train_and_test_is_a_leak_under_any_name():
    twin = member(TRAIN[0], "somebody_else")
    report = audit(combined(test=[*TEST, twin]), LIBRARY)
    (leak,) = [each for each in report.findings if each.code == "body-shared"]
    assert leak.where == "test robot somebody_else"
    assert leak.why == "train robot gantry-plane has the same body, and learns the same task"
    assert not report.passed()


def test_the_same_robot_with_another_task_is_not_a_leak():
    example_split = combined(train=[*TRAIN, member(TEST[0], task="reach", name="planar-reach")])
    codes = {code for code, _ in finding_keys(example_split)}
    assert "combination-seen" in codes
    assert not codes & {"body-shared", "body-near"}


def test_a_near_duplicate_of_a_train_robot_is_a_leak():
    near = split([member(f"{TEST[0]} ee.size=100.1mm", "near"), *TRAIN], TEST)
    report = audit(near, LIBRARY)
    (leak,) = [each for each in report.findings if each.code == "body-near"]
    assert leak.where == "test robot planar-plane"
    assert "train robot near is nearly the same: tree distance" in leak.why


def test_a_near_duplicate_needs_the_tree_and_another_measure():
    example_split = split([f"{TEST[0]} ee.size=100.1mm", *TRAIN], TEST)
    likeness = survey_split(example_split, LIBRARY)
    tree, alike, overlap = (
        likeness.by_measure(name)[0, 0] for name in ("tree", "cosine", "workspace")
    )
    for near, expected in (
        (NearThresholds(tree * 1.01, alike - 1e-12, overlap), True),
        (NearThresholds(tree * 1.01, alike, overlap - 1e-12), True),
        (NearThresholds(tree, alike - 1e-12, overlap - 1e-12), False),
        (NearThresholds(tree * 1.01, alike, overlap), False),
    ):
        codes = {code for code, _ in finding_keys(example_split, near=near)}
        assert ("body-near" in codes) == expected


def test_an_arm_without_its_empty_flange_is_a_near_duplicate():
    """The Panda as a real arm and as a template at its own size differ by an empty link."""
    leaking = combined(["arm=panda_scaled ee=plane"], ["arm=panda ee=plane"])
    assert ("body-near", "test robot panda-plane") in finding_keys(leaking)


def jittered(node, amount, rng):
    """Return the derivation with every length parameter increased or decreased."""
    known = LIBRARY.manifest(node.part).parameters
    values = tuple(
        (name, value * (1 + amount * rng.choice([-1, 1])))
        if name in known and known[name].unit == "m" and value
        else (name, value)
        for name, value in node.parameters
    )
    children = tuple((port, jittered(child, amount, rng)) for port, child in node.children)
    return Derivation(node.label, node.part, values, children)


@pytest.mark.parametrize("category", ["arm5", "chain", "planar_arm", "cubes", "stick"])
def test_near_duplicates_differ_by_about_one_per_cent_in_size(category):
    sample = sample_robot(load_grammar(find_grammar(category)), LIBRARY, 0, seed=1)
    rng = np.random.default_rng(0)
    one = features(sample.robot, token_shapes(sample.robot))

    def is_near_after(amount):
        robot = compose(jittered(sample.derivation, amount, rng), LIBRARY, "other")
        other = features(robot, token_shapes(robot))
        return is_near(one, other)

    assert is_near_after(0.005)
    assert not is_near_after(0.06)


def test_a_name_shared_by_two_robots_is_a_finding():
    example_split = combined(test=[*TEST, member("base=planar ee=cylinder", "gantry-plane")])
    assert finding_keys(example_split) == [("name-shared", "test robot gantry-plane")]


def test_an_unknown_part_is_reported_with_the_nearest():
    wrong = replace(member(TRAIN[1]), derivation="base=planar[top: ee=cubw]")
    report = audit(combined(train=[TRAIN[0], wrong, TRAIN[2], "base=planar ee=stick"]), LIBRARY)
    (missing,) = report.findings
    assert (missing.code, missing.where) == ("part-missing", "train robot planar-cube")
    assert "no part 'cubw'; did you mean 'cube" in missing.why
    trained = {n.train for n in report.neighbours}
    assert trained <= {"gantry-plane", "gantry-cylinder", "planar-stick"}
    wrong = replace(member(TEST[0]), derivation="base=planar[top: ee=cubw]")
    report = audit(combined(test=[wrong]), LIBRARY)
    assert ([each.code for each in report.findings], report.neighbours) == (["part-missing"], ())
    wrong = [replace(member(words), derivation="base=nothing") for words in TRAIN]
    assert {code for code, _ in finding_keys(combined(train=wrong))} == {"part-missing"}


@pytest.mark.parametrize(
    ("derivation", "why"),
    [
        ("base=planar[up: ee=cube]", "no port 'up'"),
        ("base=planar[", "invalid derivation"),
        ("base=fixed[top: ee=cube]", "no joint moves its tool"),
    ],
)
def test_robots_that_cannot_be_composed_or_compared_are_reported(derivation, why):
    wrong = replace(member(TRAIN[1]), name="wrong", robot_hash="0" * 32, derivation=derivation)
    (broken,) = audit(combined(train=[*TRAIN, wrong]), LIBRARY).findings
    assert (broken.code, broken.where) == ("body-broken", "train robot wrong")
    assert why in broken.why


def test_a_changed_robot_hash_is_reported():
    changed_from = member(TRAIN[0]).robot_hash
    changed = replace(member(TRAIN[0]), robot_hash="0" * 32)
    report = audit(combined(train=[changed, *TRAIN[1:]]), LIBRARY)
    (finding,) = report.findings
    assert finding.code == "body-changed"
    assert f"names body {'0' * 32}, its derivation gives {changed_from}" in finding.why


def test_a_duplicate_robot_is_a_warning():
    report = audit(combined(train=[*TRAIN, member(TRAIN[0], "again")]), LIBRARY)
    (finding,) = report.findings
    assert (finding.code, finding.severity) == ("body-repeated", "warning")
    assert finding.where == "train robot again"
    assert report.passed()
    assert not report.passed(strict=True)


def test_violations_of_regime_rules_are_reported():
    unseen = combined(test=["base=planar ee=sphere"])
    assert finding_keys(unseen) == [("part-unseen", "test robot planar-sphere")]
    other = combined(regime="interpolation")
    assert finding_keys(other) == [("structure-unseen", "test robot planar-plane")]


def test_a_declared_similarity_bound_is_checked():
    likeness = survey_split(combined(), LIBRARY).by_measure("cosine").max()
    for bound, holds in (("<0.99", False), (">0.99", True), ("<1.0", True)):
        example_split = combined(provenance={"similarity": bound})
        codes = {code for code, _ in finding_keys(example_split)}
        assert codes == (set() if holds else {"similarity-bound"})
    assert 0.99 < likeness < 1
    with pytest.raises(BenchmarkError, match=r"split 'mine/some': made: .*'<'"):
        audit(combined(provenance={"similarity": "small"}), LIBRARY)


def test_accepting_one_finding_accepts_no_other():
    accepted = {"part-unseen": "on purpose"}
    only = audit(combined(test=["base=planar ee=sphere"], accepted=accepted), LIBRARY)
    assert only.passed(strict=True)
    assert [(each.code, reason) for each, reason in only.accepted] == [*accepted.items()]
    tests = ["base=planar ee=sphere", member(TRAIN[0], "twin")]
    report = audit(combined(test=tests, accepted=accepted), LIBRARY)
    assert {each.code for each in report.findings} == {"body-shared", "combination-seen"}
    assert not report.passed()


def test_accepting_an_absent_finding_is_a_warning():
    report = audit(combined(accepted={"body-naer": "a typo"}), LIBRARY)
    (finding,) = report.findings
    assert (finding.code, finding.severity) == ("accepted-unused", "warning")
    assert finding.where == "accepted body-naer"
    assert report.passed()


@pytest.mark.slow
def test_progress_is_reported_and_the_number_of_processes_does_not_matter():
    words = [f"base=planar ee=cube ee.size={50 + i}mm" for i in range(9)]
    cubes = [member(each, f"cube-{i}") for i, each in enumerate(words)]
    example_split = combined(train=[*TRAIN, *cubes])
    seen = []
    with show_progress(lambda *now: seen.append(now)):
        one = audit(example_split, LIBRARY)
    assert seen == [(i, 25) for i in range(1, 26)]  # 13 robots and 12 rows of comparisons
    assert audit(example_split, LIBRARY, jobs=2) == one


def test_an_audit_converts_to_plain_data():
    data = audit(combined(accepted={"x": "y"}), LIBRARY).as_dict()
    assert data["split"] == "mine/some"
    assert [each["code"] for each in data["findings"]] == ["accepted-unused"]
    assert set(data["nearest"]["planar-plane"]) == set(MEASURES)

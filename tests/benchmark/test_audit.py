"""Surveys of splits: leaks and broken rules that the audit finds, and statistics."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.splits import LIBRARY, TEST, TRAIN, combined, member, split
from morphgen.benchmark import survey as audit_module
from morphgen.benchmark.survey import (
    audit,
    compare_members,
    different_members,
    statistics,
    survey_robot,
    survey_split,
)
from morphgen.encoding.similarity import MEASURES, NearThresholds, features, is_near
from morphgen.errors import BenchmarkError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.compose import compose
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.sampling import sample_robot
from morphgen.grammar.syntax import Derivation
from morphgen.progress import show_progress


def finding_keys(example_split):
    """Return code and location of every finding."""
    return [(each.code, each.where) for each in audit(example_split, LIBRARY).findings]


NEAR = member(f"{TEST[0]} ee.size=100.1mm", "near")
CHANGED = replace(member(TRAIN[0]), robot_hash="0" * 32)
HASHES = f"names body {'0' * 32}, its derivation gives {member(TRAIN[0]).robot_hash}"
SAME = "train robot gantry-plane has the same body, and learns the same task"
FAULTS = {
    "part-unseen": ({"test": ["base=planar ee=sphere"]}, "test robot planar-sphere", ""),
    "structure-unseen": ({"regime": "interpolation"}, "test robot planar-plane", ""),
    "body-changed": ({"train": [CHANGED, *TRAIN[1:]]}, "train robot gantry-plane", HASHES),
    "body-shared": ({"test": [*TEST, member(TRAIN[0], "twin")]}, "test robot twin", SAME),
    "body-near": (
        {"train": [NEAR, *TRAIN]},
        *("test robot planar-plane", "train robot near is nearly the same: tree distance"),
    ),
    "name-shared": (
        {"test": [*TEST, member("base=planar ee=cylinder", "gantry-plane")]},
        *("test robot gantry-plane", ""),
    ),
    "body-repeated": ({"train": [*TRAIN, member(TRAIN[0], "again")]}, "train robot again", ""),
}
"""A split's changes, and the place and reason of the finding, by its code."""


@pytest.mark.parametrize("code", FAULTS)
def test_each_fault_has_its_finding_and_a_valid_split_has_none(code):
    assert audit(combined(), LIBRARY).passed(strict=True)
    changes, where, why = FAULTS[code]
    report = audit(combined(**changes), LIBRARY)
    (finding,) = [each for each in report.findings if each.code == code]
    assert (finding.where, why in finding.why) == (where, True)
    assert finding.severity == ("warning" if code == "body-repeated" else "error")
    assert report.passed() == (code == "body-repeated")
    others = {each.code for each in report.findings} - {code}
    assert others == ({"combination-seen"} if code in ("body-shared", "body-near") else set())


def test_the_same_robot_with_another_task_is_not_a_leak():
    example_split = combined(train=[*TRAIN, member(TEST[0], task="reach", name="planar-reach")])
    codes = {code for code, _ in finding_keys(example_split)}
    assert "combination-seen" in codes
    assert not codes & {"body-shared", "body-near"}


def test_a_near_duplicate_needs_the_tree_and_another_measure(monkeypatch):
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
        monkeypatch.setattr(audit_module, "NEAR_THRESHOLDS", near)
        codes = {code for code, _ in finding_keys(example_split)}
        assert ("body-near" in codes) == expected


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


def test_an_unknown_part_is_reported_with_the_nearest():
    wrong = replace(member(TRAIN[1]), derivation="base=planar[top: ee=cubw]")
    report = audit(combined(train=[TRAIN[0], wrong, TRAIN[2], "base=planar ee=stick"]), LIBRARY)
    (missing,) = report.findings
    assert (missing.code, missing.where) == ("part-missing", "train robot planar-cube")
    assert "no part 'cubw'; did you mean 'cube" in missing.why
    trained = {found.train for trains in report.nearest.values() for found in trains.values()}
    assert trained <= {"gantry-plane", "gantry-cylinder", "planar-stick"}
    wrong = replace(member(TEST[0]), derivation="base=planar[top: ee=cubw]")
    report = audit(combined(test=[wrong]), LIBRARY)
    assert ([each.code for each in report.findings], report.nearest) == (["part-missing"], {})
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


def test_a_task_that_no_package_has_is_an_error():
    odd = split([member(TRAIN[0], task="rech")], [member(TEST[0], task="reach")])
    (finding,) = [each for each in audit(odd, LIBRARY).findings if each.code == "task-unknown"]
    assert (finding.where, finding.severity) == ("train robot gantry-plane", "error")
    assert "its task 'rech' is unknown; did you mean 'reach'?" in finding.why


def test_accepting_one_finding_accepts_no_other():
    accepted = {"part-unseen": "on purpose"}
    only = audit(combined(test=["base=planar ee=sphere"], accepted=accepted), LIBRARY)
    assert only.passed(strict=True)
    assert [(each.code, reason) for each, reason in only.accepted] == [*accepted.items()]
    tests = ["base=planar ee=sphere", member(TRAIN[0], "twin")]
    report = audit(combined(test=tests, accepted=accepted), LIBRARY)
    assert {each.code for each in report.findings} == {"body-shared", "combination-seen"}
    assert not report.passed()


def test_accepting_an_absent_finding_is_a_warning_also_in_plain_data():
    report = audit(combined(accepted={"body-naer": "a typo"}), LIBRARY)
    (finding,) = report.findings
    assert (finding.code, finding.severity) == ("accepted-unused", "warning")
    assert finding.where == "accepted body-naer"
    assert report.passed()
    data = report.as_dict()
    assert data["split"] == "mine/some"
    assert [each["code"] for each in data["findings"]] == ["accepted-unused"]
    assert set(data["nearest"]["planar-plane"]) == set(MEASURES)


def test_progress_counts_the_robots_and_their_rows_of_the_matrix():
    seen = []
    with show_progress(lambda *now: seen.append(now)):
        audit(combined(), LIBRARY)
    assert seen == [(i, 4) for i in (1, 2, 3, 4, 1, 2, 3, 4)]  # measured, then compared


def test_mimic_joints_and_those_beyond_the_tool_are_movable_but_not_to_the_tool():
    reaching = member("arm=lwr ee=claw", "reaching", task="reach")
    summary = statistics(split(["arm=lwr ee=claw", reaching], ["arm=lwr ee=plane"]), LIBRARY)
    assert (summary["train"]["movable"], summary["train"]["movable_to_tool"]) == (11, 7)
    assert (summary["test"]["movable"], summary["test"]["movable_to_tool"]) == (7, 7)
    assert (summary["train"]["robots"], summary["train"]["bodies"]) == (2, 1)


def test_a_robot_that_cannot_be_composed_is_an_error():
    wrong = replace(member("cubes"), derivation="cubes=cubez")
    with pytest.raises(BenchmarkError, match=r"'mine/some': robot 'cubes': .*'cubez'; did you me"):
        statistics(split([wrong], ["chain"]), LIBRARY)
    with pytest.raises(BenchmarkError, match="a side without robots"):
        statistics(split(["cubes"], []), LIBRARY)


def test_train_robots_are_compared_symmetrically_and_only_on_request():
    twins = split([*TRAIN, member(TRAIN[0], "twin")], TEST)
    robots = [survey_robot(LIBRARY, twins.max_links, each) for each in different_members(twins)]
    survey = compare_members(twins, robots, all_pairs=True)
    assert survey.similarity.shape == (5, 5, len(MEASURES))
    pairs = survey.similarity[:4, :4]
    assert (pairs[0, 1:3] == pairs[1:3, 0]).all()
    assert (pairs[0, 1:3] == pairs[3, 1:3]).all()
    assert np.isnan(survey_split(combined(), LIBRARY).similarity[:3, :3]).all()

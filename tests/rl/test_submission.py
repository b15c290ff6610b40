"""Submissions: their file, every check, scores, ranking and references."""

import copy
import json
import math

import msgspec
import numpy as np
import pytest

from helpers.runs import small_source, small_split
from helpers.submissions import EXPECTED, PROTOCOL, SPLIT, VERSION, data
from morphgen.benchmark.split import split_id
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.formats.records import read_record
from morphgen.grammar.library import default_library
from morphgen.rl.scores import leaderboard as reference_scores
from morphgen.rl.scores.episode_table import EPISODES, append_submission
from morphgen.rl.scores.leaderboard import (
    Row,
    SideScore,
    collect_references,
    random_scores,
    ranked,
    ranking_table,
    read_references,
    reference_files,
    score_submission,
)
from morphgen.rl.scores.scores import stratified_mean_interval
from morphgen.rl.scores.submission import (
    Submission,
    check_submission,
    read_submission,
    submission_text,
)
from morphgen.tasks.goals.eval_protocol import EvalProtocol, protocol_from

LIBRARY = default_library()
TEST = -1
"""Index of the test robot."""


def submission(values=None, **more):
    return read_record(values or data(**more), Submission, "s.json", BenchmarkError)


def check(values):
    check_submission(submission(values), "s.json", SPLIT, PROTOCOL, EXPECTED, VERSION)


def test_a_valid_submission_passes():
    check(data())
    only_test = data()
    only_test["robots"] = only_test["robots"][TEST:]
    check(only_test)
    check(data(episodes=9))
    check({**data(), "morphgen": "0.7.9"})


def test_a_submission_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "s.json"
    path.write_text(submission_text(submission()))
    assert read_submission(path) == submission()
    assert json.loads(path.read_text()) == data()


def changed(*keys, value):
    """Return the data of a submission with another value at a path of keys."""
    values = copy.deepcopy(data())
    entry = values
    for key in keys[:-1]:
        entry = entry[key]
    entry[keys[-1]] = value
    return values


FAULTS = {
    "split": (("split", "id"), "0" * 32, f"split.id: {'0' * 32} (mine/small); expected"),
    "version": (("morphgen",), "0.6.9", "morphgen: 0.6.9; scores are compared with those of"),
    "simulator": (("evaluation", "simulator"), "pybullet", "evaluation.simulator: 'pybullet'"),
    "seed": (("evaluation", "seed"), 3, "evaluation.seed: 3; expected 0"),
    "episodes": (("evaluation", "episodes"), 3, "evaluation.episodes: 3; expected 4 or more"),
    "constant": (
        ("evaluation", "constants", "reach", "near"),
        0.3,
        "evaluation.constants.reach.near: 0.3; expected 0.03",
    ),
    "constants": (("evaluation", "constants"), [], "evaluation.constants.reach.steps: None"),
    "robot": (("robots", TEST, "robot"), "other", "test robot other: the split has no such robot"),
    "side": (("robots", TEST, "side"), "train", "train robot gantry-plane: the split has no such"),
    "task": (("robots", TEST, "task"), "push", "task: push; expected reach"),
    "body": (("robots", TEST, "body"), "0" * 32, f"body: {'0' * 32}; expected"),
    "goals": (("robots", TEST, "goal_set"), "0", "goal_set: 0; expected"),
    "few": (("robots", TEST, "score"), [1.0], "score: 1 episodes; expected 4 to 10000"),
    "length": (("robots", TEST, "steps"), [300] * 3, "steps: 3 episodes; expected 4, as in score"),
    "random": (("robots", TEST, "random_score"), [0.0], "random_score: 1 episodes, random_success"),
    "high": (("robots", TEST, "score", 2), 200.5, "score[2]: 200.5; expected -"),
    "low": (("robots", TEST, "random_score", 1), -1e9, "random_score[1]: -1e+09; expected -"),
    "steps": (("robots", TEST, "steps", 0), 301, "steps[0]: 301; expected 1 to 300"),
    "distance": (("robots", TEST, "distance", 3), -0.1, "distance[3]: -0.1; expected 0 to 1000"),
    "success": (("robots", TEST, "success", 3), True, "episode 3: success at a distance of 0.2 m"),
    "failure": (("robots", TEST, "success", 0), False, "episode 0: no success at a distance of"),
    "diverged": (("robots", TEST, "diverged", 0), True, "success[0]: true in an episode that"),
}


@pytest.mark.parametrize(("keys", "value", "why"), FAULTS.values(), ids=FAULTS)
def test_every_fault_is_named_with_robot_and_field(keys, value, why):
    with pytest.raises(BenchmarkError) as caught:
        check(changed(*keys, value=value))
    text = str(caught.value)
    assert why in text
    assert text.startswith("s.json: ")
    if keys[0] == "robots" and keys[-1] not in ("robot", "side"):
        assert text.startswith("s.json: test robot gantry-plane: ")
    assert "\n" not in text


@pytest.mark.parametrize(
    ("robots", "why"),
    [
        ([0, 1], "test robot gantry-plane: is missing"),
        ([0, 2], "train robot gantry-cube: is missing"),
        ([0, 1, 2, 2], "test robot gantry-plane: is there twice"),
        ([], "test robot gantry-plane: is missing"),
    ],
)
def test_missing_and_repeated_robots_are_named(robots, why):
    values = data()
    with pytest.raises(BenchmarkError, match=why):
        check({**values, "robots": [values["robots"][i] for i in robots]})


@pytest.mark.parametrize(
    ("change", "why"),
    [
        ({"format": 2}, "format 2; this version reads 1"),
        ({"kind": "other"}, "no submission; expected an object with the kind"),
        ({"extra": 1}, "unknown key 'extra'"),
        ({"method": "a\nb"}, "expected printable characters"),
        ({"mode": "best"}, "mode: unknown value 'best'"),
        ({"robots": [{"robot": "a"}]}, "robots[0]: missing key 'side'"),
    ],
)
def test_malformed_submissions_are_refused(tmp_path, change, why):
    path = tmp_path / "s.json"
    path.write_text(json.dumps(data() | change))
    with pytest.raises(BenchmarkError) as caught:
        read_submission(path)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", [math.nan, math.inf, "1", None, 1e13])
def test_numbers_must_be_finite(value):
    with pytest.raises(BenchmarkError, match=r"robots\[2\]\.score\[1\]: "):
        submission(changed("robots", TEST, "score", 1, value=value))


@pytest.mark.parametrize("content", ["[]", "{"])
def test_other_files_are_refused(tmp_path, content):
    path = tmp_path / "s.json"
    path.write_text(content)
    with pytest.raises(MorphgenError, match=r"s\.json"):
        read_submission(path)


def test_scores_are_computed_from_the_episodes():
    row = score_submission(submission())
    assert (row.method, row.source, row.seeds, row.episodes) == ("ours", "submission", (0,), 4)
    assert [(each.side, each.task, each.robots) for each in row.sides] == [
        ("train", "reach", 2),
        ("test", "reach", 1),
    ]
    test = row.group("test", "reach")
    relative = np.array([150, 151, 152, -1]) + 2
    assert (test.score, test.success) == (relative.mean(), 0.75)
    interval = stratified_mean_interval([relative])
    assert (test.low, test.high) == (interval.low, interval.high)
    train = row.group("train", "reach")
    assert train.score == relative.mean()
    assert test.high - test.low > train.high - train.low > 0


def test_the_random_scores_of_a_release_replace_those_of_a_submission():
    forged = changed("robots", TEST, "random_score", value=[-600.0] * 4)
    check(forged)
    assert score_submission(submission(forged)).group("test", "reach").score > 600
    random = random_scores(submission())
    fair = score_submission(submission(forged), random)
    assert fair.sides == score_submission(submission()).sides


def test_every_random_episode_counts_alike_whatever_the_number_of_episodes():
    random = {(each.side, each.member.name): [-8.0, 0.0, 0.0, 0.0] for each in EXPECTED}
    for episodes in (4, 5, 8):
        each = submission(data(episodes=episodes))
        score = score_submission(each, random).group("test", "reach").score
        assert score == pytest.approx(np.mean(each.robots[TEST].score) + 2)


def row(method, *sides):
    return Row(method, "submission", "", (), 34, tuple(SideScore(*side) for side in sides))


def test_rows_are_ranked_by_the_test_robots():
    rows = [
        row("low", ("test", "reach", 1, 10.0, 0.5), ("train", "reach", 9, 99.0, 1.0)),
        row("high", ("test", "reach", 1, 20.0, 0.1)),
        row("none", ("train", "reach", 9, 99.0, 1.0)),
    ]
    assert [each.method for each in ranked(rows)] == ["high", "low", "none"]
    mixed = [
        row("a", ("test", "reach", 1, 90.0, 0.5), ("test", "push", 3, 0.1, 0.1)),
        row("b", ("test", "reach", 1, 10.0, 0.3), ("test", "push", 3, 0.9, 0.9)),
    ]
    assert [each.method for each in ranked(mixed)] == ["b", "a"]
    # A baseline that can do one task only has a score, but no success rate over all robots.
    partial = row("ik", ("test", "reach", 1, 200.0, 1.0))
    assert [each.method for each in ranked([partial, *mixed])] == ["b", "a", "ik"]
    header, _, first, *_ = ranking_table(rows).splitlines()
    assert header.split()[:4] == ["rank", "method", "from", "seeds"]
    assert first.split()[:6] == ["1", "high", "submission", "-", "20.0", "10%"]


def test_fine_tuned_policies_are_told_from_others(tmp_path, monkeypatch):
    monkeypatch.setattr(reference_scores, "version", lambda name: VERSION)
    training = {"simulator": "warp", "transitions": 1000}
    tuned = data() | {"training": training | {"finetuned": 30_000}}
    for name, values in (("zero-shot", data() | {"training": training}), ("tuned", tuned)):
        (tmp_path / f"{name}.json").write_text(json.dumps(values))
    paths = [tmp_path / name for name in ("zero-shot.json", "tuned.json")]
    references = collect_references(paths, SPLIT, PROTOCOL, LIBRARY)
    assert set(reference_files(references)) == {
        *("scores.json", "submissions/ours-seed0.json"),
        "submissions/ours-fine-tuned-30000-seed0.json",
    }
    assert [each.label for each in references.rows()] == ["ours (fine-tuned 30,000)", "ours"]
    assert "ours (fine-tuned 30,000)" in ranking_table(references.rows())


def test_references_are_submissions_and_episodes_of_studies(tmp_path, monkeypatch):
    monkeypatch.setattr(reference_scores, "version", lambda name: VERSION)
    baseline = data("random") | {"mode": "", "training_seed": None}
    for method, values in (("random", baseline), ("ours", data()), ("other", data("random"))):
        (tmp_path / f"{method}.json").write_text(json.dumps(values))
    policy = data("me-mlp") | {"training_seed": 3, "config": {"of": "its study"}}
    (tmp_path / "study").mkdir()
    append_submission(tmp_path / "study" / EPISODES, submission(policy))
    names = ("random.json", "ours.json", "other.json", "study")
    paths = [tmp_path / name for name in names]
    files = reference_files(collect_references(paths, SPLIT, PROTOCOL, LIBRARY))
    assert set(files) == {
        *("scores.json", "submissions/ours-seed0.json", "submissions/random.json"),
        *("submissions/me-mlp-seed3.json", "submissions/random-seed0.json"),  # of this name
    }
    again = collect_references(paths[::-1], SPLIT, PROTOCOL, LIBRARY)
    assert files == reference_files(again)
    for name, content in files.items():
        (tmp_path / "release" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "release" / name).write_bytes(content)
    rows = read_references(tmp_path / "release").rows()
    assert {(each.method, each.source, each.seeds) for each in rows} == {
        ("ours", "reference", (0,)),
        ("random", "reference", ()),
        ("random", "reference", (0,)),
        ("me-mlp", "reference", (3,)),
    }
    assert json.loads(files["scores.json"])["rows"] == json.loads(
        json.dumps(msgspec.to_builtins(rows))
    )
    assert read_references(tmp_path).rows() == []
    baseline["robots"] = baseline["robots"][TEST:]
    (tmp_path / "random.json").write_text(json.dumps(baseline))
    with pytest.raises(BenchmarkError, match=r"random\.json: random: the train robots are missing"):
        collect_references(paths, SPLIT, PROTOCOL, LIBRARY)
    with pytest.raises(BenchmarkError, match=r"train robot [a-z-]+: the release has no episodes"):
        score_submission(submission(), random_scores(submission(baseline)))


def test_references_of_other_splits_and_rules_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(reference_scores, "version", lambda name: VERSION)
    append_submission(tmp_path / EPISODES, submission())
    other = small_split(task="push")
    with pytest.raises(BenchmarkError, match=r"no scores of split mine/small, id "):
        collect_references([tmp_path], other, PROTOCOL, LIBRARY)
    (tmp_path / "a.json").write_text(json.dumps(data(near=100.0)))
    with pytest.raises(BenchmarkError, match=r"another submission of ours is there"):
        collect_references([tmp_path], SPLIT, PROTOCOL, LIBRARY)
    strict = EvalProtocol(episodes=5)
    with pytest.raises(BenchmarkError, match=r"evaluation\.episodes: 4; expected 5 or more"):
        collect_references([tmp_path], SPLIT, strict, LIBRARY)
    with pytest.raises(BenchmarkError, match="no such file or folder"):
        collect_references([tmp_path / "d"], SPLIT, PROTOCOL, LIBRARY)


def test_the_rules_of_an_evaluation_are_read_as_they_were_written():
    rules = PROTOCOL.as_data(SPLIT)
    assert protocol_from(json.loads(json.dumps(rules)), "a").as_data(SPLIT) == rules
    assert set(rules["constants"]) == {"reach"}
    for change, why in (
        ({"simulator": "kinematic"}, "simulator 'kinematic': no simulator with contacts"),
        ({"episodes": 0}, "0 episodes"),
        ({"episodes": 4.5}, "4.5 episodes"),
        ({"seed": 1.5}, "seed 1.5"),
        ({"goal_seed": math.inf}, "cannot convert float infinity"),
        ({"more": 1}, "unexpected keyword"),
        ({"constants": {"reach": {"near": "x"}}}, "near"),
        ({"goal_seed": "x"}, "invalid literal"),
        ({"episodes": "4"}, "expected 1 to 10000 episodes"),
    ):
        with pytest.raises(MorphgenError, match="a: evaluation: ") as caught:
            protocol_from({**rules, **change}, "a")
        assert why in str(caught.value)
    with pytest.raises(BenchmarkError, match="missing key 'constants'"):
        protocol_from({"goal_seed": 0}, "a")


def test_expected_goal_sets_are_those_of_episodes():
    from morphgen.rl.runs.robot_source import specs_of
    from morphgen.tasks.scenes.env_specs import GoalConfig

    specs = specs_of(small_source(), GoalConfig())
    assert [spec.goals.key for spec in specs] == [each.goal_set for each in EXPECTED[:2]]
    assert EvalProtocol().goals == GoalConfig()
    assert split_id(SPLIT) == split_id(small_split())

"""Submissions: their file, every check, scores, ranking and references."""

import contextlib
import json
import math

import pytest

from helpers.runs import small_source, small_split
from helpers.submissions import EXPECTED, PROTOCOL, SPLIT, TEST, VERSION, changed, data, submission
from morphgen.benchmark.scores.submission import (
    EvalProtocol,
    check_submission,
    content_digest,
    protocol_from,
    read_submission,
    read_submissions,
    submission_text,
)
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.splits.split import split_id


def check(values):
    check_submission(submission(values), "s.json", SPLIT, PROTOCOL, EXPECTED, VERSION)


def test_a_valid_submission_passes():
    for values in (data(), data(episodes=9), data() | {"morphgen": "0.7.9"}):
        check(values)
    check(data() | {"robots": data()["robots"][TEST:]})


@pytest.mark.parametrize(
    ("own", "version", "why"),
    [
        ("0.3.0", "0.4.1", None),
        ("0.4.0", "0.3.0", None),
        ("0.5.0", "0.4.1", r"0\.5\.0; scores are compared with those of version 0\.4\.1"),
    ],
)
def test_submissions_of_0_3_are_scored_with_those_of_0_4(own, version, why):
    checked = submission({**data(), "morphgen": own})
    with pytest.raises(BenchmarkError, match=why) if why else contextlib.nullcontext():
        check_submission(checked, "s.json", SPLIT, PROTOCOL, EXPECTED, version)


def test_a_submission_is_read_as_it_was_written(tmp_path):
    path = tmp_path / "s.json"
    path.write_text(submission_text(submission()))
    assert read_submission(path) == submission()
    values = json.loads(path.read_text())
    assert values.pop("sha256") == content_digest(data())
    assert values == data()


def test_an_edited_file_is_refused_and_one_without_its_hash_noted(tmp_path, caplog):
    path = tmp_path / "s.json"
    values = json.loads(submission_text(submission()))
    path.write_text(json.dumps(values))  # in another layout
    assert read_submission(path) == submission()
    values["robots"][TEST]["score"][0] += 1
    path.write_text(json.dumps(values))
    for read in (read_submission, lambda path: read_submissions([path])):
        with pytest.raises(BenchmarkError, match=r"s\.json: sha256: .*: it was edited after"):
            read(path)
    assert not caplog.text
    del values["sha256"]
    path.write_text(json.dumps(values))
    read_submission(path)
    assert "an earlier version wrote no sha256" in caplog.text


FAULTS = {
    "split": (("split", "id"), "0" * 32, f"split.id: {'0' * 32} (mine/small); expected"),
    "version": (("morphgen",), "0.6.9", "morphgen: 0.6.9; scores are compared with those of"),
    "simulator": (("evaluation", "simulator"), "pybullet", "evaluation.simulator: 'pybullet'"),
    "seed": (("evaluation", "seed"), 3, "evaluation.seed: 3; expected 0"),
    "episodes": (("evaluation", "episodes"), 3, "evaluation.episodes: 3; expected 4 or more"),
    "constant": (
        *(("evaluation", "constants", "reach", "near"), 0.3),
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

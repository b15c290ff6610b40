"""Results of baselines robot by robot: from submissions, and from the cells of a study."""

import json
from dataclasses import asdict, replace

import pytest

from helpers.submissions import EXPECTED, SPLIT, data
from morphgen.benchmark.difficulty import BaselineResult
from morphgen.benchmark.split_file import split_text
from morphgen.errors import BenchmarkError
from morphgen.rl.evaluation import EvalConfig
from morphgen.rl.runs.robot_source import split_source
from morphgen.rl.scores.reference_scores import References, study_results, submitted_results
from morphgen.rl.scores.scores import Score, scores_to_json
from morphgen.rl.scores.submission import submission_from

EVAL = EvalConfig(episodes=4, sim="mujoco").as_data()
NAMES = [(each.side, each.member.name) for each in EXPECTED]


def cell(folder, name, score=2.0, **changes):
    """Write the scores of a baseline's cell; ``changes`` replace entries of the file."""
    scores = [
        Score(robot, side, "reach", 4, 1200, score, 1.0, 3.0, 1, -1, 0.5, 0, 0, 0)
        for side, robot in NAMES
    ]
    content = {
        "eval": EVAL,
        "source": asdict(split_source(SPLIT)),
        "scores": {name: scores_to_json(scores)},
    }
    path = folder / SPLIT.name / name / "scores.json"
    path.parent.mkdir(parents=True)
    path.write_text(json.dumps(content | changes))
    return path


def test_a_study_gives_the_results_of_its_baselines_in_order(tmp_path):
    cell(tmp_path, "ik", 200.0)
    cell(tmp_path, "random", 0.0)
    cell(tmp_path, "me-graph", 1.0)  # no baseline
    results = study_results(tmp_path, SPLIT)
    assert list(results) == ["random", "ik"]
    assert results["ik"] == dict.fromkeys(NAMES, BaselineResult(200.0, 0.5))


def test_submissions_of_baselines_give_results_relative_to_random():
    baseline = {"mode": "", "training_seed": None}
    values = data("random", successes=0) | baseline
    for robot in values["robots"]:
        robot["random_score"] = robot["score"]  # -1 in each episode
    random = submission_from(values, "a.json")
    ik = submission_from(data("ik", near=100.0) | baseline, "a.json")
    policy = submission_from(data("zero"), "a.json")  # of this name
    results = submitted_results(References((), (ik, policy, random)))
    assert list(results) == ["random", "ik"]
    assert results["random"] == dict.fromkeys(NAMES, BaselineResult(0.0, 0.0))
    # Episodes 100, 101, 102 and -1, relative to those of random.
    assert results["ik"] == dict.fromkeys(NAMES, BaselineResult(76.5, 0.75))
    alone = submitted_results(References((), (ik,)))  # relative to the -2 in its own file
    assert alone["ik"] == dict.fromkeys(NAMES, BaselineResult(77.5, 0.75))
    assert submitted_results(References()) == {}


OTHER = replace(SPLIT, test=SPLIT.train[:1])
BROKEN = [asdict(Score("r", "test", "reach", 4, 1, 2.0, 1, 1, 1, 1, 1, 1, 1, 1))]


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"source": {}}, "ik/scores.json: neither a submission nor the scores of a study's cell"),
        ({"eval": {}}, "ik/scores.json: neither a submission nor the scores of a study's cell"),
        (
            {"source": asdict(split_source(SPLIT)) | {"split": split_text(OTHER)}},
            "ik/scores.json: of other robots: split id ",
        ),
        (
            {"source": asdict(split_source(SPLIT)) | {"split": ""}},
            "ik/scores.json: of other robots: split id (none); expected ",
        ),
        (
            {"source": asdict(split_source(SPLIT, goal_seed=3))},
            "ik/scores.json: evaluation: goal_seed 3; expected 0, as of random",
        ),
        (
            {"eval": EVAL | {"sim": "pybullet"}},
            "ik/scores.json: evaluation: sim 'pybullet'; expected 'mujoco', as of random",
        ),
        (
            {"eval": EVAL | {"reach": EVAL["reach"] | {"near": 0.1}}},
            "ik/scores.json: evaluation: reach.near 0.1; expected 0.03, as of random",
        ),
        ({"scores": {"other": BROKEN}}, "ik/scores.json: no scores of ik; valid: other"),
        ({"scores": {"ik": BROKEN}}, "ik/scores.json: scores of test robots at reach: r; expected"),
    ],
)
def test_cells_that_do_not_fit_are_refused(tmp_path, changes, why):
    cell(tmp_path, "random")
    cell(tmp_path, "ik", **changes)
    with pytest.raises(BenchmarkError) as caught:
        study_results(tmp_path, SPLIT)
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("value", ["high", None, float("nan")])
def test_scores_that_are_no_numbers_are_refused(tmp_path, value):
    cell(tmp_path, "random", value)
    with pytest.raises(BenchmarkError, match=r"train robot \S+: score \S+; expected a"):
        study_results(tmp_path, SPLIT)


def test_a_study_without_cells_of_the_split_is_refused_with_its_splits(tmp_path):
    with pytest.raises(BenchmarkError, match=r"none: no such folder; expected the output folder"):
        study_results(tmp_path / "none", SPLIT)
    cell(tmp_path, "ik")
    other = replace(SPLIT, name="mine/smal")
    with pytest.raises(BenchmarkError, match=r"no scores of baselines on split 'mine/smal'.* did"):
        study_results(tmp_path, other)
    (tmp_path / "mine" / "small" / "ik" / "scores.json").write_text("{")
    with pytest.raises(BenchmarkError, match=r"ik/scores\.json"):
        study_results(tmp_path, SPLIT)

"""Results of baselines robot by robot: of references, and of studies."""

from dataclasses import replace

import pytest

from helpers.submissions import EXPECTED, SPLIT, data
from morphgen.benchmark.survey import BaselineResult
from morphgen.errors import BenchmarkError
from morphgen.rl.scores.episode_table import EPISODES, append_submission
from morphgen.rl.scores.leaderboard import References, study_results
from morphgen.rl.scores.submission import submission_from

NAMES = [(each.side, each.member.name) for each in EXPECTED]
BASELINE = {"mode": "", "training_seed": None}


def write(folder, *submissions):
    """Write the table of a study."""
    for values in submissions:
        append_submission(folder / EPISODES, submission_from(values, "a.json"))


def random():
    """Return the random policy, which scores -1 in each episode."""
    values = data("random", successes=0) | BASELINE
    for robot in values["robots"]:
        robot["random_score"] = robot["score"]
    return values


def test_a_study_gives_the_results_of_its_baselines_in_order(tmp_path):
    write(tmp_path, data("ik", near=100.0) | BASELINE, random(), data("zero"))
    results = study_results(tmp_path, SPLIT)
    assert list(results) == ["random", "ik"]
    assert results["ik"] == dict.fromkeys(NAMES, BaselineResult(77.5, 0.75))


def test_references_give_results_relative_to_random():
    ik = submission_from(data("ik", near=100.0) | BASELINE, "a.json")
    policy = submission_from(data("zero"), "a.json")  # of this name
    results = References((ik, policy, submission_from(random(), "a.json"))).results()
    assert list(results) == ["random", "ik"]
    assert results["random"] == dict.fromkeys(NAMES, BaselineResult(0.0, 0.0))
    # Episodes 100, 101, 102 and -1, relative to those of random.
    assert results["ik"] == dict.fromkeys(NAMES, BaselineResult(76.5, 0.75))
    alone = References((ik,)).results()  # relative to the -2 in its own file
    assert alone["ik"] == dict.fromkeys(NAMES, BaselineResult(77.5, 0.75))
    assert References().results() == {}


def test_studies_that_do_not_fit_are_refused(tmp_path):
    with pytest.raises(BenchmarkError, match=r"expected the output folder of morphgen study"):
        study_results(tmp_path, SPLIT)
    write(tmp_path, random())
    with pytest.raises(
        BenchmarkError, match=r"no episodes of baselines on split 'mine/smal'.* did"
    ):
        study_results(tmp_path, replace(SPLIT, name="mine/smal"))
    with pytest.raises(BenchmarkError, match=r"random: of other robots: split id "):
        study_results(tmp_path, replace(SPLIT, test=SPLIT.train[:1]))
    evaluation = data()["evaluation"] | {"simulator": "pybullet"}
    write(tmp_path, data("ik") | BASELINE | {"evaluation": evaluation})
    with pytest.raises(BenchmarkError, match=r"ik: evaluation.simulator 'pybullet'; expected 'muj"):
        study_results(tmp_path, SPLIT)

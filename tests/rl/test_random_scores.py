"""Scores of the random policy that several submissions to a split have."""

import json

import pytest

from helpers.submissions import PROTOCOL, SPLIT, VERSION, data
from morphgen.errors import BenchmarkError
from morphgen.formats.records import read_record
from morphgen.grammar.library import default_library
from morphgen.rl.scores import leaderboard as reference_scores
from morphgen.rl.scores.leaderboard import collect_references, reference_files
from morphgen.rl.scores.submission import Submission, require_same_random

TEST = -1
"""Index of the test robot."""


def with_random(*scores, robot=TEST):
    """Return a submission whose random policy has other scores on a robot."""
    values = data(episodes=len(scores))
    values["robots"][robot]["random_score"] = list(scores)
    return read_record(values, Submission, "s.json", BenchmarkError)


@pytest.mark.parametrize(
    ("first", "second", "robot"),
    [
        ((-9.0, -1.0, -9.0, -1.0), (-9.0, -1.0, -9.0, -5.1), TEST),
        ((-9.0, -1.0, -9.0, -1.0), (-99.0, -99.0, -99.0, -99.0, -99.0), TEST),
        ((-9.0, -1.0, -9.0, -1.0), (-200.0, 150.0, -200.0, 150.0), TEST),
        ((-9.0, -1.0, -9.0, -1.0), (-99.0, -99.0, -99.0, -99.0), 0),
    ],
    ids=["same episodes", "more episodes", "wide", "train"],
)
def test_submissions_that_disagree_about_the_random_policy_are_refused(first, second, robot):
    named = [("a", with_random(*first, robot=robot)), ("b", with_random(*second, robot=robot))]
    for pair, last in ((named, "b"), (named[::-1], "a")):
        with pytest.raises(BenchmarkError, match=rf"{last}: \w+ robot \S+: random_score: mean "):
            require_same_random(pair)


def test_submissions_agree_about_the_random_policy_up_to_rounding_and_other_episodes():
    scores = (-9.0, -1.0, -9.0, -1.0)
    same = with_random(-9.001, -1.0, -9.0, -1.2)
    more = with_random(-2.0, -12.0, -1.0, -9.0, -11.0)
    require_same_random([("a", with_random(*scores)), ("b", same), ("c", more)])
    train = with_random(*scores, robot=0), with_random(-4.0, -12.0, -3.0, -11.0, robot=0)
    require_same_random([("a", train[0]), ("b", train[1])])


def test_references_that_disagree_about_the_random_policy_need_a_submission_of_it(
    tmp_path, monkeypatch
):
    monkeypatch.setattr(reference_scores, "version", lambda name: VERSION)
    forged = data("b")
    forged["robots"][TEST]["random_score"] = [-200.0] * 4
    baseline = data("random") | {"mode": "", "training_seed": None}
    for name, values in (("a", data("a")), ("b", forged), ("random", baseline)):
        (tmp_path / f"{name}.json").write_text(json.dumps(values))
    paths = [tmp_path / f"{name}.json" for name in ("a", "b", "random")]
    with pytest.raises(BenchmarkError, match=r"random_score: mean -200\.00; expected -2\.00, as"):
        collect_references(paths[:2], SPLIT, PROTOCOL, default_library())
    references = collect_references(paths, SPLIT, PROTOCOL, default_library())
    assert "submissions/random.json" in reference_files(references)

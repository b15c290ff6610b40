"""Scores of submissions, their ranking, and the reference scores of releases and studies."""

import json
import math

import numpy as np
import pytest

from helpers.runs import small_split
from helpers.submissions import (
    BASELINE,
    EXPECTED,
    PROTOCOL,
    SPLIT,
    TEST,
    VERSION,
    changed,
    data,
    submission,
)
from morphgen.benchmark.scores import results as results_module
from morphgen.benchmark.scores.results import (
    collect_references,
    floor,
    random_scores,
    ranked,
    read_references,
    reference_files,
    result_tables,
    rows_data,
    scored_rows,
    smallest_differences,
)
from morphgen.benchmark.scores.submission import (
    EPISODES,
    EvalProtocol,
    append_submission,
    require_same_random,
)
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import default_library
from morphgen.rl.scores import smallest_rate_difference

LIBRARY = default_library()


def score_submission(each, random=None):
    (row,) = scored_rows({"a": each}, random)
    return row


@pytest.fixture
def this_version(monkeypatch):
    monkeypatch.setattr(results_module, "version", lambda name: VERSION)


def stored(folder, **submissions):
    """Write the data of submissions as JSON; return the paths."""
    for name, values in submissions.items():
        (folder / f"{name}.json").write_text(json.dumps(values))
    return [folder / f"{name}.json" for name in submissions]


def test_the_floor_and_the_smallest_difference_are_computed():
    rows = scored_rows({"a": submission(), "b": submission(data("other"))})
    (values,) = smallest_differences(rows)
    assert (values["task"], values["episodes"]) == ("reach", 4)
    assert values["success"] == smallest_rate_difference(4)
    assert values["score"] == pytest.approx(
        2.8016 * math.sqrt(2) * np.std([150, 151, 152, -1]) / math.sqrt(3), rel=1e-3
    )
    assert floor([submission()]) == {"reach": {"random": 0.0}}
    zero = submission(data("zero", successes=1) | BASELINE)
    assert floor([submission(), zero]) == {"reach": {"zero": 0.25, "random": 0.0}}


def test_the_random_scores_of_a_release_replace_those_of_a_submission():
    forged = changed("robots", TEST, "random_score", value=[-600.0] * 4)
    assert score_submission(submission(forged)).sides["test"].score.value > 600
    random = random_scores(submission())
    fair = score_submission(submission(forged), random)
    assert fair.sides == score_submission(submission()).sides


def test_every_random_episode_counts_alike_whatever_the_number_of_episodes():
    random = {(each.side, each.member.name): [-8.0, 0.0, 0.0, 0.0] for each in EXPECTED}
    for episodes in (4, 5, 8):
        each = submission(data(episodes=episodes))
        score = score_submission(each, random).sides["test"].score.value
        assert score == pytest.approx(np.mean(each.robots[TEST].score) + 2)


def test_rows_are_ranked_by_the_test_robots():
    train = data("train")
    train["robots"] = train["robots"][:TEST]
    files = {"low": data("low", near=9.0), "train": train, "high": data("high")}
    rows = ranked(scored_rows({name: submission(each) for name, each in files.items()}))
    assert [each.method for each in rows] == ["high", "low", "train"]
    lines = result_tables(rows).splitlines()[4:]
    assert [line.split()[0] for line in lines] == ["high", "low", "train"]


def test_fine_tuned_policies_are_told_from_others(tmp_path, this_version):
    training = {"simulator": "warp", "transitions": 1000}
    tuned = data() | {"training": training | {"finetuned": 30_000}}
    paths = stored(tmp_path, zero_shot=data() | {"training": training}, tuned=tuned)
    references = collect_references(paths, SPLIT, PROTOCOL, LIBRARY)
    names = {f"submissions/ours-{run}.json" for run in ("seed0", "fine-tuned-30000-seed0")}
    assert set(reference_files(references)) == {"scores.json", *names}
    assert [each.finetuned for each in references.rows()] == [30_000, 0]
    assert "ours (reference)" in result_tables(references.rows())


def test_references_are_submissions_and_episodes_of_studies(tmp_path, this_version):
    baseline = data("random") | BASELINE
    paths = stored(tmp_path, random=baseline, ours=data(), other=data("random"))
    policy = data("me-mlp") | {"training_seed": 3, "config": {"of": "its study"}}
    (tmp_path / "study").mkdir()
    append_submission(tmp_path / "study" / EPISODES, submission(policy))
    paths.append(tmp_path / "study")
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
    assert {each.source for each in rows} == {"reference"}
    runs = {("ours", (0,)), ("random", ()), ("random", (0,)), ("me-mlp", (3,))}
    assert {(each.method, each.seeds) for each in rows} == runs
    assert json.loads(files["scores.json"])["rows"] == rows_data(rows)
    assert read_references(tmp_path).rows() == []
    baseline["robots"] = baseline["robots"][TEST:]
    stored(tmp_path, random=baseline)
    with pytest.raises(BenchmarkError, match=r"random\.json: random: the train robots are missing"):
        collect_references(paths, SPLIT, PROTOCOL, LIBRARY)
    with pytest.raises(BenchmarkError, match=r"train robot [a-z-]+: the release has no episodes"):
        score_submission(submission(), random_scores(submission(baseline)))


def test_references_of_other_splits_and_rules_are_refused(tmp_path, this_version):
    append_submission(tmp_path / EPISODES, submission())
    other = small_split(task="push")
    with pytest.raises(BenchmarkError, match=r"no scores of split mine/small, id "):
        collect_references([tmp_path], other, PROTOCOL, LIBRARY)
    stored(tmp_path, a=data(near=100.0))
    with pytest.raises(BenchmarkError, match=r"another submission of ours is there"):
        collect_references([tmp_path], SPLIT, PROTOCOL, LIBRARY)
    strict = EvalProtocol(episodes=5)
    with pytest.raises(BenchmarkError, match=r"evaluation\.episodes: 4; expected 5 or more"):
        collect_references([tmp_path], SPLIT, strict, LIBRARY)
    with pytest.raises(BenchmarkError, match="no such file or folder"):
        collect_references([tmp_path / "d"], SPLIT, PROTOCOL, LIBRARY)


def with_random(*scores, robot=TEST):
    """Return a submission whose random policy has other scores on a robot."""
    values = data(episodes=len(scores))
    values["robots"][robot]["random_score"] = list(scores)
    return submission(values)


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
    tmp_path, this_version
):
    forged = data("b")
    forged["robots"][TEST]["random_score"] = [-200.0] * 4
    baseline = data("random") | BASELINE
    paths = stored(tmp_path, a=data("a"), b=forged, random=baseline)
    with pytest.raises(BenchmarkError, match=r"random_score: mean -200\.00; expected -2\.00, as"):
        collect_references(paths[:2], SPLIT, PROTOCOL, LIBRARY)
    references = collect_references(paths, SPLIT, PROTOCOL, LIBRARY)
    assert "submissions/random.json" in reference_files(references)

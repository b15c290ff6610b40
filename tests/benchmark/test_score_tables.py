"""Tables of episodes and of their results, and the reader of submissions in files."""

import gzip
import json
from pathlib import Path

import numpy as np
import pytest

from helpers.submissions import BASELINE, SPLIT, data
from morphgen.benchmark.scores import submission as submission_module
from morphgen.benchmark.scores.results import result_rows, result_tables
from morphgen.benchmark.scores.submission import (
    COLUMNS,
    EPISODES,
    append_submission,
    mode_of,
    read_submissions,
    read_table,
    submission_from,
)
from morphgen.errors import BenchmarkError
from morphgen.rl.scores import mean_interval, success_interval
from morphgen.splits.split import read_split, split_id

TRAINING = {"simulator": "warp", "transitions": 30_000_000}


def read(**files):
    return {name: submission_from(values, Path(name)) for name, values in files.items()}


def floor():
    """Episodes of the reference controller, which scores 100 and succeeds twice in four."""
    return data("jacobian", successes=2, near=100.0) | BASELINE


def by_key(rows):
    return {(row.task, row.method, row.mode, row.finetuned): row for row in rows}


def test_a_row_has_all_seeds_of_a_method_and_the_difference_to_the_reference():
    first = data(successes=4, near=150.0) | {"training": TRAINING}
    second = data(successes=3, near=130.0) | {"training": TRAINING, "training_seed": 1}
    rows = by_key(result_rows(read(a=first, b=second, c=floor())))
    row = rows["reach", "ours", "deterministic", 0]
    assert (row.seeds, row.transitions, row.simulator) == ((0, 1), 30_000_000, "warp")
    scores = [np.array([150.0, 151, 152, 153]) + 2, np.array([130.0, 131, 132, -1]) + 2]
    reference = np.array([100.0, 101, -1, -1]) + 2
    for side, robots in (("train", row.sides["train"]), ("test", row.sides["test"])):
        trials = 8 * robots.robots
        assert robots.episodes == trials, side
        assert robots.score.value == pytest.approx(np.mean(scores))
        assert robots.score == mean_interval([[each] * robots.robots for each in scores])
        wilson = success_interval(7 / 8, trials)
        successes = [[[True] * 4] * robots.robots, [[True] * 3 + [False]] * robots.robots]
        of_seeds = mean_interval(successes)
        ends = min(wilson.low, of_seeds.low), max(wilson.high, of_seeds.high)
        assert (robots.success.low, robots.success.high) == pytest.approx(ends, abs=1e-6)
        assert of_seeds.low <= 0.75 < 1 <= of_seeds.high  # from the worse seed to the better one
        assert robots.difference.value == pytest.approx(
            np.mean(scores, axis=0).mean() - reference.mean()
        )
        assert robots.difference.low < robots.difference.value < robots.difference.high
    assert rows["reach", "jacobian", "", 0].sides["test"].difference is None


def test_policies_of_single_robots_are_compared_in_the_same_episodes():
    values = data(successes=4, near=150.0)
    for robot in values["robots"]:
        for key in ("success", "score", "distance", "steps", "diverged"):
            robot[key] = robot[key] * 2
    rows = by_key(result_rows(read(a=values, b=floor())))
    difference = rows["reach", "ours", "deterministic", 0].sides["test"].difference
    assert difference.value == pytest.approx(151.5 - 49.75)


def test_modes_and_fine_tuning_have_rows_of_their_own():
    tuned = data(near=160.0) | {"training": TRAINING | {"finetuned": 10_000}}
    tuned["robots"] = [robot for robot in tuned["robots"] if robot["side"] == "test"]
    stochastic = data() | {"mode": "stochastic"}
    rows = result_rows(read(a=data(), b=tuned, c=stochastic))
    modes = ["deterministic", "deterministic", "stochastic"]
    assert [(row.mode, row.finetuned) for row in rows] == [*zip(modes, (0, 10_000, 0), strict=True)]
    assert [list(row.sides) for row in rows] == [["train", "test"], ["test"], ["train", "test"]]
    text = result_tables(rows)
    assert ("10,000" in text, "ours (stochastic)" in text) == (True, True)
    assert result_tables(rows, "github").startswith("## ")


def changed(values, **changes):
    values["robots"][0] |= changes
    return values


def test_runs_of_other_trainings_have_rows_of_their_own():
    longer = TRAINING | {"transitions": 100_000_000}
    files = {
        name: data() | {"training_seed": seed, "training": training}
        for seed, (name, training) in enumerate({"a": TRAINING, "b": longer, "c": TRAINING}.items())
    }
    runs = [(row.transitions, row.seeds) for row in result_rows(read(**files))]
    assert runs == [(30_000_000, (0, 2)), (100_000_000, (1,))]


def test_small_scores_have_two_decimals():
    for near, shown in ((0.25, "2.69"), (150.0, "115.0")):
        (line,) = result_tables(result_rows(read(a=data(near=near)))).splitlines()[4:5]
        assert line.split()[4] == shown


def test_a_run_that_two_studies_have_counts_once():
    one = result_rows(read(a=data(), c=floor()))
    assert result_rows(read(a=data(), b=data(), c=floor(), d=floor())) == one


FEWER = {"evaluation": data()["evaluation"] | {"episodes": 3}}


@pytest.mark.parametrize(
    ("second", "why"),
    [
        (data(near=140.0), "b: the same run, seed and mode as a with other episodes; name one of"),
        (data("b") | {"split": {"name": SPLIT.name, "id": "x"}}, "b: split.id x; expected"),
        (data("b") | FEWER, "b: evaluation.episodes 3; expected 4, as in a; scores of different"),
        (changed(data() | {"training_seed": 1}, robot="c"), "its seeds have other train robots"),
        (
            changed(data("b"), random_score=[-500.0, -501, -500, -499]),
            "b: train robot .*: random_score: mean -500.00; expected .*, as in a",
        ),
    ],
)
def test_submissions_that_do_not_compare_are_refused(second, why):
    with pytest.raises(BenchmarkError, match=why):
        result_rows(read(a=data(), b=second))


def test_robots_that_a_shipped_split_does_not_have_are_refused():
    shipped = read_split("interpolation/arm3/reach")
    values = data() | {"split": {"name": shipped.name, "id": split_id(shipped)}}
    with pytest.raises(BenchmarkError, match=f"a: .*: body .*; expected a robot of {shipped.name}"):
        result_rows(read(a=values))


TUNED = {"training": {"simulator": "warp", "transitions": 30, "finetuned": 10_000}}


def submissions():
    """Return a baseline, a policy with a config, and a fine-tuned one with further episodes."""
    baseline = data("ik", successes=2) | BASELINE
    policy = data(near=1 / 3) | {"config": {"policy": {"agent": "se"}, "x": [1, None]}}
    tuned = data(episodes=8) | TUNED
    for robot in tuned["robots"]:  # two policies in the episodes of one
        robot["random_score"], robot["random_success"] = [-1.5, 0.1], [False, True]
    return [submission_from(values, "a.json") for values in (baseline, policy, tuned)]


@pytest.fixture
def table(tmp_path):
    for each in submissions():
        append_submission(tmp_path / EPISODES, each)
    return tmp_path / EPISODES


def test_a_table_is_read_as_it_was_written_and_has_the_same_bytes_again(table, tmp_path):
    assert list(read_table(table)) == submissions()
    modes = ["", "deterministic", "fine-tuned 10,000"]
    assert [mode_of(each) for each in read_table(table)] == modes
    runs = ("ik", "ours seed0 deterministic", "ours seed0 fine-tuned 10,000")
    assert list(read_submissions([tmp_path])) == [f"{table}: mine/small {run}" for run in runs]
    content = table.read_bytes()
    table.unlink()
    for each in submissions():
        append_submission(table, each)
    assert table.read_bytes() == content


def test_rows_of_a_table_are_episodes(table):
    lines = gzip.decompress(table.read_bytes()).decode().splitlines()
    header, *rows = [line.split(",") for line in lines if not line.startswith("#")]
    assert header == list(COLUMNS)
    robots = len(SPLIT.train) + len(SPLIT.test)
    assert len(rows) == robots * (4 + 4 + 8)
    assert {row[:5] == ["mine/small", "ik", "", "", "0"] for row in rows[:8]} == {True}


def test_a_row_may_have_the_means_of_episodes(tmp_path):
    head = data("ik") | BASELINE
    robot = head.pop("robots")[0]
    named = [SPLIT.name, "ik", "", "", 0, *(robot[key] for key in ("robot", "side", "task"))]
    row = [*named, robot["body"], "unknown", 4, 0.75, 12.5, 0.1, 300, 0.25, -2.0, 0.0]
    text = f"{','.join(COLUMNS)}\n# {json.dumps(head)}\n{','.join(map(str, row))}\n"
    (tmp_path / EPISODES).write_bytes(gzip.compress(text.encode()))
    (submission,) = read_submissions([tmp_path / EPISODES]).values()
    assert submission.robots[0].success == (True, True, True, False)
    assert submission.robots[0].diverged == (True, False, False, False)
    (result,) = result_rows({"a": submission})
    side = result.sides["train"]
    assert (side.episodes, side.score.value, side.success.value) == (4, 14.5, 0.75)


def broken(text):
    return gzip.compress(text.encode(), mtime=0)  # names of tests have the bytes, not the time


HEADER = ",".join(COLUMNS)
HEAD = json.dumps({key: value for key, value in data().items() if key != "robots"})


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (b"a,b\n", "is not a table of episodes"),
        (broken(HEADER)[:-9], "is not a table of episodes"),
        (gzip.compress(b"\xff", mtime=0), "is not a table of episodes"),
        (broken("a,b\n"), "line 1: expected the columns split,"),
        (broken(f"{HEADER}\n# {{}}\n"), "line 2: is not the head of a submission"),
        (broken(f"{HEADER}\n# {HEAD}\nmine/small,ours\n"), "line 2: the rows of its run are"),
        (broken(f'{HEADER}\n# {HEAD[:-1]}, "x": 1}}\n'), "line 2: unknown key 'x'"),
        *(
            (broken(f"{HEADER}\n# {HEAD}\n,,,,,,,,,,{count},1,1,1,1,1,,\n"), f": {count} episodes;")
            for count in (0, 10_001, 10**12)
        ),
    ],
)
def test_damaged_tables_are_refused(tmp_path, content, why):
    path = tmp_path / EPISODES
    path.write_bytes(content)
    with pytest.raises(BenchmarkError, match=why) as caught:
        read_submissions([path])
    assert str(caught.value).startswith(f"{path}: ")


def test_a_table_of_too_many_bytes_is_refused(table, monkeypatch):
    size = len(gzip.decompress(table.read_bytes()))
    monkeypatch.setattr(submission_module, "MAX_BYTES", size - 1)
    with pytest.raises(BenchmarkError, match=f"more than {size - 1} bytes without compression"):
        read_table(table)
    monkeypatch.setattr(submission_module, "MAX_BYTES", size)
    assert len(read_table(table)) == 3


@pytest.mark.parametrize(
    ("values", "why"),
    [
        (changed(data(), score=[]), r"train robot \S+: score: no episodes; expected one or more"),
        (changed(data(), random_score=[], random_success=[]), "random_score: no episodes"),
        (changed(data(), success=[]), "success: 0 episodes; expected 4, as in score"),
        (changed(data(), random_success=[]), "random_score: 4 episodes, random_success: 0"),
        (data() | {"robots": []}, "robots: none; expected one or more"),
        (data() | {"robots": data()["robots"][:1] * 2}, "is there twice"),
    ],
)
def test_incomplete_submissions_are_refused(tmp_path, values, why):
    (tmp_path / "a.json").write_text(json.dumps(values))
    with pytest.raises(BenchmarkError, match=rf"a\.json: .*{why}"):
        read_submissions([tmp_path])


def test_submissions_are_found_below_folders(tmp_path):
    deep = tmp_path / "study" / "cell"
    deep.mkdir(parents=True)
    (deep / "deterministic.json").write_text(json.dumps(data()))
    (deep / "config.json").write_text("{}")
    assert list(read_submissions([tmp_path])) == [str(deep / "deterministic.json")]
    (deep / "deterministic.json").unlink()
    with pytest.raises(BenchmarkError, match=r"no submissions below it"):
        read_submissions([tmp_path])
    for path in (tmp_path / "none", tmp_path / EPISODES):
        with pytest.raises(BenchmarkError, match=r"[Nn]o such file"):
            read_submissions([path])
    with pytest.raises(BenchmarkError, match=r"config\.json: "):
        read_submissions([deep / "config.json"])

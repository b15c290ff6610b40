"""The table of a study's episodes, and the reader of submissions in files and folders."""

import gzip
import json

import pytest

from helpers.submissions import SPLIT, data
from morphgen.errors import BenchmarkError
from morphgen.rl.scores import episode_table
from morphgen.rl.scores.episode_table import (
    COLUMNS,
    EPISODES,
    append_submission,
    mode_of,
    read_submissions,
    read_table,
)
from morphgen.rl.scores.score_tables import result_rows
from morphgen.rl.scores.submission import submission_from

TUNED = {"training": {"simulator": "warp", "transitions": 30, "finetuned": 10_000}}


def submissions():
    """Return a baseline, a policy with a config, and a fine-tuned one with further episodes."""
    baseline = data("ik", successes=2) | {"mode": "", "training_seed": None}
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
    assert [mode_of(each) for each in read_table(table)] == [
        *("", "deterministic", "fine-tuned 10,000")
    ]
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
    head = data("ik") | {"mode": "", "training_seed": None}
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
    assert (side.episodes, side.mean, side.success.value) == (4, 14.5, 0.75)


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
    monkeypatch.setattr(episode_table, "MAX_BYTES", size - 1)
    with pytest.raises(BenchmarkError, match=f"more than {size - 1} bytes without compression"):
        read_table(table)
    monkeypatch.setattr(episode_table, "MAX_BYTES", size)
    assert len(read_table(table)) == 3


def changed(values, **changes):
    values["robots"][0] |= changes
    return values


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

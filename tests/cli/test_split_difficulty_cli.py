"""``morphgen split difficulty``, and the difficulty of a release with reference scores."""

import csv
import json
import shutil
from importlib.metadata import version
from pathlib import Path

import numpy as np
from msgspec.structs import replace as replaced

from helpers.splits import combined
from helpers.submissions import data
from morphgen.benchmark.scores.submission import (
    EPISODES,
    EvalProtocol,
    SplitName,
    append_submission,
    expected_robots,
    read_table,
)
from morphgen.encoding.similarity import MEASURES
from morphgen.grammar.library import default_library
from morphgen.splits.split import sided_members, split_id
from morphgen.splits.split_file import read_split, split_text

STUDY = Path(__file__).parents[2] / "results" / "reach-30m"
ARM3 = "interpolation/arm3/reach"
WORDS = ("split", "difficulty")


def test_table_json_and_csv_have_a_row_per_robot(ok, small):
    out = ok(*WORDS, small, "--csv", "a.csv")
    title, header, _, *rows = out.splitlines()
    assert title == "mine/small"
    assert all(f"nearest by {name}" in header for name in MEASURES)
    assert [row.split()[:3] for row in rows[:4]] == [
        ["gantry-plane", "train", "reach"],
        ["planar-cube", "train", "reach"],
        ["gantry-cylinder", "train", "reach"],
        ["planar-plane", "test", "reach"],
    ]
    assert out.splitlines()[-1] == "a.csv"
    first = Path("a.csv").read_bytes()
    out = ok(*WORDS, small, "--csv", "a.csv", "--json", "--jobs", "2")
    assert Path("a.csv").read_bytes() == first
    data = json.loads(out)
    assert data["files"] == ["a.csv"]
    for line, row in zip(csv.DictReader(first.decode().splitlines()), data["rows"], strict=True):
        assert (line["robot"], float(line["reach"])) == (row["robot"], row["reach"])
        assert line["obstacles"] == "false"
        for name in MEASURES:
            nearest = {"train": line[f"{name}_nearest"], "value": float(line[name])}
            assert row["nearest"][name] == nearest
    assert "baselines" not in data["rows"][0]


def test_several_splits_have_the_baselines_of_all_their_tasks(ok, small):
    split = combined()
    stored = {each.method: each for each in read_table(STUDY / EPISODES) if each.split.name == ARM3}
    (first, *_), table = stored["zero"].robots, Path("study") / EPISODES
    table.parent.mkdir()
    push = {"task": "push", "score": (-0.09, 0.01) * 17}  # of 34 episodes
    robot = replaced(first, success=(True, False) * 17, **push)
    robots = [replaced(robot, robot=x.name, side=side) for side, x in sided_members(split)]
    for name in ("scripted", "zero"):
        name_and_id = {"name": split.name, "id": split_id(split)}
        other = replaced(stored["zero"], method=name, robots=tuple(robots))
        append_submission(table, replaced(other, split=SplitName(**name_and_id)))
    names = ["random", "zero", "jacobian", "ik", "scripted"]
    for name in names[:-1]:
        append_submission(table, stored[name])
    Path("push.yaml").write_text(split_text(split))
    out = ok(*WORDS, "push.yaml", ARM3, "--study", "study", "--csv", "a.csv")
    header, *lines = csv.reader(Path("a.csv").read_text().splitlines())
    assert header[-10::2] == [f"{name}_score" for name in names]
    rows = [dict(zip(header, line, strict=True)) for line in lines]
    push, reach = rows[0], rows[-1]
    assert [push[f"{name}_success"] for name in names] == ["", "0.500000", "", "", "0.500000"]
    assert [reach[f"{name}_success"] for name in names] == [
        *(f"{np.mean(stored[name].robots[-1].success):.6f}" for name in names[:-1]),
        "",
    ]
    first, second = out.split(f"\n\n{ARM3}\n")
    assert first.splitlines()[1].split()[-2:] == ["zero", "scripted"]
    assert second.splitlines()[0].split()[-2:] == ["jacobian", "ik"]
    assert ".0, " in out
    assert "-0.0" not in out


def test_studies_of_other_splits_are_refused(refused, small):
    assert "'mine/small' is also in small.yaml" in refused(*WORDS, small, small)
    err = refused(*WORDS, small, "--study", STUDY)
    assert "no episodes of baselines on split 'mine/small'" in err


def test_a_release_has_the_results_of_the_submitted_baselines(run, small):
    split, protocol = read_split(small), EvalProtocol()
    expected = expected_robots(split, protocol, default_library())
    values = data(split=split, expected=expected, protocol=protocol, episodes=protocol.episodes)
    values |= {"morphgen": version("morphgen"), "method": "ik", "mode": "", "training_seed": None}
    Path("ik.json").write_text(json.dumps(values))
    release = ("split", "release", "--light", "--no-goals", small, "--scores", "ik.json")
    assert run(*release)[0] == 0
    archive = Path("releases/mine-small-1.0.0.zip")
    assert run(*release, "--out", "again", "--jobs", "2")[0] == 0
    assert Path("again", archive.name).read_bytes() == archive.read_bytes()
    shutil.unpack_archive(archive, ".")
    text = Path("mine-small-1.0.0", "difficulty.csv").read_text()
    header, *lines = csv.reader(text.splitlines())
    assert header[-2:] == ["ik_score", "ik_success"]
    # Three of 34 episodes succeed with 150, 151 and 152; the others have -1, and random has -2.
    score = (150 + 151 + 152 - 31) / 34 + 2
    assert {tuple(line[-2:]) for line in lines} == {(f"{score:.6f}", f"{3 / 34:.6f}")}
    assert run("split", "verify", archive)[0] == 0
    assert run(*WORDS, "mine-small-1.0.0", "--csv", "a.csv")[0] == 0  # the unpacked release
    assert [line[:-2] for line in csv.reader(text.splitlines())] == [
        *csv.reader(Path("a.csv").read_text().splitlines())
    ]

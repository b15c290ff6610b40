"""``morphgen goals``: output, failures and rejected input."""

import json

import pytest

from helpers.splits import LIBRARY, TEST, TRAIN, member, split
from morphgen.benchmark.split_folder import build_split
from morphgen.splits.split import split_text
from morphgen.tasks import free_space
from morphgen.tasks.registry import TASKS

pytestmark = pytest.mark.usefixtures("goal_cache")


def some():
    train = [member(TRAIN[0], task="reach"), member("arm=arm3 ee=claw", task="reach")]
    return split(train, [member(TEST[0], task="reach", obstacles=True)])


@pytest.fixture
def path(tmp_path):
    (tmp_path / "some.yaml").write_text(split_text(some()))
    return "some.yaml"


def cells(line):
    return [cell for cell in line.split("  ") if cell]


def test_table_has_one_row_per_goal_set(ok, path, goal_cache):
    out = ok("goals", path)
    head, _, *rows, last = out.splitlines()
    columns = ["robot", "side", "task", "goals", "acceptance", "obstacles", "certified"]
    assert head.split() == columns
    assert [[cell.strip() for cell in cells(row)][:4] for row in rows] == [
        ["gantry-plane", "train", "reach", "100"],
        ["arm3-claw", "train", "reach", "100"],
        ["planar-plane", "test", "reach", "100"],
    ]
    assert [row.split()[5] for row in rows] == ["0", "0", "3"]
    assert last == "3 of 3 goal sets are complete, seed 0"
    assert len(list((goal_cache / "goals-5").iterdir())) == 3


def test_json_option_prints_only_json(run, ok, path):
    out = ok("goals", path, "--json", "--seed", 3, "--certify")
    data = json.loads(out)
    assert (data["seed"], data["passed"], data["failures"]) == (3, True, [])
    first = data["sets"][0]
    assert (first["robot"], first["side"], first["task"]) == ("gantry-plane", "train", "reach")
    assert (first["goals"], first["seed"], first["certified"]) == (100, 3, True)
    assert first["acceptance"] == first["accepted"] / first["tried"]
    sets = json.loads(run("goals", path, "--json")[1])["sets"]
    assert [one["certified"] for one in sets] == [None] * 3


def test_robot_without_enough_goals_does_not_stop_the_others(run, tmp_path, monkeypatch):
    monkeypatch.setattr(free_space, "TRIES", 1)
    fine = [member(words, task="reach") for words in (TRAIN[0], TRAIN[1])]
    few = member("arm=arm3 ee=claw", task="reach")
    path = tmp_path / "few.yaml"
    path.write_text(split_text(split([fine[0], few], [fine[1]])))
    code, out, err = run("goals", path)
    assert (code, err) == (1, "")
    lines = out.splitlines()
    assert [line.split()[3] for line in lines[2:5]] == ["100", "none", "100"]
    assert lines[5].startswith("train robot arm3-claw: robot 'arm3-claw': only ")
    assert "(acceptance rate 0." in lines[5]
    assert lines[6:] == ["2 of 3 goal sets are complete, seed 0"]
    data = json.loads(run("goals", path, "--json")[1])
    assert (data["passed"], len(data["sets"])) == (False, 2)
    assert [(one["robot"], one["side"]) for one in data["failures"]] == [("arm3-claw", "train")]


def test_unproven_goals_give_exit_code_1(run, path, monkeypatch):
    lines = [f"goal {i}: its configuration is in collision" for i in (3, 4)]
    monkeypatch.setattr(TASKS["reach"], "certify", lambda *_: lines)
    assert run("goals", path)[0] == 0
    code, out, _ = run("goals", path, "--certify")
    assert code == 1
    printed = out.splitlines()
    assert [line.split()[-1] for line in printed[2:5]] == ["NO"] * 3
    assert printed[5] == f"train robot gantry-plane: {lines[0]} (and 1 more)"
    data = json.loads(run("goals", path, "--certify", "--json")[1])
    assert (data["passed"], data["sets"][0]["unproven"]) == (False, lines)


def test_robot_can_be_given_as_parts_name_or_folder(run, ok, tmp_path):
    run("compose", "base=gantry", "ee=plane", "--no-picture", "--geometry", "primitive")
    keys = set()
    for words in (("base=gantry", "ee=plane"), ("gantry-plane",), ("robots/gantry-plane",)):
        out = ok("goals", *words, "--task", "reach", "--certify")
        (row,) = out.splitlines()[2:-1]
        assert row.split()[:3] == ["gantry-plane", "reach", "100"]
        (one,) = json.loads(run("goals", *words, "--task", "reach", "--json")[1])["sets"]
        keys.add(one["key"])
        assert one["side"] is None
    assert len(keys) == 1


def test_single_robot_gets_push_goals_with_obstacles(ok):
    out = ok("goals", "gantry-plane", "--task", "push", "--obstacles", "--certify")
    assert out.splitlines()[2].split()[1:3] == ["push", "100"]
    assert out.splitlines()[2].split()[-2:] == ["3", "yes"]


def test_split_folder_is_accepted_as_split(run, tmp_path):
    built = build_split(some(), tmp_path / "data", LIBRARY)
    assert run("goals", built.folder)[1].endswith("3 of 3 goal sets are complete, seed 0\n")

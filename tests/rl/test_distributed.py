"""Training by several processes that torchrun starts."""

import json
import math
import subprocess
import sys

import pytest
import torch

from morphgen.cli import main
from morphgen.errors import TaskError
from morphgen.rl.distributed import ALONE, ProcessGroup, process_group
from morphgen.rl.runs.checkpoint import read_checkpoint

TRAIN = ("train", "interpolation/arm3/reach", "--sim", "kinematic", "--envs", "40", "--steps")
UPDATE = 32 * 40
"""Transitions of an update."""


def train_by_two(folder, updates, *options):
    """Train in two processes; every process also saves its actor. Return the text of stderr."""
    script = folder.parent / "train.py"
    script.write_text(
        "import os, sys, torch\n"
        "from morphgen.cli import main\n"
        "from morphgen.rl.runs import training\n"
        "inner = training._learn\n"
        "def learn(learner, *rest):\n"
        "    inner(learner, *rest)\n"
        "    torch.save(learner.actor.state_dict(), f\"{sys.argv[1]}.{os.environ['RANK']}\")\n"
        "training._learn = learn\n"
        "code = main(sys.argv[2:])\n"
        "tasks = [f'/proc/self/task/{each}/comm' for each in os.listdir('/proc/self/task')]\n"
        "assert not [name for name in map(open, tasks) if 'gloo' in name.read()]\n"
        "sys.exit(code)\n"
    )
    words = (*TRAIN, str(updates * UPDATE), "--out", folder, "--no-tensorboard", *options)
    torchrun = (sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2")
    command = [*map(str, (*torchrun, script, folder, *words))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.fixture(scope="module")
def two(tmp_path_factory):
    """A run of two processes, and the text that they printed."""
    folder = tmp_path_factory.mktemp("runs") / "two"
    return folder, train_by_two(folder, 3)


def test_two_processes_learn_one_policy(two):
    folder, err = two
    assert err.count("score it: morphgen eval") == 1
    first, second = (torch.load(f"{folder}.{rank}", weights_only=True) for rank in "01")
    assert all(first[name].equal(second[name]) for name in first)
    lines = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    assert [line["transitions"] for line in lines] == [UPDATE, 2 * UPDATE, 3 * UPDATE]
    assert len(lines[0]["scores"]) == 10
    assert lines[0]["score"] == pytest.approx(sum(lines[0]["scores"]) / 10)
    _, state = read_checkpoint(folder)
    assert len(state["batch"]["next_episode"]) == 40
    assert len(state["generators"]["actions"]) == 2


def test_one_process_finetunes_the_policy_of_two(two, tmp_path):
    words = ("finetune", two[0], "--sim", "kinematic", "--envs", "40", "--steps", UPDATE)
    assert main([*map(str, (*words, "--out", tmp_path, "--no-tensorboard"))]) == 0


def test_a_run_of_two_processes_is_not_resumed_by_one(two, capsys):
    folder, _ = two
    config = json.loads((folder / "config.json").read_text())
    config["ppo"]["total_timesteps"] = 9 * UPDATE
    (folder / "config.json").write_text(json.dumps(config))
    words = [*TRAIN, str(9 * UPDATE), "--out", str(folder), "--no-tensorboard", "--resume"]
    assert main(words) == 2
    assert "processes 2, here 1" in capsys.readouterr().err


def test_environments_are_shared_equally():
    assert ProcessGroup(1, 4).share(40, "--envs") == range(10, 20)
    assert ALONE.share(7, "--envs") == range(7)
    with pytest.raises(TaskError, match="--envs 42: expected a multiple of the 4 processes"):
        ProcessGroup(1, 4).share(42, "--envs")


@pytest.mark.slow
def test_two_processes_share_more_robots_than_each_has_environments(tmp_path):
    train_by_two(tmp_path / "few", 1, "--envs", "10", "--task-reweighting")
    lines = (tmp_path / "few" / "metrics.jsonl").read_text().splitlines()
    scores = [json.loads(line)["scores"] for line in lines]
    assert [len(each) for each in scores] == [10] * 4
    assert all(math.isfinite(score) for each in scores for score in each)


def test_a_numbered_device_is_refused_with_several_processes(monkeypatch):
    monkeypatch.setenv("WORLD_SIZE", "2")
    with pytest.raises(TaskError, match="expected --device cuda"), process_group("cuda:1"):
        pass

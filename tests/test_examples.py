"""The examples run; an external task supports everything that the built-in tasks do."""

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from morphgen.cli import main
from morphgen.grammar.library import default_library
from morphgen.rl.runs import read_checkpoint
from morphgen.rl.shipped_policies import checkpoint_path
from morphgen.tasks.registry import TASKS
from morphgen.viewer.address import Address
from morphgen.viewer.episode import episode_bytes, read_episode
from morphgen.viewer.episode_export import record_scene
from morphgen.viewer.page_play_controls import parse_rollout
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.rollout import Rollout, RolloutConfig

CUSTOM_TASK = Path(__file__).parents[1] / "examples" / "custom_task.py"
RUN = "runs/planar-cube-follow/me-graph/seed0"


@pytest.fixture
def follow(monkeypatch, tmp_path):
    """Register the example task for one test."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))
    spec = importlib.util.spec_from_file_location("custom_task", CUSTOM_TASK)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, "custom_task", module)
    spec.loader.exec_module(module)


@pytest.mark.slow
def test_external_task_can_be_trained_played_and_viewed(follow, tmp_path, capsys, monkeypatch):
    assert len(CUSTOM_TASK.read_text(encoding="utf-8").splitlines()) < 150
    few = ("--steps", "512", "--envs", "4", "--set", "minibatches=4", "--no-tensorboard")
    robot, sim = "planar-cube", ("--sim", "mujoco")
    monkeypatch.setattr(sys, "argv", ["follow.py"])
    assert main(["train", robot, "task=follow", *sim, *few]) == 0
    watch = f"watch it: python follow.py play follow {robot} --policy {RUN} --sim mujoco"
    assert watch in capsys.readouterr().err
    assert main(["eval", RUN, "--episodes", "1"]) == 0
    assert "follow" in capsys.readouterr().out
    assert main(["play", "follow", robot, "--policy", RUN, *sim]) == 0
    assert "m from the goal" in capsys.readouterr().out
    assert main(["goals", robot, "--task", "follow", "--certify"]) == 0

    places = FileAccess(default_library().folders, (tmp_path,), tmp_path / "none")
    assert parse_rollout(Address("play", ("follow",)), []).task == "follow"
    rollout = Rollout(RolloutConfig("follow", ("words:base=planar ee=cube",), RUN), places)
    while rollout.advance():
        pass
    rollout.close()
    (track,) = rollout.episode.tracks
    assert track.num_steps == 200
    goals = np.array(track.marker_poses["goal"])
    assert goals.shape == (201, 7)
    assert np.linalg.norm(goals[100, :2] - goals[0, :2]) == pytest.approx(0.1, abs=1e-3)
    (tmp_path / "episode.npz").write_bytes(episode_bytes(rollout.episode))
    read = read_episode(tmp_path / "episode.npz", places).tracks[0]
    assert np.array_equal(read.marker_poses["goal"], goals)
    assert record_scene(rollout.episode)


def test_files_of_before_a_task_existed_are_read(follow, monkeypatch):
    monkeypatch.setattr(TASKS, "builtin", (*TASKS.builtin, "follow"))
    config, _ = read_checkpoint(checkpoint_path("zero-shot"))
    assert [each.task for each in config.tasks] == ["reach", "push"]
    assert "follow" in config.as_data()

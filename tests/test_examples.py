"""The examples run; an external task supports everything that the built-in tasks do."""

import ast
import importlib.util
import re
import runpy
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from morphgen import make_env
from morphgen.cli import main
from morphgen.grammar.library import default_library
from morphgen.rl.baselines import baselines_for
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.shipped_policies import checkpoint_path
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.viewer.pages.play import default_policy
from morphgen.viewer.robot_uri import FileAccess
from morphgen.viewer.rollout import RolloutConfig
from morphgen.viewer.scene.rollout import episode_page
from morphgen.viewer.simulation import Rollout

EXAMPLES = Path(__file__).parents[1] / "examples"
CUSTOM_TASK = EXAMPLES / "09_custom_task.py"
SCRIPTS = sorted(EXAMPLES.glob("*.py"))
OUTPUTS = {
    "01_compose": ([], "tool after 0.5 s: z = 0.352 m"),
    "02_own_part": ([], "error: .*length.*2"),
    "03_grammar": (["20"], "20 robots, last links: {'ee_plate': "),
    "04_fit": ([], "ee_right_gripper_base_link: Cylinder, IoU 0.99"),
    "05_split": ([], "passed: True, 0 findings"),
    "06_gymnasium": ([], "jacobian controller: .* m from the goals"),
    "07_stable_baselines3": (["512"], "after 512 steps: .* m from the goals"),
    "08_train": (["4096"], "film: reach.mp4"),
    "09_custom_task": (["goals", "planar-cube", "--task", "follow"], "1 of 1 goal sets"),
    "10_viewer": (["0"], "http://127.0.0.1:[0-9]+ "),
    "11_goal_set": ([], r"faults: \[\]\nfaults: \['goal 0: the tool"),
}
"""Arguments of each example, and a pattern that its output has."""
SLOW = ("04_fit", "08_train")
"""Examples that take half a minute; the functions that they call have tests of their own."""
RUN = "runs/planar-cube-follow/me-graph/seed0"


@pytest.fixture
def run(monkeypatch, tmp_path, capsys):
    """Return a function that runs an example in an empty folder and returns what it prints."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))

    def run_example(name, *arguments):
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        with suppress(SystemExit):
            runpy.run_path(str(EXAMPLES / f"{name}.py"), run_name="__main__")
        return capsys.readouterr().out

    return run_example


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] * (name in SLOW)) for name in OUTPUTS]
)
def test_example_prints_what_it_says(name, run):
    arguments, pattern = OUTPUTS[name]
    assert re.search(pattern, run(name, *arguments))


def test_every_example_is_run_and_listed():
    names = {path.stem for path in SCRIPTS}
    assert names == OUTPUTS.keys()
    readme = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    assert re.findall(r"(?m)^\| \[(\w+)\.py\]", readme) == sorted(names)


@pytest.mark.parametrize("path", SCRIPTS, ids=lambda path: path.stem)
def test_example_is_short_and_says_what_it_prints(path):
    text = path.read_text(encoding="utf-8")
    # All that a task consists of is longer than the use of what exists.
    assert len(text.splitlines()) < (125 if path == CUSTOM_TASK else 80)
    assert "Prints" in ast.get_docstring(ast.parse(text))


def test_notebooks_are_up_to_date():
    build = runpy.run_path(str(EXAMPLES / "notebooks" / "build.py"))
    folder = EXAMPLES / "notebooks"
    stored = {path.stem: path.read_text(encoding="utf-8") for path in folder.glob("*.ipynb")}
    made = {name: build["notebook_text"](each) for name, each in build["NOTEBOOKS"].items()}
    assert stored == made, "run examples/notebooks/build.py"


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


def test_the_state_of_an_external_task_is_that_of_its_episodes(follow):
    config = TASKS["follow"].config_type()
    env = make_env("follow", "planar-cube", sim="kinematic")
    batch = make_batch("follow", ["planar-cube"], 2, sim="kinematic", seed=1)
    batch.reset()
    for _ in range(2):
        observation, _ = env.reset(seed=1)
        first = observation["goal"].copy()
        assert observation["time"] == 0
        for _ in range(5):
            observation, reward, *_ = env.step(np.zeros(env.action_space.shape, np.float32))
            step = batch.step(torch.zeros(batch.action_mask.shape))
        angle = 2 * np.pi * 5 * CONTROL_PERIOD / config.period
        moved = config.radius * np.array([np.cos(angle) - 1, np.sin(angle), 0])
        assert observation["goal"][:3] - first[:3] == pytest.approx(moved, abs=1e-6)
        assert observation["time"] == pytest.approx(5 * CONTROL_PERIOD)
        assert reward <= 0.1
    assert step.final_observation["time"].flatten().tolist() == pytest.approx([0.2, 0.2])


@pytest.mark.slow
def test_external_task_can_be_trained_played_and_viewed(follow, tmp_path, capsys, monkeypatch):
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
    assert default_policy("follow", obstacles=False) in baselines_for("follow")
    rollout = Rollout(RolloutConfig("follow", ("words:base=planar ee=cube",), RUN), places)
    while rollout.advance():
        pass
    rollout.close()
    (track,) = rollout.episode.tracks
    assert track.num_steps == 200
    goals = np.array(track.poses["goal"])
    assert goals.shape == (201, 7)
    assert np.linalg.norm(goals[100, :2] - goals[0, :2]) == pytest.approx(0.1, abs=1e-3)
    assert episode_page(rollout.episode, dark=False)


def test_files_of_before_a_task_existed_are_read(follow):
    config, _ = read_checkpoint(checkpoint_path("zero-shot"))
    assert [each.task for each in config.tasks] == ["reach", "push"]
    assert "follow" not in config.as_data()
    assert "follow" in GoalConfig(tasks=config.tasks).as_data(["follow"])

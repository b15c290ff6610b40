"""``morphgen play``, ``speed`` and ``zeroshot``: output, and the policies that are shipped."""

import json
import re

import imageio.v2 as imageio
import pytest

from helpers.commands import tree
from helpers.simulators import PYBULLET
from morphgen.cli import progress
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.shipped_policies import POLICIES, ShippedPolicy, policies_for

pytestmark = pytest.mark.usefixtures("own_cache")
LINE = re.compile(
    r"episode (\d+): (success|failure), (\d+\.\d{3}) m from the (goal|line), "
    r"score (-?\d+\.\d\d), (\d+\.\d\d) s"
)


def parse_episodes(out):
    """Parse the printed line of every episode."""
    return [LINE.fullmatch(line).groups() for line in out.splitlines() if "episode" in line]


def test_ik_policy_reaches_the_goal(ok, tmp_path):
    out = ok("play", "reach", "arm3-stick", "--policy", "ik", "--sim", "mujoco")
    ((number, result, distance, place, score, seconds),) = parse_episodes(out)
    assert (number, result, place, seconds) == ("1", "success", "goal", "6.00")
    assert float(distance) < 0.03
    assert float(score) > 0
    assert tree(tmp_path) == {}


@pytest.mark.slow
def test_scripted_policy_pushes_before_the_time_limit_and_is_recorded(ok, tmp_path):
    words = ("play", "push", "prims", "--policy", "scripted", "--sim", "mujoco")
    out = ok(*words, "--out", "push.mp4")
    ((_, result, distance, place, score, seconds),) = parse_episodes(out)
    assert (result, distance, place, score) == ("success", "0.000", "line", "1.00")
    assert float(seconds) < 6
    assert out.splitlines()[-1] == "push.mp4"
    assert list(tree(tmp_path)) == ["push.mp4"]
    with imageio.get_reader("push.mp4") as film:
        frames, fps = film.count_frames(), film.get_meta_data()["fps"]
    assert fps == 25
    assert 0 <= frames / fps - float(seconds) <= 0.08


def test_baselines_play_with_goals_that_are_poses(ok):
    words = ("play", "reach", "arm3-stick", "--policy", "ik", "--sim", "mujoco", "--goal", "pose")
    out = ok(*words)
    result, angle = re.match(r"episode 1: (\w+), .* m and (.*) degrees from the goal", out).groups()
    assert result == "success"
    assert float(angle) < 10


def test_episodes_differ_and_are_reproducible(run):
    words = ("play", "reach", "arm3-stick", "--sim", "mujoco", "--episodes", "2", "--obstacles")
    outs = [run(*words, "--seed", seed, "--kind", "discrete")[1] for seed in (1, 1, 2)]
    assert outs[0] == outs[1] != outs[2]
    first, second = parse_episodes(outs[0])
    assert first[2:] != second[2:]


@pytest.mark.slow
def test_zero_policy_does_not_move(ok):
    out = ok("play", "push", "prims", "--policy", "zero", "--sim", "mujoco")
    ((_, result, distance, _, score, seconds),) = parse_episodes(out)
    assert (result, score, seconds) == ("failure", "0.00", "6.00")
    assert 0.3 < float(distance) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("sim", [PYBULLET, "mujoco", "kinematic"])
def test_speed_prints_rates_and_shares(sim, ok):
    words = ["speed", "reach", "arm3", "--envs", "2", "--seconds", "0.05", "--sim", sim]
    facts = json.loads(ok(*words, "--json"))
    assert facts["steps_per_second"] > 0
    assert sum(facts["shares"].values()) == pytest.approx(1)
    assert facts["shares"]["simulator"] > 0
    text = ok(*words)
    assert f"reach, arm3, 2 environments, {sim}, cpu, 1 worker(s)" in text
    assert "physics steps per second" in text


def test_robots_above_the_default_max_links_can_be_measured(ok):
    words = ["speed", "reach", "chain", "beads=7", "--envs", "1", "--seconds", "0.05"]
    assert "reach, chain" in ok(*words, "--sim", "mujoco")


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_shipped_policies_are_small_and_act_on_any_robot(name):
    policy = POLICIES[name]
    run_config, learner = read_checkpoint(policy.file)
    assert policy.file.stat().st_size < 2e6
    assert run_config.interface.max_links is None
    assert run_config.source.grammars, "it was trained on drawn robots alone"
    assert learner["update"] == run_config.num_updates
    for task in ("reach", "push"):
        assert (name in policies_for(task)) == (task in policy.tasks)
        assert (task in policy.tasks) == (task == run_config.source.task)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "controllers"),
    [
        ("--obstacles", ["zero-shot-obstacles", "ik", "jacobian", "random"]),
        ("--goal pose", ["zero-shot-pose", "ik", "jacobian", "random"]),
        ("--goal pose --obstacles", ["zero-shot-pose-obstacles", "ik", "jacobian", "random"]),
        ("--task push", ["zero-shot-push", "scripted", "random"]),
        ("--task door", ["zero-shot-door", "scripted", "random"]),
    ],
)
def test_each_variant_has_a_policy_and_controllers_to_compare(options, controllers, ok):
    out = ok("zeroshot", "ur5-stick", *options.split(), "--episodes", "1")
    head, _, *rows = out.splitlines()
    assert [row.split()[0] for row in rows] == controllers
    assert ("angle" in head) == ("pose" in options)
    assert ("score" in head) == ("push" not in options)


def test_results_are_beside_controllers_that_do_not_learn(ok):
    rows = json.loads(ok("zeroshot", "arm3-stick", "--episodes", "2", "--json"))
    assert [row["controller"] for row in rows] == ["zero-shot", "ik", "jacobian", "random"]
    for row in rows:
        assert row["episodes"] == 2
        assert row["success"]["low"] <= row["success"]["value"] <= row["success"]["high"]


def test_a_table_follows_the_episodes_of_each_controller(run, monkeypatch):
    for name in ("FIRST_LINE", "LINE_INTERVAL"):
        monkeypatch.setattr(progress, name, -1.0)
    code, out, err = run("zeroshot", "arm3-stick", "--episodes", "2")
    controllers = ["zero-shot", "ik", "jacobian", "random"]
    head, _, *rows = out.splitlines()
    assert (code, head.split()) == (0, ["controller", "success", "distance", "[m]", "score"])
    assert [row.split()[0] for row in rows] == controllers
    assert float(rows[1].split()[-2]) < 0.03 < float(rows[-1].split()[-2])  # ik, random [m]
    assert float(rows[-1].split()[-1]) == 0  # scores are relative to it
    ended = re.findall(r"(?m)^(\S+): 2 of 2 episodes, \d+ s$", err)
    assert list(dict.fromkeys(ended)) == controllers


def test_a_shipped_policy_is_named_like_a_checkpoint(ok, run, tmp_path):
    words = ["zero-shot", "--split", "interpolation/arm3/reach", "--on", "test", "--sim", "mujoco"]
    out = ok("eval", *words, "--episodes", "1", "--mode", "deterministic", "--json")
    (score,) = json.loads(out)["deterministic"]
    assert score["episodes"] == 1
    few = ["--steps", "64", "--envs", "2", "--set", "num_steps=8", "--set", "minibatches=2"]
    assert run("finetune", *words, *few, "--no-tensorboard", "--out", tmp_path)[0] == 0
    tuned, _ = read_checkpoint(tmp_path / "checkpoint.pt")
    assert tuned.initial_checkpoint == str(POLICIES["zero-shot"].file)


def test_other_packages_register_policies(monkeypatch, ok):
    monkeypatch.setattr(POLICIES, "_loaded", {})
    POLICIES.register(ShippedPolicy("mine", POLICIES["zero-shot"].file, ("reach",)))
    poses = ("zero-shot-pose", "zero-shot-pose-obstacles")
    assert policies_for("reach")[-5:] == ("zero-shot", "zero-shot-obstacles", *poses, "mine")
    words = ["arm=arm3", "ee=stick", "--policy", "mine", "--sim", "mujoco"]
    assert "episode 1" in ok("play", "reach", *words)


@pytest.mark.slow
def test_the_shipped_policy_reaches_with_real_arms(ok):
    policy, ik, _, random = json.loads(ok("zeroshot", "ur5-stick", "--episodes", "40", "--json"))
    assert policy["success"]["low"] > 0.5 > random["success"]["high"]
    assert ik["success"]["value"] == 1

"""``morphgen zeroshot``: the shipped policy on robots that it never saw."""

import json

import pytest

from morphgen.cli import main
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.shipped_policies import POLICIES, ShippedPolicy, policies_for


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
    ],
)
def test_each_variant_has_a_policy_and_controllers_to_compare(options, controllers, capsys):
    words = ["arm=ur5", "ee=stick", *options.split(), "--episodes", "1"]
    assert main(["zeroshot", *words]) == 0
    head, _, *rows = capsys.readouterr().out.splitlines()
    assert [row.split()[0] for row in rows] == controllers
    assert ("angle" in head) == ("pose" in options)
    assert ("score" in head) == ("push" not in options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ("--task pull", "unknown task 'pull'"),
        ("--task push --obstacles", "no policy for push among obstacles comes with morphgen"),
        ("--task push --goal pose", "--goal pose is for task reach"),
        ("--task push --policy zero-shot", "policy zero-shot was trained on reach, not on push"),
        ("--policy missing.pt", "missing.pt"),
    ],
)
def test_variants_without_a_policy_are_refused(options, message, capsys):
    assert main(["zeroshot", "arm=ur5", "ee=stick", *options.split()]) == 2
    assert message in capsys.readouterr().err


def test_a_policy_for_poses_has_other_observations(capsys):
    words = ["arm=ur5", "ee=stick", "--policy", "zero-shot-pose", "--goal", "position"]
    assert main(["zeroshot", *words, "--episodes", "1"]) == 2
    assert "the checkpoint is for other observations" in capsys.readouterr().err


def test_results_are_beside_controllers_that_do_not_learn(capsys):
    code = main(["zeroshot", "arm=ur5", "ee=stick", "--episodes", "2", "--json"])
    assert code == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["controller"] for row in rows] == ["zero-shot", "ik", "jacobian", "random"]
    for row in rows:
        assert row["episodes"] == 2
        assert row["success"]["low"] <= row["success"]["value"] <= row["success"]["high"]


def test_the_shipped_policy_is_for_reach_alone(capsys):
    assert main(["play", "push", "prims", "--policy", "zero-shot"]) == 2
    assert "policy 'zero-shot' is for reach, not for push" in capsys.readouterr().err


def test_a_shipped_policy_is_named_like_a_checkpoint(capsys, tmp_path):
    words = ["zero-shot", "--split", "interpolation/arm3/reach", "--on", "test", "--sim", "mujoco"]
    assert main(["eval", *words, "--episodes", "1", "--mode", "deterministic", "--json"]) == 0
    captured = capsys.readouterr()
    (score,) = json.loads(captured.out)["deterministic"]
    assert score["episodes"] == 1
    assert "unknown" not in captured.err
    few = ["--steps", "64", "--envs", "2", "--set", "num_steps=8", "--set", "minibatches=2"]
    assert main(["finetune", *words, *few, "--no-tensorboard", "--out", str(tmp_path)]) == 0
    assert read_checkpoint(tmp_path / "checkpoint.pt")[0].initial_checkpoint == str(
        POLICIES["zero-shot"].file
    )


def test_other_packages_register_policies(monkeypatch, capsys):
    monkeypatch.setattr(POLICIES, "_loaded", {})
    POLICIES.register(ShippedPolicy("mine", POLICIES["zero-shot"].file, ("reach",)))
    poses = ("zero-shot-pose", "zero-shot-pose-obstacles")
    assert policies_for("reach")[-5:] == ("zero-shot", "zero-shot-obstacles", *poses, "mine")
    words = ["arm=arm3", "ee=stick", "--policy", "mine", "--sim", "mujoco"]
    assert main(["play", "reach", *words]) == 0
    assert "episode 1" in capsys.readouterr().out


@pytest.mark.slow
def test_the_shipped_policy_reaches_with_real_arms(capsys):
    code = main(["zeroshot", "arm=ur5", "ee=stick", "--episodes", "40", "--json"])
    assert code == 0
    policy, ik, _, random = json.loads(capsys.readouterr().out)
    assert policy["success"]["low"] > 0.5 > random["success"]["high"]
    assert ik["success"]["value"] == 1

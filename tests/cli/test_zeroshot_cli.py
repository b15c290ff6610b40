"""``morphgen zeroshot``: the shipped policy on robots that it never saw."""

import json

import pytest

from morphgen.cli import main
from morphgen.rl.runs import read_checkpoint
from morphgen.rl.shipped_policies import POLICIES, ZERO_SHOT, ShippedPolicy, policies_for


def test_the_shipped_policy_is_small_and_acts_on_any_robot():
    run_config, _ = read_checkpoint(ZERO_SHOT.file)
    assert ZERO_SHOT.file.stat().st_size < 2e6
    assert run_config.interface.max_links is None
    assert run_config.source.grammars, "it was trained on drawn robots alone"
    assert ZERO_SHOT.name in policies_for("reach")
    assert ZERO_SHOT.name not in policies_for("push")


def test_among_obstacles_another_policy_comes_with_morphgen(capsys):
    words = ["arm=ur5", "ee=stick", "--obstacles", "--episodes", "2", "--json"]
    assert main(["zeroshot", *words]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert rows[0]["controller"] == "zero-shot-obstacles"


def test_results_are_beside_controllers_that_do_not_learn(capsys):
    code = main(["zeroshot", "arm=ur5", "ee=stick", "--episodes", "2", "--json"])
    assert code == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["controller"] for row in rows] == [ZERO_SHOT.name, "jacobian", "ik", "random"]
    for row in rows:
        assert row["episodes"] == 2
        assert row["success"]["low"] <= row["success"]["value"] <= row["success"]["high"]


def test_the_shipped_policy_is_for_reach_alone(capsys):
    assert main(["play", "push", "prims", "--policy", ZERO_SHOT.name]) == 2
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
    assert read_checkpoint(tmp_path / "checkpoint.pt")[0].initial_checkpoint == str(ZERO_SHOT.file)


def test_other_packages_register_policies(monkeypatch, capsys):
    monkeypatch.setattr(POLICIES, "_loaded", {})
    POLICIES.register(ShippedPolicy("mine", ZERO_SHOT.file, ("reach",)))
    assert policies_for("reach")[-3:] == ("zero-shot", "zero-shot-obstacles", "mine")
    words = ["arm=arm3", "ee=stick", "--policy", "mine", "--sim", "mujoco"]
    assert main(["play", "reach", *words]) == 0
    assert "episode 1" in capsys.readouterr().out


@pytest.mark.slow
def test_the_shipped_policy_reaches_with_real_arms(capsys):
    code = main(["zeroshot", "arm=ur5", "ee=stick", "--episodes", "40", "--json"])
    assert code == 0
    policy, _, ik, random = json.loads(capsys.readouterr().out)
    assert policy["success"]["low"] > 0.5 > random["success"]["high"]
    assert ik["success"]["value"] == 1

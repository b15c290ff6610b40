"""``morphgen zeroshot``: the shipped policy on robots that it never saw."""

import json

import pytest

from morphgen.cli import main
from morphgen.rl.baselines import ZERO_SHOT, policies_for
from morphgen.rl.play import ZERO_SHOT_FILE
from morphgen.rl.runs import read_checkpoint


def test_the_shipped_policy_is_small_and_acts_on_any_robot():
    run_config, _ = read_checkpoint(ZERO_SHOT_FILE)
    assert ZERO_SHOT_FILE.stat().st_size < 2e6
    assert run_config.interface.max_links is None
    assert run_config.source.grammars, "it was trained on drawn robots alone"
    assert ZERO_SHOT in policies_for("reach")
    assert ZERO_SHOT not in policies_for("push")


def test_results_are_beside_controllers_that_do_not_learn(capsys):
    code = main(["zeroshot", "arm=ur5", "ee=stick", "--episodes", "2", "--json"])
    assert code == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["controller"] for row in rows] == [ZERO_SHOT, "jacobian", "ik", "random"]
    for row in rows:
        assert row["episodes"] == 2
        assert row["success"]["low"] <= row["success"]["value"] <= row["success"]["high"]


def test_the_shipped_policy_is_for_reach_alone(capsys):
    assert main(["play", "push", "prims", "--policy", ZERO_SHOT]) == 2
    assert "policy 'zero-shot' is for reach, not for push" in capsys.readouterr().err


@pytest.mark.slow
def test_the_shipped_policy_reaches_with_real_arms(capsys):
    code = main(["zeroshot", "arm=ur5", "ee=stick", "--episodes", "40", "--json"])
    assert code == 0
    policy, _, ik, random = json.loads(capsys.readouterr().out)
    assert policy["success"]["low"] > 0.5 > random["success"]["high"]
    assert ik["success"]["value"] == 1

"""PPO learns to reach with an arm of three joints, from nothing."""

import json
from dataclasses import replace

import pytest

import morphgen
from morphgen.cli import main
from morphgen.model.robot import TOOL


def arm_of_three_joints():
    """An arm3 with a fixed base and a fixed wrist."""
    made = morphgen.compose("arm3")
    moving = [k for k in made.joint_chain(made.frame(TOOL).link) if made.joints[k].is_movable]
    fixed = {made.joints[k].name for k in (moving[0], moving[-1])}
    names = [made.joints[k].name for k in made.independent_joints]
    joints = tuple(
        replace(joint, kind="fixed", limits=None) if joint.name in fixed else joint
        for joint in made.joints
    )
    home = tuple(q for q, name in zip(made.home, names, strict=True) if name not in fixed)
    assert len(moving) - len(fixed) == 3
    return replace(made, joints=joints, home=home)


@pytest.mark.slow
@pytest.mark.parametrize("agent", ["se", "me-graph"])
def test_an_arm_of_three_joints_learns_to_reach(agent, tmp_path, capsys):
    arm, run = str(tmp_path / "arm"), str(tmp_path / "run")
    morphgen.write(arm_of_three_joints(), arm)
    options = ("--agent", agent, "--preset", "fast", "--steps", "400000", "--out", run)
    assert main(["train", arm, "task=reach", *options, "--no-tensorboard"]) == 0
    capsys.readouterr()
    chosen = ("--mode", "deterministic", "--episodes", "100", "--json")
    assert main(["eval", run, *chosen]) == 0
    (row,) = json.loads(capsys.readouterr().out)["deterministic"]
    assert row["random_success"] < 0.1
    assert row["success"] >= 0.8

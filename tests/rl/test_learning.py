"""PPO learns to reach with an arm of three joints, from nothing."""

from contextlib import closing
from dataclasses import replace

import pytest

import morphgen
from morphgen.model.robot import TOOL
from morphgen.rl.baselines.simple import Random
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.inference import Policy, PolicyController
from morphgen.rl.learner_state import state_of
from morphgen.rl.ppo import Learner
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.make import make_batch


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


def successes(controller, robot):
    """Share of a hundred episodes that end within 3 cm of the goal."""
    kind = "continuous"
    with closing(
        make_batch("reach", [robot], 100, sim="mujoco", kind=kind, seed=99, max_links=10)
    ) as batch:
        return sum(each.success for each in run_episodes(batch, controller, 1)) / 100


@pytest.mark.slow
def test_an_arm_of_three_joints_learns_to_reach():
    robot = arm_of_three_joints()
    assert successes(Random(0), robot) < 0.1
    policy = PolicyConfig("se", discrete=False)
    config = PPOConfig(
        total_timesteps=4_000_000,
        num_steps=32,
        minibatches=8,
        gamma=0.95,
        learning_rate=5e-4,
        desired_kl=0.01,
    )
    with closing(
        make_batch("reach", [robot], 512, sim="mujoco", kind="continuous", max_links=10)
    ) as batch:
        learner = Learner(batch, policy, config, seed=0)
        while not learner.done:
            learner.iterate()
        learned = state_of(learner)
    assert successes(PolicyController(Policy(learned, "deterministic", 0)), robot) >= 0.8

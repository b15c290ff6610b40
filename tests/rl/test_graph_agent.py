"""The graph agent: its weights fit robots of any size, and joints are told apart by the tree."""

import pytest
import torch

import morphgen
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.inference import Policy
from morphgen.rl.ppo import Learner
from morphgen.rl.runs.training import state_of
from morphgen.tasks.observation import observation_config
from morphgen.tasks.scenes.make import make_batch

POLICY = PolicyConfig(
    "me-graph", discrete=False, observe=("lag", "joint", "jacobian"), normalize=True
)


@pytest.fixture(scope="module")
def batches(tmp_path_factory):
    """A batch of small arms, and one of a robot with more joints and links than any of them."""
    cache, observe = tmp_path_factory.mktemp("goals"), observation_config(POLICY.channels)
    hand = morphgen.compose("arm=iiwa14 ee=allegro", geometry="primitive")
    made = [
        make_batch("reach", robots, 4, sim="kinematic", observe=observe, cache=cache)
        for robots in (["arm3", "arm=ur5 ee=stick"], [hand])
    ]
    assert made[1].robot_tables.max_links > made[0].robot_tables.max_links
    return made


def test_a_policy_acts_on_a_larger_robot(batches):
    small, large = batches
    learner = Learner(small, POLICY, PPOConfig(total_timesteps=64, num_steps=8, minibatches=2))
    learner.iterate()
    policy = Policy(state_of(learner), "deterministic", 0)
    actions = policy.act(large.reset())
    assert actions.shape == (4, large.robot_tables.max_links)
    assert actions[large.action_mask].abs().min() > 0
    assert not actions[~large.action_mask].any()


def test_the_order_of_links_does_not_matter(batches):
    """Actions follow the joints when links, and their places in the tree, are listed otherwise."""
    batch = batches[0]
    learner = Learner(batch, POLICY, PPOConfig(total_timesteps=64, num_steps=8, minibatches=2))
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weights in learner.actor.parameters():
            weights += 0.1 * torch.randn(weights.shape, generator=random)
    observation = learner._network_input(batch.reset())
    count = int((observation["joints"][0] >= 0).sum())
    order = torch.arange(observation["joints"].shape[1])
    order[:count] = order[:count].flip(0)
    place = order.argsort()
    parents = observation["joint_parents"][:, order]
    turned = {
        **observation,
        "joints": observation["joints"][:, order],
        "joint_parents": torch.where(parents >= 0, place[parents.clamp(min=0)], parents),
        "joint_relations": observation["joint_relations"][:, order][:, :, order],
    }
    one, other = learner.actor(observation), learner.actor(turned)
    torch.testing.assert_close(one[0], other[0], rtol=1e-4, atol=1e-5)


def test_the_relations_of_joints_change_actions(batches):
    learner = Learner(batches[0], POLICY, PPOConfig(total_timesteps=64, num_steps=8, minibatches=2))
    observation = learner._network_input(batches[0].reset())
    with torch.no_grad():
        learner.actor.network.last.weight.normal_()
        learner.actor.network.relation.weight.normal_()
    unrelated = {**observation, "joint_relations": observation["joint_relations"] * 0}
    assert not learner.actor(observation).allclose(learner.actor(unrelated))

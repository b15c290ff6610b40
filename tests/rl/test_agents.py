"""An agent is one module and one row of the registry; the graph agent fits robots of any size."""

import math
import sys
from dataclasses import asdict, dataclass, replace
from types import ModuleType

import pytest
import torch

import morphgen
from helpers.runs import QUIET, small_config
from morphgen.errors import TaskError
from morphgen.rl.agents import (
    AGENTS,
    FAST,
    PAPER,
    PRESETS,
    Agent,
    NetworkConfig,
    encoder,
    graph,
    mlp,
    network_fields,
    preset_of,
    transformer,
)
from morphgen.rl.config import (
    NUMBERS,
    SWITCHES,
    PolicyConfig,
    PPOConfig,
    configs_of,
    parse_agent,
    parse_agents,
    parse_constants,
)
from morphgen.rl.inference import Policy, load_policy
from morphgen.rl.ppo import Learner, normalized_advantages
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.training import state_of, train
from morphgen.rl.shipped_policies import POLICIES
from morphgen.tasks.observation import observation_config
from morphgen.tasks.scenes.make import make_batch


@dataclass(frozen=True)
class Config(NetworkConfig):
    width: int = 4


class Network(encoder.Network):
    """One linear layer over the joint positions of all links."""

    def __init__(self, config, layout, outputs, per_link):
        super().__init__(config, layout, outputs, per_link)
        self.shape = (layout.links, outputs) if per_link else (outputs,)
        self.enter = torch.nn.Linear(layout.links * layout.token, config.network.width)
        rows = layout.links if per_link else 1
        self.leave = encoder.last_layer(config.network.width, rows * outputs)

    def forward(self, observation):
        tokens = torch.where(observation["links"][..., None], observation["tokens"], 0.0)
        return self.leave(self.enter(tokens.flatten(1)).tanh()).reshape(-1, *self.shape)


@pytest.fixture
def linear(monkeypatch):
    module = ModuleType("linear_agent")
    module.Config, module.Network = Config, Network
    monkeypatch.setitem(sys.modules, "linear_agent", module)
    monkeypatch.setattr(AGENTS, "_loaded", dict(AGENTS._loaded))
    AGENTS.register(Agent("linear", "linear_agent"))


def test_an_agent_of_another_module_trains_and_acts(linear, tmp_path):
    config = replace(small_config(), policy=PolicyConfig("linear", network=Config(width=3)))
    train(tmp_path, config, execution=QUIET)
    stored, learner = read_checkpoint(tmp_path)
    assert stored == config
    assert learner["actor"]["network.enter.weight"].shape[0] == 3
    assert str(parse_agent("linear-symlog")) == "linear-symlog"
    assert [label for label, _, _ in parse_agents("linear,me-tf")] == ["linear", "me-tf"]
    assert parse_constants(["width=7"]) == {"width": 7}


def test_sizes_of_another_agent_are_refused(linear):
    with pytest.raises(TaskError, match="network Config of agent 'me-tf': expected"):
        PolicyConfig("me-tf", network=Config())


def test_a_policy_acts_on_an_observation_alone(tmp_path):
    from contextlib import closing

    from morphgen.tasks.scenes.make import make_batch

    train(tmp_path, small_config(total_timesteps=32), execution=QUIET)
    policy = load_policy(tmp_path)
    with closing(
        make_batch("reach", ["planar-cube"], 3, sim="mujoco", **policy.batch_options)
    ) as batch:
        observation = batch.reset()
        actions = policy.act(observation)
        assert actions.shape == observation["links"].shape
        assert actions.equal(load_policy(tmp_path).act(observation))
        one = policy.act({name: value[1:2] for name, value in observation.items()})
        assert one.equal(actions[1:2])
        batch.step(actions)
    with pytest.raises(TaskError, match="the checkpoint is for other observations"):
        policy.act({**observation, "tokens": observation["tokens"][:, :3]})


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_a_shipped_policy_is_loaded_by_its_name(name):
    from contextlib import closing

    from morphgen.tasks.scenes.make import make_batch

    policy = load_policy(name)
    (task,) = POLICIES[name].tasks
    with closing(
        make_batch(task, ["arm=ur5 ee=stick"], 2, sim="mujoco", **policy.batch_options)
    ) as batch:
        observation = batch.reset()
        assert policy.act(observation).shape == observation["links"].shape
    with pytest.raises(TaskError, match="no such checkpoint"):
        load_policy("zero-shott")
    for mode in ("Deterministic", "greedy", None):
        with pytest.raises(TaskError, match=f"unknown mode {mode!r}.* valid: deterministic, stoch"):
            load_policy("zero-shot", mode)
    with pytest.raises(TaskError, match="unknown device 'gpu'; valid: cpu, cuda"):
        load_policy("zero-shot", device="gpu")


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
        learner.actor.network.head[-1].weight.normal_()
        learner.actor.network.relation.weight.normal_()
    unrelated = {**observation, "joint_relations": observation["joint_relations"] * 0}
    assert not learner.actor(observation).allclose(learner.actor(unrelated))


def test_transitions_are_rounded_up_to_whole_updates():
    assert PPOConfig(total_timesteps=1025, num_steps=128).num_updates(4) == 3
    assert PPOConfig(total_timesteps=1024, num_steps=128).num_updates(4) == 2


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PolicyConfig(agent="me-tff"), "unknown agent 'me-tff'; did you mean 'me-tf'"),
        (lambda: transformer.Config(features=30), "features 30: expected a multiple of heads 4"),
        (lambda: graph.Config(graph_features=30), "graph_features 30: expected a multiple"),
        (lambda: mlp.Config(mlp_width=0), "mlp_width 0: expected 1 to 8192"),
        (lambda: transformer.Config(logit_scale=0.0), "logit_scale 0: expected more than 0"),
        (lambda: PPOConfig(num_steps=0), "num_steps 0: expected 1 to 16384"),
        (lambda: PPOConfig(num_steps=10**9), "num_steps 1000000000: expected 1 to 16384"),
        (lambda: PPOConfig(clip_coef=0.0), "clip_coef 0: expected more than 0"),
        (lambda: PPOConfig(learning_rate=math.nan), "learning_rate nan: expected more than 0"),
        (lambda: PPOConfig(gamma=1.5), "gamma 1.5: expected 0 to 1"),
        (lambda: PPOConfig(ent_coef=-1.0), "ent_coef -1: expected 0 or more"),
        (
            lambda: PPOConfig(num_steps=10).minibatch_size(3),
            "10 steps of 3 .* 16 equal minibatches",
        ),
    ],
)
def test_invalid_configurations_are_rejected(make, words):
    with pytest.raises(TaskError, match=words):
        make()


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_name_switches_and_constants_that_exist(name):
    preset = PRESETS[name]
    assert set(preset.switches) <= set(SWITCHES)
    assert set(preset.constants) <= {*NUMBERS, *(field for field, _, _ in network_fields())}


def test_each_agent_has_a_preset():
    assert preset_of(None, "me-graph") is FAST
    for agent in ("se", "me-mlp", "me-tf"):
        assert preset_of(None, agent) is PAPER
    assert preset_of("fast", "me-mlp") is FAST
    with pytest.raises(TaskError, match="unknown preset 'quick'"):
        preset_of("quick", "me-graph")


def test_the_preset_of_the_paper_changes_nothing():
    _, ppo = configs_of(parse_agent("me-tf"), ["reach"], PAPER.constants, 1000)
    assert asdict(ppo) == asdict(PPOConfig(total_timesteps=1000))
    assert not PAPER.switches


def test_advantages_are_normalized_robot_by_robot():
    import torch

    random = torch.Generator().manual_seed(0)
    scale, robots = torch.tensor([1.0, 100.0, 1.0, 100.0]), torch.tensor([0, 1, 0, 1])
    advantages = scale * torch.randn(50, 4, generator=random) + 3
    normalized = normalized_advantages(advantages, robots.expand(50, 4))
    for robot in (0, 1):
        own = normalized[:, robots == robot]
        torch.testing.assert_close(own.mean(), torch.tensor(0.0), atol=1e-5, rtol=0)
        torch.testing.assert_close(own.std(), torch.tensor(1.0), atol=1e-4, rtol=0)
    together = normalized_advantages(advantages)
    assert together[:, 0].std() < 0.1 < normalized[:, 0].std()

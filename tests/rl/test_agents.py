"""An agent is one module and one row of the registry; nothing else has to know of it."""

import sys
from dataclasses import dataclass, replace
from types import ModuleType

import pytest
import torch

from helpers.runs import QUIET, small_config
from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS, Agent, NetworkConfig, encoder
from morphgen.rl.config import PolicyConfig
from morphgen.rl.inference import load_policy
from morphgen.rl.runs.agent_spec import parse_agent, parse_agents, parse_constants
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.training import train
from morphgen.rl.shipped_policies import POLICIES


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

    @property
    def last(self):
        return self.leave

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

"""Observation fields of tasks of other packages are inputs of the networks, or an error."""

import pytest
import torch

from helpers.line_batch import OnALine
from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.inference import Policy
from morphgen.rl.observation_layout import layout_of
from morphgen.rl.ppo import Learner
from morphgen.rl.runs.checkpoint import require_learner
from morphgen.rl.runs.training import state_of
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.task import Reach
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import GOAL, ObservationField

WIND = ObservationField("wind", 3, GOAL.mask)


class WindyLine(OnALine):
    """The point on a line, with a field that only a task of another package has."""

    def observe(self):
        wind = torch.ones(self.num_envs, 3) * self.episode_step[:, None]
        return {**super().observe(), "wind": wind}


class WindyConfig(ReachConfig):
    task = "windy"


class WindyTask(Reach):
    name, config_type, fields = "windy", WindyConfig, (GOAL, WIND)


@pytest.fixture
def windy(monkeypatch):
    monkeypatch.setattr(TASKS, "_loaded", dict(TASKS._loaded))
    for wrong in (WindyTask, "windy", None):
        with pytest.raises(TaskError, match="expected an instance with a name"):
            TASKS.register(wrong)
    TASKS.register(WindyTask())


CONFIG = PPOConfig(total_timesteps=64, num_steps=8, epochs=1, minibatches=2)


@pytest.mark.parametrize("agent", list(AGENTS))
def test_a_declared_field_reaches_the_networks_and_the_checkpoint(windy, agent):
    learner = Learner(WindyLine(8, tree=agent == "me-graph"), PolicyConfig(agent), CONFIG)
    assert (
        learner.layout.fields == learner.layout.as_data()["fields"] == (("wind", 3, "goal_mask"),)
    )
    assert "fields" not in layout_of(OnALine(2).observe()).as_data()
    learner.iterate()
    state = state_of(learner)
    require_learner(state, "checkpoint")
    policy, observation = Policy(state, "stochastic", 0), learner.batch.observe()
    assert policy.layout == learner.layout

    calm = learner.critic(observation)
    observation["wind"] = observation["wind"] + 5.0
    windy_values = learner.critic(observation)
    reach = observation["goal_mask"]
    assert (calm != windy_values)[reach].all()
    assert (calm == windy_values)[~reach].all(), "environments of other tasks do not have it"
    policy.act(observation)
    del observation["wind"]
    with pytest.raises(TaskError, match="is for other observations: fields"):
        policy.act(observation)


def test_training_rejects_an_undeclared_field():
    with pytest.raises(TaskError, match=r"observation entry 'wind'.*declare an ObservationField"):
        Learner(WindyLine(8), PolicyConfig("me-mlp"), CONFIG)


def test_a_field_of_another_size_is_rejected(windy):
    observation = WindyLine(2).observe()
    observation["wind"] = observation["wind"][:, :2]
    with pytest.raises(TaskError, match=r"'wind' has shape \(2, 2\); expected \(n, 3\)"):
        layout_of(observation)

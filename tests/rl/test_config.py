"""Configs and presets: derived values, and rejected ones."""

import math
from dataclasses import asdict

import pytest

from morphgen.errors import TaskError
from morphgen.rl.agents import (
    FAST,
    PAPER,
    PRESETS,
    graph,
    mlp,
    network_fields,
    preset_of,
    transformer,
)
from morphgen.rl.config import NUMBERS, SWITCHES, PolicyConfig, PPOConfig, configs_of, parse_agent
from morphgen.rl.ppo import normalized_advantages


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

"""Presets begin a training; options change them; agents of the paper keep its constants."""

from dataclasses import asdict

import pytest

from morphgen.errors import TaskError
from morphgen.rl.agents import FAST, PAPER, PRESETS, network_fields, preset_of
from morphgen.rl.config import NUMBERS, PPOConfig
from morphgen.rl.ppo import normalized_advantages
from morphgen.rl.runs.agent_spec import SWITCHES, configs_of, parse_agent


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

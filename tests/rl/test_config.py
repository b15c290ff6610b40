"""Configs: derived values, and rejected ones."""

import math

import pytest

from morphgen.errors import TaskError
from morphgen.rl.agents import graph, mlp, transformer
from morphgen.rl.config import PolicyConfig, PPOConfig


def test_transitions_are_rounded_up_to_whole_updates():
    assert PPOConfig(total_timesteps=1025, num_steps=128).num_updates(4) == 3
    assert PPOConfig(total_timesteps=1024, num_steps=128).num_updates(4) == 2


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PolicyConfig(agent="me-tff"), "unknown agent 'me-tff'; did you mean 'me-tf'"),
        (lambda: transformer.Config(features=30), "features 30: expected a multiple of heads 4"),
        (lambda: graph.Config(graph_features=30), "graph_features 30: expected a multiple"),
        (lambda: mlp.Config(mlp_width=0), "mlp_width 0: expected 1 or more"),
        (lambda: transformer.Config(logit_scale=0.0), "logit_scale 0: expected more than 0"),
        (lambda: PPOConfig(num_steps=0), "num_steps 0: expected 1 or more"),
        (lambda: PPOConfig(num_steps=10**9), "num_steps 1000000000: expected at most 16384"),
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

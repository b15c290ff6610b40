"""Constants that cannot be are refused, and what follows from the others."""

import math

import pytest

from morphgen.errors import TaskError
from morphgen.rl.config import PolicyConfig, PPOConfig


def test_transitions_are_rounded_up_to_whole_updates():
    assert PPOConfig(transitions=1025, steps=128).updates(4) == 3
    assert PPOConfig(transitions=1024, steps=128).updates(4) == 2


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PolicyConfig(agent="me-tff"), "agent 'me-tff'; did you mean 'me-tf'"),
        (lambda: PolicyConfig(features=30), "features 30: expected a multiple of heads 4"),
        (lambda: PolicyConfig(mlp_width=0), "mlp_width 0: expected 1 or more"),
        (lambda: PolicyConfig(logit_scale=0.0), "logit_scale 0: expected more than 0"),
        (lambda: PPOConfig(steps=0), "steps 0: expected 1 or more"),
        (lambda: PPOConfig(steps=10**9), "steps 1000000000: expected at most 16384"),
        (lambda: PPOConfig(clip=0.0), "clip 0: expected more than 0"),
        (lambda: PPOConfig(learning_rate=math.nan), "learning_rate nan: expected more than 0"),
        (lambda: PPOConfig(gamma=1.5), "gamma 1.5: expected 0 to 1"),
        (lambda: PPOConfig(entropy=-1.0), "entropy -1: expected 0 or more"),
        (lambda: PPOConfig(steps=10).minibatch(3), "10 steps of 3 .* 16 equal minibatches"),
    ],
)
def test_impossible_configurations_are_refused(make, words):
    with pytest.raises(TaskError, match=words):
        make()

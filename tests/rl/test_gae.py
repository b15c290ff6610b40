"""Generalised advantage estimation against values computed by hand."""

import pytest
import torch

from morphgen.rl.ppo import gae


def column(*numbers):
    return torch.tensor(numbers)[:, None]


NEVER, MIDDLE = (False, False, False), (False, True, False)


@pytest.mark.parametrize(
    ("terminated", "truncated", "ahead", "wanted"),
    [
        # delta: 1 + 18 - 10 = 9; 2 + 27 - 20 = 9; 3 + 36 - 30 = 9. Each passes on 0.45 of the next.
        (NEVER, NEVER, 30.0, [9 + 0.45 * (9 + 0.45 * 9), 9 + 0.45 * 9, 9.0]),
        # The middle delta loses its 27, and nothing of the last step passes on to it.
        (MIDDLE, NEVER, 30.0, [9 + 0.45 * (2 - 20), 2.0 - 20, 9.0]),
        # 50 is the value of the episode's last observation: 2 + 45 - 20 = 27.
        (NEVER, MIDDLE, 50.0, [9 + 0.45 * 27, 27.0, 9.0]),
        (MIDDLE, MIDDLE, 50.0, [9 + 0.45 * (2 - 20), 2.0 - 20, 9.0]),
    ],
    ids=["unfinished", "terminated", "truncated", "both"],
)
def test_advantages_by_hand(terminated, truncated, ahead, wanted):
    rewards, values = column(1.0, 2.0, 3.0), column(10.0, 20.0, 30.0)
    ends = column(*terminated), column(*truncated)
    found = gae(rewards, values, column(20.0, ahead, 40.0), *ends, gamma=0.9, gae_lambda=0.5)
    torch.testing.assert_close(found[:, 0], torch.tensor(wanted))


def test_environments_are_independent():
    rewards = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    values, ahead = rewards.flip(0), rewards.roll(1, 0)
    over = torch.zeros(5, 3, dtype=torch.bool)
    over[2, 1] = True
    inputs = (rewards, values, ahead, over, torch.zeros_like(over))
    whole = gae(*inputs, gamma=0.9, gae_lambda=0.5)
    for i in range(3):
        one = gae(*(each[:, i : i + 1] for each in inputs), gamma=0.9, gae_lambda=0.5)
        torch.testing.assert_close(whole[:, i : i + 1], one)

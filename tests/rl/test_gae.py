"""Generalised advantage estimation against values computed by hand."""

import torch

from morphgen.rl.ppo import gae

GAMMA, LAM = 0.9, 0.5


def column(*numbers):
    return torch.tensor(numbers)[:, None]


def advantages(terminated, truncated, ahead=(20.0, 30.0, 40.0)):
    found = gae(
        column(1.0, 2.0, 3.0),
        column(10.0, 20.0, 30.0),
        column(*ahead),
        column(*terminated),
        column(*truncated),
        gamma=GAMMA,
        gae_lambda=LAM,
    )
    return found[:, 0]


NEVER = (False, False, False)
MIDDLE = (False, True, False)


def test_advantages_of_an_unfinished_episode():
    # delta: 1 + 18 - 10 = 9; 2 + 27 - 20 = 9; 3 + 36 - 30 = 9. Each passes on 0.45 of the next.
    wanted = torch.tensor([9 + 0.45 * (9 + 0.45 * 9), 9 + 0.45 * 9, 9.0])
    torch.testing.assert_close(advantages(NEVER, NEVER), wanted)


def test_the_value_after_a_termination_is_zero():
    # The middle delta loses its 27, and nothing of the last step passes on to it.
    wanted = torch.tensor([9 + 0.45 * (2 - 20), 2.0 - 20, 9.0])
    torch.testing.assert_close(advantages(MIDDLE, NEVER), wanted)


def test_a_truncation_bootstraps_from_the_final_observation():
    # 50 is the value of the episode's last observation: 2 + 45 - 20 = 27.
    wanted = torch.tensor([9 + 0.45 * 27, 27.0, 9.0])
    torch.testing.assert_close(advantages(NEVER, MIDDLE, (20.0, 50.0, 40.0)), wanted)


def test_termination_takes_precedence_over_truncation():
    both = advantages(MIDDLE, MIDDLE, (20.0, 50.0, 40.0))
    torch.testing.assert_close(both, advantages(MIDDLE, NEVER))


def test_environments_are_independent():
    rewards = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    values, ahead = rewards.flip(0), rewards.roll(1, 0)
    over = torch.zeros(5, 3, dtype=torch.bool)
    over[2, 1] = True
    none = torch.zeros_like(over)
    whole = gae(rewards, values, ahead, over, none, gamma=GAMMA, gae_lambda=LAM)
    for i in range(3):
        one = (each[:, i : i + 1] for each in (rewards, values, ahead, over, none))
        torch.testing.assert_close(whole[:, i : i + 1], gae(*one, gamma=GAMMA, gae_lambda=LAM))


def test_with_lambda_1_returns_are_discounted_sums():
    rewards = torch.tensor([[1.0], [2.0], [4.0]])
    values = torch.tensor([[5.0], [6.0], [7.0]])
    ahead = torch.tensor([[6.0], [7.0], [8.0]])
    none = torch.zeros(3, 1, dtype=torch.bool)
    found = values + gae(rewards, values, ahead, none, none, gamma=GAMMA, gae_lambda=1.0)
    assert torch.allclose(found[0, 0], torch.tensor(1 + 0.9 * 2 + 0.81 * 4 + 0.729 * 8))

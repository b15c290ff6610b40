"""Heads and attention: masked links and tokens have no influence."""

import math

import pytest
import torch
from torch.distributions import Categorical, Independent, Normal

from morphgen.rl.agents import transformer
from morphgen.rl.observation_layout import (
    INITIAL_LOG_STD,
    MAX_LOG_STD,
    MIN_LOG_STD,
    REST,
    MaskedGaussian,
    MaskedMultiDiscrete,
    bounded_log_std,
)
from morphgen.tasks.actions import BINS

MASK = torch.tensor([[False, True, True, False], [True, False, True, True], [False] * 4])


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def gaussian(mask=MASK):
    mean = torch.randn(3, 4, generator=seeded())
    return MaskedGaussian(mean, torch.tensor([-1.0, -0.5, 0.0, 0.3]), mask)


def discrete(mask=MASK):
    return MaskedMultiDiscrete(2 * torch.randn(3, 4, len(BINS), generator=seeded()), mask)


def torch_gaussian(head, row, mask):
    return Normal(head.mean[row, mask], head.log_std[mask].exp())


def torch_discrete(head, row, mask):
    return Categorical(logits=head.logits[row, mask])


@pytest.mark.parametrize(
    ("head", "theirs", "rest"),
    [(gaussian(), torch_gaussian, 0.0), (discrete(), torch_discrete, REST)],
    ids=["gaussian", "discrete"],
)
def test_heads_match_torch_over_the_movable_links(head, theirs, rest):
    actions = head.sample(seeded(1))
    assert actions.equal(head.sample(seeded(1)))
    assert not actions.equal(head.sample(seeded(2)))
    for row, mask in enumerate(MASK[:2]):
        other = Independent(theirs(head, row, mask), 1)
        assert head.log_prob(actions)[row] == pytest.approx(other.log_prob(actions[row, mask]))
        assert head.entropy()[row] == pytest.approx(other.entropy())
    assert (head.log_prob(actions)[2], head.entropy()[2]) == (0, 0)  # nothing moves
    assert BINS[REST] == 0
    for own in (actions, head.mode()):
        assert set(own[~MASK].tolist()) == {rest}


def test_gaussian_samples_have_its_mean_and_std():
    mask = torch.ones(40_000, 2, dtype=torch.bool)
    mean = torch.tensor([0.2, -0.4])
    head = MaskedGaussian(mean.expand(40_000, 2), torch.tensor([-1.0, 0]), mask)
    drawn = head.sample(seeded())
    torch.testing.assert_close(drawn.mean(dim=0), mean, atol=0.02, rtol=0)
    wanted = torch.tensor([math.exp(-1), 1.0])
    torch.testing.assert_close(drawn.std(dim=0), wanted, atol=0.02, rtol=0)


def test_multi_discrete_samples_have_its_probabilities():
    logits = torch.linspace(-2, 1, len(BINS))
    mask = torch.ones(60_000, 1, dtype=torch.bool)
    drawn = MaskedMultiDiscrete(logits.expand(60_000, 1, len(BINS)), mask).sample(seeded())
    shares = torch.bincount(drawn[:, 0], minlength=len(BINS)) / len(drawn)
    torch.testing.assert_close(shares, logits.softmax(dim=0), atol=0.01, rtol=0)


def test_the_mode_is_the_mean_or_the_bin_nearest_to_it():
    head = gaussian()
    assert head.mode()[MASK].equal(head.mean[MASK])
    shares = {-1 / 16: 0.4, 1 / 2: 0.3, 1 / 4: 0.3}  # mean 0.2, where 1/4 is nearest
    probabilities = torch.tensor([shares.get(each, 1e-9) for each in BINS])
    bins = MaskedMultiDiscrete(probabilities.log().expand(*MASK.shape, len(BINS)), MASK)
    assert set(bins.mode()[MASK].tolist()) == {BINS.index(1 / 4)}


def test_log_std_starts_at_its_initial_value_and_stays_in_bounds():
    raw = torch.zeros(1, requires_grad=True)
    found = bounded_log_std(raw)
    assert found.item() == pytest.approx(INITIAL_LOG_STD, abs=1e-6)
    found.backward()
    assert raw.grad.item() > 0.1
    far = bounded_log_std(torch.tensor([-20.0, 20.0]))
    torch.testing.assert_close(far, torch.tensor([MIN_LOG_STD, MAX_LOG_STD]), atol=1e-4, rtol=0)


N, HEADS, T, FEATURES = 5, 2, 7, 8
WAYS = {"as here": transformer.attend, "as on a GPU": transformer.attend_to_few}


def some(seed=0):
    """Return queries, keys, values, and a mask with at least one token per row."""
    generator = torch.Generator().manual_seed(seed)
    q, k, v = torch.randn(3, N, HEADS, T, FEATURES, generator=generator)
    mask = torch.rand(N, T, generator=generator) < 0.5
    mask[:, 0] = True
    return q, k, v, mask


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_attention_is_a_weighted_mean_of_the_unmasked_values(way):
    q, k, v, mask = some()
    found = way(q, k, v, mask)
    for row in range(N):
        there = torch.nonzero(mask[row])[:, 0].tolist()
        for head in range(HEADS):
            for token in range(T):
                scores = [float(q[row, head, token] @ k[row, head, i]) for i in there]
                weights = [math.exp(score / math.sqrt(FEATURES)) for score in scores]
                wanted = torch.tensor(weights) / sum(weights) @ v[row, head, there]
                torch.testing.assert_close(found[row, head, token], wanted, rtol=1e-4, atol=1e-5)

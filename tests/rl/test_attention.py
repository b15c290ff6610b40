"""Attention equals PyTorch's, and masked tokens have no influence."""

import math

import pytest
import torch

from morphgen.rl.agents import transformer

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


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_masked_entries_change_nothing_and_get_no_gradient(way):
    q, k, v, mask = some()
    hidden = ~mask[:, None, :, None]
    before = way(q, k, v, mask)
    k, v = (torch.where(hidden, 1e6, each).requires_grad_() for each in (k, v))
    after = way(q, k, v, mask)
    torch.testing.assert_close(after, before)
    after.square().sum().backward()
    for each in (k, v):
        assert torch.where(hidden, each.grad, 0.0).abs().max() == 0
        assert each.grad.abs().max() > 0


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_bfloat16_input_gives_bfloat16_output(way):
    q, k, v, mask = some()
    exact = way(q, k, v, mask)
    rough = way(*(each.bfloat16() for each in (q, k, v)), mask)
    assert rough.dtype == torch.bfloat16
    torch.testing.assert_close(rough.float(), exact, rtol=0.05, atol=0.05)

"""Padding of links, obstacles and points changes no actions, values or gradients."""

import math

import pytest
import torch

from helpers.observations import (
    COUNT,
    LINKS,
    MASKS,
    N,
    agents,
    filled,
    kinds,
    mask_of,
    networks,
    observed,
    outputs,
)
from morphgen.rl.config import PolicyConfig
from morphgen.rl.observation_layout import pad_links, truncate_links
from morphgen.rl.policies import entries_unneeded, rows_needed


@agents
@kinds
@pytest.mark.parametrize("garbage", [-7.5, 1e30, -3e38, math.inf, math.nan])
def test_invalid_numbers_in_the_padding_change_nothing(agent, discrete, garbage):
    seen = observed()
    pair = networks(agent, seen, discrete=discrete)
    clean, dirty = outputs(*pair, filled(seen, 0.0)), outputs(*pair, filled(seen, garbage))
    for one, other in zip(clean, dirty, strict=True):
        assert one.isfinite().all()
        assert one.equal(other)


@agents
@kinds
def test_invalid_numbers_in_the_padding_change_no_gradient(agent, discrete):
    seen = observed()

    def gradients(fill):
        actor, critic = networks(agent, seen, discrete=discrete)
        _, log_prob, value = outputs(actor, critic, filled(seen, fill))
        (log_prob.sum() + value.square().sum()).backward()
        return [each.grad for each in (*actor.parameters(), *critic.parameters())]

    for clean, dirty in zip(gradients(0.0), gradients(math.nan), strict=True):
        assert clean.isfinite().all()
        assert clean.equal(dirty)


@agents
@kinds
def test_gradients_are_zero_in_the_padding_and_only_there(agent, discrete):
    seen = observed()
    for name in MASKS:
        seen[name].requires_grad_()
    _, log_prob, value = outputs(*networks(agent, seen, discrete=discrete), seen)
    (log_prob + value).sum().backward()
    read = seen["actions"] if agent == "me-graph" else seen["links"]
    for name in MASKS:
        assert not seen[name].grad[~mask_of(seen, name)].any(), name
        if MASKS[name] == "links" and name != "tokens":
            assert seen[name].grad[read].all(), name
        elif name not in ("tokens", "points"):
            assert seen[name].grad[mask_of(seen, name)].all(), name
    of_links = seen["tokens"].grad.abs().sum(dim=-1)
    assert of_links[read].all()
    assert seen["points"].grad[0].any()


def test_the_amount_of_padding_does_not_change_the_transformer():
    seen = observed()
    pair = networks("me-tf", seen)
    more = torch.full((N, 5, 13), 9.0)
    wider = {
        **seen,
        "obstacles": torch.cat([seen["obstacles"], more], dim=1),
        "obstacle_mask": torch.cat([seen["obstacle_mask"], more[..., 0] < 0], dim=1),
    }
    for one, other in zip(outputs(*pair, seen), outputs(*pair, wider), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


@kinds
def test_the_transformer_acts_and_learns_the_same_without_unused_rows(discrete):
    seen = {name: each[1:] for name, each in observed().items()}
    rows = rows_needed(PolicyConfig("me-tf"), seen)
    assert rows == COUNT[1:].max() == LINKS - 2
    assert rows_needed(PolicyConfig("me-mlp"), seen) == LINKS  # an MLP takes all of its layout
    found = []
    for needed in (seen, truncate_links(seen, rows)):
        actor, critic = networks("me-tf", seen, discrete=discrete)
        head = actor.distribution(needed)
        actions = pad_links(head.mode(), LINKS)
        probable = head.log_prob(actions[:, : needed["links"].shape[1]])
        value = critic(needed)
        (probable + head.entropy() + value).sum().backward()
        gradients = [each.grad for each in (*actor.parameters(), *critic.parameters())]
        found.append([actions, probable, head.entropy(), value, *gradients])
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)


@kinds
@pytest.mark.parametrize("agent", ["me-tf", "me-graph"])
def test_entries_that_no_task_fills_are_left_out_and_change_nothing(agent, discrete):
    seen = {**observed(), "object_mask": torch.zeros(N, dtype=torch.bool)}
    unneeded = entries_unneeded(PolicyConfig(agent), {"reach"})
    assert unneeded == {"object", "object_mask", "line"}
    assert entries_unneeded(PolicyConfig(agent), {"push"}) == {"goal", "goal_mask"}
    for policy, tasks in ((agent, {"push", "reach"}), ("me-mlp", {"reach"})):
        assert not entries_unneeded(PolicyConfig(policy), tasks)
    less = {name: value for name, value in seen.items() if name not in unneeded}
    found = []
    for needed in (seen, less):
        actor, critic = networks(agent, seen, discrete=discrete)
        _, log_prob, value = outputs(actor, critic, needed)
        (log_prob + value).sum().backward()
        weights = (*actor.parameters(), *critic.parameters())
        found.append(
            [log_prob, value, *(w.grad for w in weights if w.grad is not None and w.grad.any())]
        )
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-4, atol=1e-5)

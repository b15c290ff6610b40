"""Networks of the agents: sizes, masks, padding, order of entities, precision and weights."""

import math

import pytest
import torch

from helpers.line_batch import OnALine
from helpers.observations import (
    COUNT,
    LINKS,
    OBSTACLES,
    N,
    agents,
    filled,
    kinds,
    mask_of,
    networks,
    observed,
    outputs,
)
from morphgen.encoding.tokens import POSITION
from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS, transformer
from morphgen.rl.agents.encoder import Entities
from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.inference import Policy
from morphgen.rl.observation_layout import layout_of, pad_links, require_layout, truncate_links
from morphgen.rl.policies import entries_unneeded, make_networks, rows_needed
from morphgen.rl.ppo import Learner
from morphgen.rl.runs.checkpoint import require_learner
from morphgen.rl.runs.training import state_of
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.task import Reach
from morphgen.tasks.registry import TASKS
from morphgen.tasks.task import GOAL, ObservationField


@agents
def test_the_order_of_obstacles_and_points_changes_nothing(agent):
    seen = observed()
    pair = networks(agent, seen)
    order = torch.tensor([2, 0, 1])
    other = {k: v.flip(1) if k.startswith("point") else v for k, v in seen.items()}
    if agent == "me-tf":  # the others have a row for each obstacle
        other |= {k: v[:, order] for k, v in seen.items() if k.startswith("obstacle")}
    for one, two in zip(outputs(*pair, seen), outputs(*pair, other), strict=True):
        torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-5)


@agents
def test_outputs_of_immovable_links_are_zero(agent):
    seen = observed()
    actor, _ = networks(agent, seen)
    numbers = actor(seen)
    assert not numbers[~seen["actions"]].any()
    assert numbers[seen["actions"]].all()


@pytest.mark.parametrize("agent", ["me-mlp", "me-tf"])
def test_proprioceptive_only_hides_the_morphology(agent):
    seen, other = observed(), observed(1)
    positions, bodies = seen["tokens"].clone(), other["tokens"].clone()
    positions[..., POSITION.columns] = other["tokens"][..., POSITION.columns]
    bodies[..., POSITION.columns] = seen["tokens"][..., POSITION.columns]
    for masked in (True, False):
        _, critic = networks(agent, seen, proprioceptive_only=masked)
        assert critic(seen).equal(critic({**seen, "tokens": bodies})) == masked
        assert not critic(seen).isclose(critic({**seen, "tokens": positions})).any()
        if agent == "me-mlp":  # se is this agent without the morphology
            assert critic(seen).equal(networks("se", seen)[1](seen)) == masked


@agents
@pytest.mark.parametrize(
    "name", ["tokens", "goal", "object", "line", "tool", "obstacles", "points"]
)
def test_every_observation_entry_changes_the_outputs(agent, name):
    seen = observed()
    actor, critic = networks(agent, seen)
    other = {**seen, name: observed(1)[name]}
    moved = (critic(seen) != critic(other)) & (actor(seen) != actor(other)).any(dim=2).any(dim=1)
    there = mask_of(seen, name).reshape(N, -1).any(dim=1)
    assert moved.equal(there)


@kinds
def test_logit_scale_keeps_initial_logits_and_enlarges_their_changes(discrete):
    seen, layout = observed(), layout_of(observed())
    (plain, critic), (larger, other) = (
        make_networks(
            PolicyConfig(
                "me-tf", discrete, tool_position=True, network=transformer.Config(logit_scale=scale)
            ),
            layout,
            0,
        )
        for scale in (1.0, 16.0)
    )
    before = larger(seen)
    torch.testing.assert_close(before, plain(seen))
    assert other(seen).equal(critic(seen))
    with torch.no_grad():
        larger.network.decode[-1].bias.add_(0.1)
    moved = torch.where(seen["actions"][..., None], 1.6 if discrete else 0.1, 0.0)
    torch.testing.assert_close(larger(seen) - before, moved.expand_as(before))


@agents
def test_initial_actions_are_equally_likely_and_values_near_zero(agent):
    seen = observed()
    actor, critic = networks(agent, seen, lively=False)
    spread = actor(seen).softmax(dim=-1)[seen["actions"]]
    assert (spread - 1 / 11).abs().max() < 0.01
    assert critic(seen).abs().max() < 0.1
    calm, _ = networks(agent, seen, discrete=False, lively=False)
    assert calm.distribution(seen).mode().abs().max() < 0.1


def test_the_seed_determines_the_weights_and_torchs_generator_is_unchanged():
    config, layout = PolicyConfig(tool_position=True), layout_of(observed())
    before = torch.random.get_rng_state()
    first, again, other = (make_networks(config, layout, seed)[0] for seed in (3, 3, 4))
    assert torch.random.get_rng_state().equal(before)
    pairs = [first.state_dict(), again.state_dict(), other.state_dict()]
    assert all(pairs[0][name].equal(pairs[1][name]) for name in pairs[0])
    assert not pairs[0]["network.index"].equal(pairs[2]["network.index"])


@agents
def test_bfloat16_outputs_are_close_and_masked(agent):
    seen = observed()
    actor, critic = networks(agent, seen)
    with torch.autocast("cpu", torch.bfloat16):
        numbers, value = actor(seen), critic(seen)
        dirty = filled(seen, math.nan)
        assert numbers.equal(actor(dirty))
        assert value.equal(critic(dirty))
    assert numbers.dtype == value.dtype == torch.float32
    exact = actor(seen)
    assert (numbers - exact).abs().max() < 0.05 * exact.abs().max()
    assert 0 < (value - critic(seen)).abs().max() < 0.05 * critic(seen).abs().max()


def test_weights_for_other_observations_are_rejected_with_the_difference():
    here = layout_of(observed())
    fewer = {**observed(extras=False), "obstacles": torch.zeros(N, 0, 13)}
    words = (
        r"a\.pt is for other .*: obstacles 0, here 3; points 0, here 8; channels \(\), here .*; "
        "tool False, here True"
    )
    with pytest.raises(TaskError, match=words):
        require_layout(layout_of(fewer), here, "a.pt")
    require_layout(here, layout_of(observed(5)), "a.pt")


@pytest.mark.parametrize("shown", [True, False])
def test_tool_position_must_match_the_environments(shown):
    layout = layout_of(observed(extras=shown))
    assert layout.tool == shown
    make_networks(PolicyConfig(tool_position=shown), layout, 0)
    words = "tool_position True: .* do not show it" if not shown else "False: .*ments show it"
    with pytest.raises(TaskError, match=words):
        make_networks(PolicyConfig(tool_position=not shown), layout, 0)


@pytest.mark.parametrize("extras", [True, False], ids=["cloud", "no cloud"])
def test_rows_of_entity_kinds_in_a_checkpoint_keep_their_order(extras):
    """Each row is added to the vectors of one kind, in the order of older checkpoints."""
    seen = observed(extras=extras)
    found = Entities(layout_of(seen), 8, proprioceptive_only=False)
    with torch.no_grad():
        for project in found.project.values():
            project.weight.zero_()
        found.kind.copy_(torch.eye(8)[: len(found.kind)])
    vectors, mask = found(seen)
    rows = [0] * LINKS + [1, 2, 3] + [4] * OBSTACLES + [5] * extras
    assert torch.equal(vectors, torch.eye(8)[rows] * mask[..., None])


@agents
@kinds
@pytest.mark.parametrize("garbage", [-3e38, math.nan])
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

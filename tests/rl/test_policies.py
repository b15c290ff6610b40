"""Policies: agents, heads, normalizers of observations, and what changes their outputs."""

import math
import sys
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from types import ModuleType, SimpleNamespace

import pytest
import torch
from torch.distributions import Categorical, Independent, Normal

import morphgen
from helpers.line_batch import SMALL, OnALine, stored
from helpers.runs import QUIET, small_config
from morphgen.encoding.tokens import POSITION
from morphgen.errors import TaskError
from morphgen.rl import agents as networks_of
from morphgen.rl import config as constants
from morphgen.rl import observation_layout as layouts
from morphgen.rl import policies
from morphgen.rl.agents import AGENTS, FAST, PAPER, encoder, graph, mlp, preset_of, transformer
from morphgen.rl.config import PolicyConfig, PPOConfig, parse_agent
from morphgen.rl.inference import Policy, load_policy
from morphgen.rl.observation_layout import MaskedGaussian, MaskedMultiDiscrete, layout_of
from morphgen.rl.policies import RunningNormalizer, entries_unneeded, make_networks, rows_needed
from morphgen.rl.ppo import Learner, normalized_advantages
from morphgen.rl.runs.checkpoint import read_checkpoint, require_learner
from morphgen.rl.runs.training import resume_learner, state_of, train
from morphgen.rl.shipped_policies import POLICIES
from morphgen.tasks.actions import BINS
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.observation import observation_config, tree_entries
from morphgen.tasks.reach.task import Reach
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.task import GOAL, ObservationField

N, LINKS, OBSTACLES, POINTS = 4, 6, 3, 8
COUNT = torch.tensor([6, 4, 1, 3])
MASKS = {
    **dict.fromkeys(("tokens", "velocity", "previous_action", "lag", "jacobian"), "links"),
    **{"goal": "goal_mask", "object": "object_mask", "line": "object_mask"},
    **{"obstacles": "obstacle_mask", "points": "point_mask"},
}
"""Mask of the rows of each observation entry."""


def observed(seed=0, *, extras=True):
    """A mixed batch: rows 0 and 1 reach, 2 and 3 push; 3 has no obstacle, and 2 no point."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*shape, generator=generator)

    links = torch.arange(LINKS) < COUNT[:, None]
    actions = links & (torch.arange(LINKS) > 0)
    actions[2, 0] = True
    pushes = torch.tensor([False, False, True, True])
    found = {
        "tokens": normal(N, LINKS, 48),
        "links": links,
        "actions": actions,
        "goal": normal(N, 7),
        "goal_mask": ~pushes,
        "object": normal(N, 13),
        "object_mask": pushes,
        "line": normal(N, 1),
        "obstacles": normal(N, OBSTACLES, 13),
        "obstacle_mask": torch.tensor([[1, 0, 1], [1, 1, 1], [0, 1, 0], [0, 0, 0]]).bool(),
        **chain_entries(actions),
    }
    if extras:
        found["velocity"], found["previous_action"] = normal(N, LINKS), normal(N, LINKS)
        found["points"], found["tool"] = normal(N, POINTS, 3), normal(N, 3)
        found["point_mask"] = torch.tensor([True, True, False, True])[:, None].repeat(1, POINTS)
        found["point_mask"][0, 5:] = False
        found["lag"], found["jacobian"] = normal(N, LINKS, 1), normal(N, LINKS, 20)
    return found


def chain_entries(actions):
    """Return the tree of robots whose links follow each other, for movable links (n, L)."""
    chain = torch.ones(LINKS, LINKS).tril().bool().expand(len(actions), -1, -1)
    return tree_entries(SimpleNamespace(ancestors=chain), torch.arange(len(actions)), actions)


def mask_of(seen, name):
    """Return the mask of an observation entry, in the entry's shape."""
    mask = seen[MASKS[name]] if name in MASKS else torch.ones(N).bool()
    return mask.reshape(mask.shape + (1,) * (seen[name].dim() - mask.dim())).expand_as(seen[name])


def filled(seen, value):
    """Return the observation with its masked entries filled with a value."""
    values = {k: seen[k].masked_fill(~mask_of(seen, k), value) for k in MASKS if k in seen}
    return {**seen, **values}


def networks(agent="me-tf", seen=None, *, discrete=True, proprioceptive_only=False, lively=True):
    """Return an actor and a critic; ``lively`` ones have noise on the initial weights."""
    layout = layout_of(seen or observed())
    network = transformer.Config(logit_scale=1.0) if agent == "me-tf" else None
    options = {"proprioceptive_only": proprioceptive_only, "tool_position": layout.tool}
    config = PolicyConfig(agent=agent, discrete=discrete, network=network, **options)
    actor, critic = make_networks(config, layout, seed=0)
    if lively:
        generator = torch.Generator().manual_seed(1)
        for each in (*actor.parameters(), *critic.parameters()):
            each.data += 0.1 * torch.randn(each.shape, generator=generator)
    return actor, critic


def outputs(actor, critic, seen):
    """Return the modes, the log-probabilities of sampled actions, and the values."""
    head = actor.distribution(seen)
    return head.mode(), head.log_prob(head.sample(torch.Generator().manual_seed(0))), critic(seen)


agents = pytest.mark.parametrize("agent", list(AGENTS))
kinds = pytest.mark.parametrize("discrete", [True, False], ids=["discrete", "continuous"])


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
    seen = observed()

    def scaled(scale):
        network = transformer.Config(logit_scale=scale)
        config = PolicyConfig("me-tf", discrete, tool_position=True, network=network)
        return make_networks(config, layout_of(seen), 0)

    (plain, critic), (larger, other) = scaled(1.0), scaled(16.0)
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


def test_weights_for_other_observations_are_rejected_with_the_difference():
    here = layout_of(observed())
    fewer = {**observed(extras=False), "obstacles": torch.zeros(N, 0, 13)}
    words = r"obstacles 0, here 3; points 0, here 8; channels \(\), here .*; tool False, here True"
    with pytest.raises(TaskError, match=rf"a\.pt is for other .*: {words}"):
        layouts.require_layout(layout_of(fewer), here, "a.pt")
    layouts.require_layout(here, layout_of(observed(5)), "a.pt")


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
    found = encoder.Entities(layout_of(seen), 8, proprioceptive_only=False)
    with torch.no_grad():
        for project in found.project.values():
            project.weight.zero_()
        found.kind.copy_(torch.eye(8)[: len(found.kind)])
    vectors, mask = found(seen)
    rows = [0] * LINKS + [1, 2, 3] + [4] * OBSTACLES + [5] * extras
    assert torch.equal(vectors, torch.eye(8)[rows] * mask[..., None])


def learned(agent, seen, shown, discrete):
    """Return what networks for an observation make of another, and the gradients that it gives."""
    actor, critic = networks(agent, seen, discrete=discrete)
    found = outputs(actor, critic, shown)
    (found[1].sum() + found[2].square().sum()).backward()
    gradients = [each.grad for each in (*actor.parameters(), *critic.parameters())]
    return [*found, *(each for each in gradients if each is not None and each.any())]


@agents
@kinds
@pytest.mark.parametrize("garbage", [-3e38, math.nan])
def test_invalid_numbers_in_the_padding_change_no_output_and_no_gradient(agent, discrete, garbage):
    seen = observed()
    clean, dirty = (learned(agent, seen, filled(seen, fill), discrete) for fill in (0.0, garbage))
    for one, other in zip(clean, dirty, strict=True):
        assert one.isfinite().all()
        assert one.equal(other)


@kinds
def test_the_transformer_acts_and_learns_the_same_without_unused_rows(discrete):
    seen = {name: each[1:] for name, each in observed().items()}
    rows = rows_needed(PolicyConfig("me-tf"), seen)
    assert rows == COUNT[1:].max() == LINKS - 2
    assert rows_needed(PolicyConfig("me-mlp"), seen) == LINKS  # an MLP takes all of its layout
    found = []
    for needed in (seen, layouts.truncate_links(seen, rows)):
        actor, critic = networks("me-tf", seen, discrete=discrete)
        head = actor.distribution(needed)
        actions = layouts.pad_links(head.mode(), LINKS)
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
    found = [learned(agent, seen, shown, discrete) for shown in (seen, less)]
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
    fields = (("wind", 3, "goal_mask"),)
    assert learner.layout.fields == learner.layout.as_data()["fields"] == fields
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


@dataclass(frozen=True)
class Config(networks_of.NetworkConfig):
    width: int = 4


class Network(encoder.Network):
    """One linear layer over the joint positions of all links."""

    def __init__(self, config, layout, outputs, per_link):
        super().__init__(config, layout, outputs, per_link)
        self.shape = (layout.links, outputs) if per_link else (outputs,)
        self.enter = torch.nn.Linear(layout.links * layout.token, config.network.width)
        rows = layout.links if per_link else 1
        self.leave = encoder.last_layer(config.network.width, rows * outputs)

    def forward(self, observation):
        tokens = torch.where(observation["links"][..., None], observation["tokens"], 0.0)
        return self.leave(self.enter(tokens.flatten(1)).tanh()).reshape(-1, *self.shape)


@pytest.fixture
def linear(monkeypatch):
    module = ModuleType("linear_agent")
    module.Config, module.Network = Config, Network
    monkeypatch.setitem(sys.modules, "linear_agent", module)
    monkeypatch.setattr(AGENTS, "_loaded", dict(AGENTS._loaded))
    AGENTS.register(networks_of.Agent("linear", "linear_agent"))


def test_an_agent_of_another_module_trains_and_acts(linear, tmp_path):
    config = replace(small_config(), policy=PolicyConfig("linear", network=Config(width=3)))
    train(tmp_path, config, execution=QUIET)
    stored, learner = read_checkpoint(tmp_path)
    assert stored == config
    assert learner["actor"]["network.enter.weight"].shape[0] == 3
    assert str(parse_agent("linear-symlog")) == "linear-symlog"
    assert [label for label, _, _ in constants.parse_agents("linear,me-tf")] == ["linear", "me-tf"]
    assert constants.parse_constants(["width=7"]) == {"width": 7}


def test_a_policy_acts_on_an_observation_alone(tmp_path):
    train(tmp_path, small_config(total_timesteps=32), execution=QUIET)
    policy = load_policy(tmp_path)
    options = {"sim": "mujoco", **policy.batch_options}
    with closing(make_batch("reach", ["planar-cube"], 3, **options)) as batch:
        observation = batch.reset()
        actions = policy.act(observation)
        assert actions.shape == observation["links"].shape
        assert actions.equal(load_policy(tmp_path).act(observation))
        one = policy.act({name: value[1:2] for name, value in observation.items()})
        assert one.equal(actions[1:2])
        batch.step(actions)
    with pytest.raises(TaskError, match="the checkpoint is for other observations"):
        policy.act({**observation, "tokens": observation["tokens"][:, :3]})


@pytest.mark.parametrize("name", POLICIES.builtin)
def test_a_shipped_policy_is_loaded_by_its_name(name):
    policy = load_policy(name)
    (task,) = POLICIES[name].tasks
    options = {"sim": "mujoco", **policy.batch_options}
    with closing(make_batch(task, ["arm=ur5 ee=stick"], 2, **options)) as batch:
        observation = batch.reset()
        assert policy.act(observation).shape == observation["links"].shape


def test_unknown_policies_modes_and_devices_are_refused():
    with pytest.raises(TaskError, match="no such checkpoint"):
        load_policy("zero-shott")
    for mode in ("Deterministic", "greedy", None):
        with pytest.raises(TaskError, match=f"unknown mode {mode!r}.* valid: deterministic, stoch"):
            load_policy("zero-shot", mode)
    with pytest.raises(TaskError, match="unknown device 'gpu'; valid: cpu, cuda"):
        load_policy("zero-shot", device="gpu")


OBSERVE = ("lag", "joint", "jacobian")
POLICY = PolicyConfig("me-graph", discrete=False, observe=OBSERVE, normalize=True)


@pytest.fixture(scope="module")
def batches(tmp_path_factory):
    """A batch of small arms, and one of a robot with more joints and links than any of them."""
    cache, observe = tmp_path_factory.mktemp("goals"), observation_config(POLICY.channels)
    hand = morphgen.compose("arm=iiwa14 ee=allegro", geometry="primitive")
    made = [
        make_batch("reach", robots, 4, sim="kinematic", observe=observe, cache=cache)
        for robots in (["arm3", "arm=ur5 ee=stick"], [hand])
    ]
    assert made[1].robot_tables.max_links > made[0].robot_tables.max_links
    return made


def test_a_policy_acts_on_a_larger_robot(batches):
    small, large = batches
    learner = Learner(small, POLICY, CONFIG)
    learner.iterate()
    policy = Policy(state_of(learner), "deterministic", 0)
    actions = policy.act(large.reset())
    assert actions.shape == (4, large.robot_tables.max_links)
    assert actions[large.action_mask].abs().min() > 0
    assert not actions[~large.action_mask].any()


def test_the_order_of_links_does_not_matter(batches):
    """Actions follow the joints when links, and their places in the tree, are listed otherwise."""
    batch = batches[0]
    learner = Learner(batch, POLICY, CONFIG)
    random = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for weights in learner.actor.parameters():
            weights += 0.1 * torch.randn(weights.shape, generator=random)
    observation = learner._network_input(batch.reset())
    count = int((observation["joints"][0] >= 0).sum())
    order = torch.arange(observation["joints"].shape[1])
    order[:count] = order[:count].flip(0)
    place = order.argsort()
    parents = observation["joint_parents"][:, order]
    turned = {
        **observation,
        "joints": observation["joints"][:, order],
        "joint_parents": torch.where(parents >= 0, place[parents.clamp(min=0)], parents),
        "joint_relations": observation["joint_relations"][:, order][:, :, order],
    }
    one, other = learner.actor(observation), learner.actor(turned)
    torch.testing.assert_close(one[0], other[0], rtol=1e-4, atol=1e-5)


def test_the_relations_of_joints_change_actions(batches):
    learner = Learner(batches[0], POLICY, CONFIG)
    observation = learner._network_input(batches[0].reset())
    with torch.no_grad():
        learner.actor.network.head[-1].weight.normal_()
        learner.actor.network.relation.weight.normal_()
    unrelated = {**observation, "joint_relations": observation["joint_relations"] * 0}
    assert not learner.actor(observation).allclose(learner.actor(unrelated))


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
        (lambda: PPOConfig(num_steps=10).minibatch_size(3), "10 steps of 3 .* 16 equal minib"),
    ],
)
def test_invalid_configurations_are_rejected(make, words):
    with pytest.raises(TaskError, match=words):
        make()


@pytest.mark.parametrize("name", list(networks_of.PRESETS))
def test_presets_name_switches_and_constants_that_exist(name):
    preset = networks_of.PRESETS[name]
    assert set(preset.switches) <= set(constants.SWITCHES)
    fields = {field for field, _, _ in networks_of.network_fields()}
    assert set(preset.constants) <= {*constants.NUMBERS, *fields}


def test_each_agent_has_a_preset():
    assert preset_of(None, "me-graph") is FAST
    for agent in ("se", "me-mlp", "me-tf"):
        assert preset_of(None, agent) is PAPER
    assert preset_of("fast", "me-mlp") is FAST
    with pytest.raises(TaskError, match="unknown preset 'quick'"):
        preset_of("quick", "me-graph")


def test_the_preset_of_the_paper_changes_nothing():
    _, ppo = constants.configs_of(parse_agent("me-tf"), ["reach"], PAPER.constants, 1000)
    assert asdict(ppo) == asdict(PPOConfig(total_timesteps=1000))
    assert not PAPER.switches


def test_advantages_are_normalized_robot_by_robot():
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
    [(gaussian(), torch_gaussian, 0.0), (discrete(), torch_discrete, layouts.REST)],
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
    assert BINS[layouts.REST] == 0
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
    found = layouts.bounded_log_std(raw)
    assert found.item() == pytest.approx(layouts.INITIAL_LOG_STD, abs=1e-6)
    found.backward()
    assert raw.grad.item() > 0.1
    far = layouts.bounded_log_std(torch.tensor([-20.0, 20.0]))
    torch.testing.assert_close(
        far, torch.tensor([layouts.MIN_LOG_STD, layouts.MAX_LOG_STD]), atol=1e-4, rtol=0
    )


N_HEADS, HEADS, T, FEATURES = 5, 2, 7, 8
WAYS = {"as here": transformer.attend, "as on a GPU": transformer.attend_to_few}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_attention_is_a_weighted_mean_of_the_unmasked_values(way):
    q, k, v = torch.randn(3, N_HEADS, HEADS, T, FEATURES, generator=seeded())
    mask = torch.rand(N_HEADS, T, generator=seeded(1)) < 0.5
    mask[:, 0] = True
    for row, there in enumerate(mask):
        scores = q[row] @ k[row, :, there].mT / math.sqrt(FEATURES)
        wanted = scores.softmax(dim=-1) @ v[row, :, there]
        torch.testing.assert_close(way(q, k, v, mask)[row], wanted, rtol=1e-4, atol=1e-5)


LAYOUT = layouts.Layout(5, 48, 0, 0, (), vectors=(("lag", 1), ("dls", 3)))


def observed_normalizer(seed, rows=7):
    random = torch.Generator().manual_seed(seed)
    links = torch.rand(rows, 5, generator=random) > 0.4
    lag = 3 + 2 * torch.randn(rows, 5, 1, generator=random)
    return {"links": links, "lag": lag, "dls": torch.randn(rows, 5, 3, generator=random)}


def test_statistics_of_parts_are_those_of_the_whole():
    normalizer = RunningNormalizer(LAYOUT)
    parts = [observed_normalizer(seed, 3 + seed) for seed in range(4)]
    for part in parts:
        normalizer.update(part)
    values = torch.cat([torch.cat([p["lag"], p["dls"]], dim=-1)[p["links"]] for p in parts])
    torch.testing.assert_close(normalizer.mean, values.mean(dim=0))
    torch.testing.assert_close(normalizer.variance, values.var(dim=0, unbiased=False))
    assert int(normalizer.count) == len(values)


def test_columns_are_centred_and_scaled_and_padding_stays_zero():
    normalizer, seen = RunningNormalizer(LAYOUT), observed_normalizer(0, 4000)
    normalizer.update(seen)
    normalized = normalizer(seen)
    values = normalized["lag"][seen["links"]]
    torch.testing.assert_close(values.mean(), torch.tensor(0.0), atol=0.02, rtol=0)
    torch.testing.assert_close(values.std(), torch.tensor(1.0), atol=0.02, rtol=0)
    assert not normalized["lag"][~seen["links"]].any()
    far = {**seen, "lag": seen["lag"] + 1e6}
    assert normalizer(far)["lag"].max() == policies.MAX_NORMALIZED


class Lagging(OnALine):
    """A line whose observations have a lag."""

    def observe(self):
        observation = super().observe()
        return {**observation, "lag": observation["tokens"][..., 32:33] + 4.0}


def learner():
    policy = PolicyConfig("me-graph", discrete=False, observe=("lag",), normalize=True)
    return Learner(Lagging(8, kind="continuous", tree=True), policy, SMALL, seed=0)


def test_learners_update_all_networks_and_resume_with_the_statistics():
    one, other = learner(), learner()
    one.iterate()
    networks = (one.actor, one.critic, one.target_critic)
    assert len({float(network.normalizer.mean) for network in networks}) == 1
    assert abs(float(one.actor.normalizer.mean) - 4.0) < 1.5
    resume_learner(other, stored(state_of(one)))
    one.restart_episodes()
    for _ in range(2):
        one.iterate(), other.iterate()
    for name, value in one.actor.state_dict().items():
        assert value.equal(other.actor.state_dict()[name]), name

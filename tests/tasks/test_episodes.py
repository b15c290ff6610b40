"""Episodes of a batch: their distribution, what they depend on, and steps that read no tensor."""

from dataclasses import replace

import pytest
import torch

from helpers.device_reads import device_reads
from helpers.goal_sets import draw_spec
from helpers.scenes import robot
from helpers.stub_simulation import StubSimulation
from morphgen.errors import TaskError
from morphgen.rl.baselines.simple import Zero
from morphgen.rl.rollouts import STEPS_UNREAD, run_episodes
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.scenes.robot_tables import build_robot_tables
from morphgen.tasks.sim import base

REACH = ReachConfig(num_goals=6, max_episode_steps=9, train_layouts=3, eval_layouts=1)
PUSH = PushConfig(num_goals=6, max_episode_steps=11, train_layouts=3, eval_layouts=1)
POSE = replace(REACH, goal="pose")
CHANNELS = ObservationConfig(
    velocity=True,
    previous_action=True,
    tool=True,
    points=12,
    lag=True,
    joint=True,
    poses=True,
    jacobian=True,
    dls=True,
    tree=True,
)
"""All channels but ``ik``, which plans on the CPU."""
BOUND = 6.0
"""Largest accepted deviation [standard deviations]."""


@pytest.fixture(scope="module")
def specs(cache):
    arm, gantry = robot("arm3"), robot("prims")
    return {
        "reach": draw_spec(arm, REACH, cache=cache),
        "reach among obstacles": draw_spec(arm, REACH, obstacles=True, cache=cache),
        "pose": draw_spec(arm, POSE, obstacles=True, cache=cache),
        "push": draw_spec(gantry, PUSH, cache=cache),
        "push among obstacles": draw_spec(gantry, PUSH, obstacles=True, cache=cache),
    }


def stub_batch(specs, names, num_envs, *, first=0, **options):
    """Return a batch whose physics are a stub."""
    chosen = [specs[name] for name in names]
    index = [(first + i) % len(chosen) for i in range(num_envs)]
    simulation = StubSimulation([chosen[i].scene for i in index])
    tables = build_robot_tables([spec.robot for spec in chosen], (), max_links=23)
    return TaskBatch(tables, chosen, index, simulation, first=first, **options)


def drive(batch, steps, seed=0, diverging=True):
    """Return the numbers of all steps under random actions, by name; some environments diverge."""
    generator = torch.Generator().manual_seed(seed)
    numbers = {}

    def keep(name, value):
        numbers.setdefault(name, []).append(value)

    for step in range(steps):
        actions = 2 * torch.rand(batch.action_mask.shape, generator=generator) - 1
        if diverging and step % 4 == 3:
            batch.simulation.diverges[step % batch.num_envs] = True
        result = batch.step(actions)
        for name, value in vars(result).items():
            if isinstance(value, torch.Tensor):
                keep(name, value)
            elif isinstance(value, dict):
                for key, part in value.items():
                    keep(f"{name} {key}", part)
        keep("obstacles", batch.layouts.poses.clone())
        keep("resets", batch.simulation.resets.clone())
    return {name: torch.stack(values) for name, values in numbers.items()}


def require_equal(one, other):
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert torch.equal(values.nan_to_num(7.0), other[name].nan_to_num(7.0)), name


def pairs_of(batch, resets):
    """Return the numbers of start and goal in all episodes, (resets * n,) each."""
    goals = torch.from_numpy(batch.specs[0].goals.q).float()
    starts, ends = [], []
    for _ in range(resets):
        batch.reset()
        for q, found in (
            (batch.q, starts),
            (batch.groups["reach"].goal_configuration, ends),
        ):
            distance = (q[:, None] - goals).abs().amax(dim=2)
            assert (distance.amin(dim=1) == 0).all()
            found.append(distance.argmin(dim=1))
    return torch.cat(starts), torch.cat(ends)


def test_all_pairs_of_start_and_goal_are_equally_likely(specs):
    batch = stub_batch(specs, ["reach"], 300, seed=5)
    start, goal = pairs_of(batch, 40)
    counts = torch.bincount(6 * start + goal, minlength=36).reshape(6, 6)
    assert not counts.diagonal().any()
    expected = len(start) / 30
    others = counts[~torch.eye(6, dtype=torch.bool)]
    assert (others - expected).abs().max() < BOUND * expected**0.5


def test_layouts_are_equally_likely_and_leave_the_goals_free(specs):
    batch = stub_batch(specs, ["reach among obstacles"], 300)
    usable = torch.from_numpy(batch.specs[0].goals.usable)
    counts = torch.zeros(len(usable))
    for _ in range(10):
        start, goal = pairs_of(batch, 1)
        layout = batch.layouts.current
        assert usable[layout, start].all()
        assert usable[layout, goal].all()
        counts += torch.bincount(layout, minlength=len(usable))
    assert counts[REACH.train_layouts :].sum() == 0
    expected = counts.sum() / REACH.train_layouts
    assert (counts[: REACH.train_layouts] - expected).abs().max() < BOUND * expected**0.5


MIXED = ("pose", "push", "push among obstacles")


def test_episodes_do_not_depend_on_the_other_environments(specs):
    whole = stub_batch(specs, MIXED, 9, seed=3, observe=CHANNELS)
    part = stub_batch(specs, MIXED, 3, seed=3, first=3, observe=CHANNELS)
    whole.reset()
    part.reset()
    # The environments of the part end their episodes at other steps than the others.
    whole.step(torch.zeros(whole.action_mask.shape))
    part.step(torch.zeros(part.action_mask.shape))
    for _ in range(30):
        actions = torch.rand(whole.action_mask.shape) * 2 - 1
        whole.simulation.diverges[0] = True
        a, b = whole.step(actions), part.step(actions[3:6])
        assert torch.equal(a.q[3:6], b.q)
        assert torch.equal(a.reward[3:6], b.reward)
        assert torch.equal(a.truncated[3:6], b.truncated)
        for name, values in b.observation.items():
            assert torch.equal(a.observation[name][3:6], values), name
        assert torch.equal(whole.layouts.poses[3:6], part.layouts.poses)


def test_a_resumed_batch_begins_the_same_episodes(specs):
    one, other = (stub_batch(specs, MIXED, 6, seed=seed, observe=CHANNELS) for seed in (3, 4))
    one.reset()
    one.advance(0.2)
    drive(one, 25)
    assert one.state_dict()["next_episode"].unique().numel() > 1
    other.load_state_dict(one.state_dict())
    observation = other.reset()
    for name, values in one.reset().items():
        assert torch.equal(values, observation[name]), name
    assert torch.equal(one.groups["push"].line, other.groups["push"].line)
    with pytest.raises(TaskError, match="the state is of 6 environments; expected 3"):
        stub_batch(specs, MIXED, 3).load_state_dict(one.state_dict())


@pytest.mark.parametrize("names", [("reach",), ("push",), MIXED])
def test_skipping_what_changes_nothing_changes_no_bit(specs, names, monkeypatch):
    batches = [stub_batch(specs, names, 6, seed=3, observe=CHANNELS) for _ in range(2)]
    skipping, complete = batches
    for batch in batches:
        batch.reset(spread=True)
    numbers = drive(skipping, 60)
    with monkeypatch.context() as patch:
        patch.setattr(base, "HOST_DEVICES", ())
        require_equal(numbers, drive(complete, 60))
    assert (numbers["truncated"] | numbers["terminated"]).any(dim=0).all()
    assert numbers["diverged"].any(dim=0).any()
    assert numbers["terminated"].any() == ("push" in names)


def test_a_diverged_environment_is_reset_once_and_the_step_undone(specs):
    batch = stub_batch(specs, MIXED, 3, observe=CHANNELS)
    batch.reset()
    before = batch.step(torch.zeros(batch.action_mask.shape))
    batch.simulation.diverges[1] = True
    resets = batch.simulation.resets.clone()
    step = batch.step(torch.ones(batch.action_mask.shape))
    assert step.diverged.tolist() == step.truncated.tolist() == [False, True, False]
    assert torch.equal(step.q[1], before.q[1])
    assert torch.equal(step.block_pose[1], before.block_pose[1])
    assert (batch.simulation.resets - resets).tolist() == [0, 1, 0]
    for part in (step.observation, step.final_observation):
        assert all(values.float().isfinite().all() for values in part.values())


@pytest.mark.parametrize(
    "names", [MIXED, *(pytest.param((task,), marks=pytest.mark.slow) for task in ("reach", "push"))]
)
def test_steps_and_resets_read_no_tensor(specs, names):
    batch = stub_batch(specs, names, 6, observe=CHANNELS)
    controller = Zero()
    batch.reset()
    controller.act(batch)  # fills caches of constants
    batch.simulation.diverges[2] = True
    with device_reads() as reads:
        results = [batch.step(controller.act(batch)) for _ in range(60)]
        batch.advance(0.3)
        batch.reset(seed=4, spread=True)
    assert reads.found == []
    assert torch.stack([each.truncated | each.terminated for each in results]).any(dim=0).all()
    assert results[0].diverged.tolist() == [env == 2 for env in range(6)]


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_steps_of_the_kinematic_simulation_read_no_tensor(specs, kind, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(base, "HOST_DEVICES", ())  # the simulation asks once
        batch = batch_from_specs([specs["reach"]], 4, sim="kinematic", kind=kind)
        batch.reset()
        rest = Zero().act(batch)
        batch.step(rest)
    wrong = rest.clone()
    wrong[1, batch.action_mask[1]] = len(rest) * 100 if kind == "discrete" else torch.nan
    with device_reads() as reads:
        results = [batch.step(rest) for _ in range(20)]
        diverged = batch.step(wrong)
        after = batch.step(rest)
    assert reads.found == []
    assert torch.stack([each.truncated for each in results]).any(dim=0).all()
    assert diverged.diverged.tolist() == diverged.truncated.tolist() == [False, True, False, False]
    assert not after.diverged.any()
    assert after.q.isfinite().all()
    assert all(values.float().isfinite().all() for values in after.observation.values())


def test_evaluations_read_tensors_only_now_and_then(specs):
    """Episodes are those of an evaluation that looks at every step."""
    count = 3
    expected = run_episodes(stub_batch(specs, MIXED, 6), Zero(), count)
    reads_of = {}
    for limit in (1, count):
        batch = stub_batch(specs, MIXED, 6)
        with device_reads() as reads:
            episodes = run_episodes(batch, Zero(), limit)
        reads_of[limit] = len(reads.found)
    assert repr(episodes) == repr(expected)
    rounds = -(-count * PUSH.max_episode_steps // STEPS_UNREAD)
    assert reads_of[count] <= reads_of[1] * rounds
    assert len(expected) == 6 * count
    assert {each.success for each in expected} == {True, False}

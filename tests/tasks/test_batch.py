"""Batches of reach environments: episodes, terminations and reproducibility."""

from dataclasses import replace

import pytest
import torch

import morphgen
from helpers.goal_sets import draw_spec
from morphgen.errors import TaskError
from morphgen.model.kinematics_torch import frame_positions
from morphgen.rl.baselines import BASELINES
from morphgen.rl.baselines.simple import Random, Zero
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.actions import BINS, encode_actions
from morphgen.tasks.observation import ObservationConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs, make_batch

CONFIG = replace(ReachConfig(), num_goals=20)
WORDS = ("arm3", "arm=ur5 ee=plane", "prims")


@pytest.fixture(scope="module")
def robots():
    return [morphgen.compose(words, geometry="primitive") for words in WORDS]


@pytest.fixture(scope="module")
def settings(robots, cache):
    return {
        obstacles: [
            draw_spec(robot, CONFIG, obstacles=obstacles, seed=0, cache=cache) for robot in robots
        ]
        for obstacles in (False, True)
    }


@pytest.fixture
def build_batch(settings, opened):
    def make(num_envs=3, robots=(0, 1, 2), obstacles=False, config=CONFIG, **options):
        chosen = [replace(settings[obstacles][i], config=config) for i in robots]
        options = {"sim": "mujoco", **options}
        return opened(batch_from_specs(chosen, num_envs, **options))

    return make


def test_reach_episode_has_one_goal_and_ends_only_by_time(build_batch):
    batch = build_batch(config=replace(CONFIG, max_episode_steps=5))
    batch.reset()
    goal = batch.field("goal").clone()
    controller = Random(0)
    for k in range(4):
        step = batch.step(controller.act(batch))
        assert not step.truncated.any(), k
        assert torch.equal(batch.field("goal"), goal)
    step = batch.step(controller.act(batch))
    assert step.truncated.all()
    assert not step.terminated.any()
    assert not torch.equal(batch.field("goal"), goal)
    assert (batch.episode_step == 0).all()
    assert torch.equal(step.final_observation["goal"], goal)
    assert torch.equal(step.observation["goal"], batch.field("goal"))
    assert not torch.equal(step.observation["tokens"], step.final_observation["tokens"])


def test_start_is_never_the_goal_configuration(build_batch):
    batch = build_batch(40, robots=(0,))
    for _ in range(3):
        batch.reset()
        goal_q = batch.groups["reach"].goal_configuration
        assert ((batch.targets - goal_q).abs().amax(dim=1) > 1e-3).all()
        there = frame_positions(batch.robot_tables.tool_chain, batch.env_robot_index, goal_q)
        assert (there - batch.field("goal")[:, :3]).abs().max() < 1e-4


def test_batches_smaller_than_the_robot_list_are_rejected():
    with pytest.raises(TaskError, match="2 environments for 3 robots"):
        make_batch("reach", list(WORDS), 2)
    with pytest.raises(TaskError, match=r"expected a list, \['prims'\]"):
        make_batch("reach", "prims", 2)


def test_actions_are_rounded_to_the_nearest_bin_towards_zero():
    shares = torch.tensor([[0.0, 1.0, -1.0, 0.3, -0.3, 0.01]])
    bins = [BINS[i] for i in encode_actions(shares, "discrete")[0].tolist()]
    assert bins == [0.0, 1.0, -1.0, 0.25, -0.25, 0.0]


def test_returned_tensors_are_copies(build_batch):
    """Kept tensors do not change later, and writing to them does not change the batch."""
    options = {
        "obstacles": True,
        "observe": ObservationConfig(velocity=True, previous_action=True, tool=True, points=8),
    }
    batch, whole, chance = build_batch(**options), build_batch(**options), Random(0)

    def tensors(step):
        parts = {"now": step.observation, "final": step.final_observation, "terms": step.terms}
        plain = ("reward", "terminated", "truncated", "diverged", "success", "distance", "score")
        named = {f"{of} {k}": v for of, part in parts.items() for k, v in part.items()}
        return named | {k: getattr(step, k) for k in (*plain, "q", "block_pose")}

    def spoil(values):
        for each in values:
            each.copy_(~each if each.dtype == torch.bool else each + 7)

    spoil(batch.reset().values())
    whole.reset()
    state = batch.state_dict()
    batch.load_state_dict(state)
    spoil(
        [
            batch.q,
            batch.field("goal"),
            batch.field("line")[:, 0],
        ]
    )
    for _ in range(3):
        actions = chance.act(whole)
        spoiled, kept = tensors(batch.step(actions)), tensors(whole.step(actions))
        before = {name: each.clone() for name, each in kept.items()}
        whole.observe()
        for name, each in spoiled.items():
            assert torch.equal(each, before[name]), name
            spoil([each])
        places = [each.data_ptr() for each in spoiled.values() if each.numel()]
        assert len(places) == len(set(places))
        spoil(batch.observe().values())
        assert all(torch.equal(kept[name], before[name]) for name in kept)


def test_spread_reset_staggers_the_first_episodes(build_batch):
    batch = build_batch(60, robots=(0,), seed=1)
    batch.reset(spread=True)
    passed = batch.episode_step.clone()
    assert passed.unique().numel() > 40
    assert 0 <= passed.min() < 60 < 240 < passed.max() < CONFIG.max_episode_steps
    batch.reset(seed=1, spread=True)
    assert torch.equal(batch.episode_step, passed)
    over = torch.zeros(60, dtype=torch.bool)
    for _ in range(CONFIG.max_episode_steps - int(passed.max())):
        over |= batch.step(Zero().act(batch)).truncated
    assert torch.equal(over, passed == passed.max())


def test_inverse_kinematics_reaches_its_goals_in_mujoco(build_batch):
    batch = build_batch(config=replace(CONFIG, max_episode_steps=150))
    episodes = run_episodes(batch, BASELINES["ik"].make(0), 1)
    assert len(episodes) == 3
    assert all(episode.success for episode in episodes)

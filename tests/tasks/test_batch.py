"""Reach over a batch of bodies: episodes, what ends them, and that the same seed gives the same."""

from dataclasses import replace

import pytest
import torch

import morphgen
from morphgen.grammar.library import default_library
from morphgen.rl.references import InverseKinematics, Random, Zero, as_actions
from morphgen.tasks.batch import ReachBatch
from morphgen.tasks.bodies import bodies_of
from morphgen.tasks.config import BINS, ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.goals import goal_set
from morphgen.tasks.kinematics import tool_poses
from morphgen.tasks.sim.base import Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

CONFIG = replace(ReachConfig(), goals=20)
WORDS = ("arm3", "arm=ur5 ee=plane", "prims")


@pytest.fixture(scope="module")
def robots():
    return [morphgen.compose(words, geometry="primitive") for words in WORDS]


@pytest.fixture(scope="module")
def bodies(robots):
    return bodies_of(robots, default_library(()).folders)


@pytest.fixture(scope="module")
def sets(robots, tmp_path_factory):
    cache = tmp_path_factory.mktemp("goals")
    return {
        obstacles: {
            i: goal_set(robot, CONFIG, obstacles=obstacles, seed=0, cache=cache)
            for i, robot in enumerate(robots)
        }
        for obstacles in (False, True)
    }


@pytest.fixture
def made(robots, bodies, sets):
    """Make batches; they are closed when the test is over."""
    opened = []

    def make(body=(0, 1, 2), obstacles=False, **options):
        goals = sets[obstacles]
        scenes = [Scene(robots[i], obstacles=goals[i].obstacles) for i in body]
        config = options.pop("config", CONFIG)
        simulation = MujocoSimulation(scenes)
        batch = ReachBatch(bodies, body, goals, simulation, config=config, **options)
        opened.append(batch)
        return batch

    yield make
    for batch in opened:
        batch.close()


def run(batch, controller, steps):
    batch.reset()
    return [batch.step(controller.act(batch)) for _ in range(steps)]


def test_observations_have_the_shapes_they_claim(made, bodies):
    seen = made(obstacles=True).reset()
    n, links = 3, bodies.max_links
    assert {name: tuple(value.shape) for name, value in seen.items()} == {
        "tokens": (n, links, 48),
        "links": (n, links),
        "actions": (n, links),
        "goal": (n, 7),
        "obstacles": (n, CONFIG.obstacles, 13),
        "obstacle_mask": (n, CONFIG.obstacles),
    }
    assert seen["obstacle_mask"].all()
    assert all(value.isfinite().all() for value in seen.values())


def test_an_episode_has_one_goal_and_ends_by_time_alone(made):
    batch = made(config=replace(CONFIG, steps=5))
    batch.reset()
    goal = batch.goal.clone()
    controller = Random(0)
    for k in range(4):
        step = batch.step(controller.act(batch))
        assert not step.truncated.any(), k
        assert torch.equal(batch.goal, goal)
    step = batch.step(controller.act(batch))
    assert step.truncated.all()
    assert not step.terminated.any()
    assert not torch.equal(batch.goal, goal)
    assert (batch.elapsed == 0).all()


def test_the_final_observation_is_before_the_next_start(made):
    batch = made(config=replace(CONFIG, steps=3))
    batch.reset()
    for _ in range(3):
        goal = batch.goal.clone()
        step = batch.step(Random(1).act(batch))
    assert torch.equal(step.final_observation["goal"], goal)
    assert torch.equal(step.observation["goal"], batch.goal)
    assert not torch.equal(step.observation["tokens"], step.final_observation["tokens"])


def test_a_start_is_never_the_goals_own_configuration(made):
    batch = made(body=(0,) * 40)
    for _ in range(3):
        batch.reset()
        assert ((batch.targets - batch.witness).abs().amax(dim=1) > 1e-3).all()
        there = tool_poses(batch.bodies.chain, batch.body, batch.witness)
        assert (there[:, :3] - batch.goal[:, :3]).abs().max() < 1e-4


def test_doing_nothing_moves_nothing(made):
    batch = made()
    batch.reset()
    before = tool_poses(batch.bodies.chain, batch.body, batch.q)
    for _ in range(CONFIG.steps - 1):
        batch.step(Zero().act(batch))
    after = tool_poses(batch.bodies.chain, batch.body, batch.q)
    assert (after - before)[:, :3].norm(dim=1).max() < 1e-3


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_inverse_kinematics_arrives_and_chance_does_not(made, kind):
    body = (0,) * 12
    steps = run(made(body=body, kind=kind), InverseKinematics(0), CONFIG.steps)
    assert steps[-1].success.float().mean() >= 0.9
    assert steps[-1].score[steps[-1].success].unique().tolist() == [CONFIG.score_near]
    steps = run(made(body=body, kind=kind), Random(0), CONFIG.steps)
    assert steps[-1].success.float().mean() <= 0.2


def test_inverse_kinematics_goes_around_what_is_in_the_way(made, robots):
    spaces = [FreeSpace(Scene(robot)) for robot in robots]
    steps = run(made(body=(1,) * 8 + (2,) * 4), InverseKinematics(0, spaces), CONFIG.steps)
    assert steps[-1].success.float().mean() >= 0.9


def test_the_reward_is_the_sum_of_its_terms(made):
    for step in run(made(obstacles=True), Random(3), 20):
        assert torch.allclose(step.reward, sum(step.terms.values()))
        assert step.reward.isfinite().all()


def test_an_environment_is_the_same_in_whichever_batch(made):
    whole = made(body=(0, 1, 2, 0), seed=7)
    part = made(body=(2, 0), seed=7, first=2)
    actions = torch.rand(30, 4, whole.bodies.max_links, generator=torch.Generator().manual_seed(0))
    whole.reset()
    part.reset()
    for action in 2 * actions - 1:
        a, b = whole.step(action), part.step(action[2:])
        assert torch.equal(a.observation["tokens"][2:], b.observation["tokens"])
        assert torch.equal(a.reward[2:], b.reward)


def test_shares_become_the_nearest_bins_towards_zero():
    shares = torch.tensor([[0.0, 1.0, -1.0, 0.3, -0.3, 0.01]])
    found = [BINS[i] for i in as_actions(shares, "discrete")[0].tolist()]
    assert found == [0.0, 1.0, -1.0, 0.25, -0.25, 0.0]

"""Inverse kinematics goes by free ways, and what goes with them; how episodes are told."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.scenes import robot
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.kinematics import joint_limits
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.rl.baselines.ik import STARTS, InverseKinematics, random_starts
from morphgen.rl.baselines.path_planner import LEGS, FreeWays, Routes, shares_to
from morphgen.rl.baselines.rrt_connect import explored
from morphgen.rl.baselines.scripted_push import ScriptedPush
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.make import make_batch
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.sim.base import CONTROL_PERIOD, Block, Scene

REACH, PUSH = ReachConfig(num_goals=10), PushConfig(num_goals=4)
CLAW, CHAIN = "arm=arm3 ee=claw", "nlink"


@pytest.fixture
def made(tmp_path):
    opened = []

    def make(words, n, task="reach", **options):
        given = {"cache": tmp_path, "configs": (REACH, PUSH), "sim": "mujoco", **options}
        opened.append(make_batch(task, [robot(words)], n, **given))
        opened[-1].reset()
        return opened[-1]

    yield make
    for batch in opened:
        batch.close()


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_a_robot_gets_past_a_stop(made, kind):
    """The smallest bin is no nearer than a sixteenth of a step, so nothing may wait for more."""
    batch = made("prims", 1, kind=kind)
    routes = Routes(batch)
    start = batch.targets[0].numpy().astype(np.float64)
    low, high = joint_limits(batch.specs[0].robot).T
    stop, end = 0.6 * start + 0.4 * low, 0.6 * start + 0.4 * high
    routes.take(0, [stop, end])
    for _ in range(200):
        final = routes.go_on()
        batch.step(encode_actions(shares_to(batch, routes.wanted), kind))
    assert final.all()
    step = batch.robot_tables.max_step[0]
    assert ((batch.targets[0] - torch.from_numpy(end)).abs() <= step / 16 + 1e-6).all()


def test_all_legs_of_a_way_are_followed_however_many(made):
    batch = made("prims", 2)
    routes = Routes(batch)
    starts = batch.targets.numpy().astype(np.float64)
    other = starts[1] + 0.1
    routes.take(1, [starts[1], other])
    routes.take(0, [starts[0]] * (LEGS + 3))
    finals = torch.stack([routes.go_on() for _ in range(LEGS + 3)])
    assert finals[:, 0].tolist() == [False] * (LEGS + 2) + [True]
    assert routes.wanted[1].numpy() == pytest.approx(other, abs=1e-6)


def ball_on_slides():
    """A ball on slides along x and y, beside a slide that does not move it."""
    links = [Link("base"), Link("cart"), Link("ball", collisions=(Shape(Sphere(0.1)),))]
    joints = [
        Joint("x", "prismatic", "base", "cart", Pose((0, 0, 0.2)), (1, 0, 0), (-2.0, 2.0)),
        Joint("y", "prismatic", "cart", "ball", Pose(), (0, 1, 0), (-2.0, 2.0)),
        Joint("idle", "prismatic", "base", "idle", Pose(), (0, 0, 1), (-1.0, 1.0)),
    ]
    frames = (Frame("tool", "ball"),)
    return Robot("ball", (*links, Link("idle")), tuple(joints), frames, (0.0, 0.0, 0.0))


def test_joints_that_do_not_move_stay_on_every_way():
    wall = Block((0.2, 1.0, 0.4), Pose((0.0, -0.5, 0.2)))
    space = FreeSpace(Scene(ball_on_slides(), obstacles=(wall,)))
    moves, step = np.array([True, True, False]), np.full(3, 0.05)
    ways = FreeWays(space, step, np.random.default_rng(0), moves)
    start, end = np.array([-0.5, -0.5, 0.7]), np.array([[0.5, -0.5, 0.7]])
    over, round_about = ways.find(start, end), ways.find_round_about(start, end)
    assert over is not None
    assert len(over.points) > 1
    for way in (over, round_about):
        assert np.array(way.points)[:, 2].tolist() == [0.7] * len(way.points)
        for a, b in pairwise((start, *way.points)):
            assert space.free(a + np.linspace(0, 1, 99)[:, None] * (b - a)).all()
    assert ways.reached(start, 5)[:, 2].tolist() == [0.7] * 5


def test_what_is_explored_is_on_this_side_of_a_wall():
    wall = Block((0.2, 10.0, 0.4), Pose((0.0, 0.0, 0.2)))
    space = FreeSpace(Scene(ball_on_slides(), obstacles=(wall,)))
    ways = FreeWays(space, np.full(3, 0.05), np.random.default_rng(0))
    found = ways.reached(np.array([-1.0, 0.0, 0.0]), 30)
    assert found.shape == (30, 3)
    assert found[:, 0].max() < -0.19
    assert np.ptp(found[:, :2], axis=0).min() > 0.5
    assert np.array_equal(found, ways.reached(np.array([-1.0, 0.0, 0.0]), 30))
    assert not np.array_equal(found, ways.reached(np.array([-1.0, 0.0, 0.0]), 30, attempt=1))


def test_a_tree_that_cannot_grow_is_its_start():
    bounds, rng = np.array([[0.0, 1.0]]), np.random.default_rng(0)
    found = explored(np.array([0.5]), bounds, np.array([0.1]), lambda a, b: 0.0, rng, 3)
    assert np.array(found.nodes).tolist() == [[0.5]]
    assert found.back(0) == [0.5]


def test_starts_are_the_given_one_and_others_that_leave_fingers_alone(made):
    batch = made(CLAW, 6)
    near = batch.targets.clone()
    starts = random_starts(
        batch.robot_tables, batch.env_robot_index, near, torch.Generator().manual_seed(0)
    )
    assert len(starts) == STARTS
    assert torch.equal(starts[0], near)
    assert (starts[1:] != near).any()
    idle = ~batch.robot_tables.moves_tool[0]
    assert idle.any()
    assert torch.equal(starts[..., idle], near[:, idle].expand(STARTS, -1, -1))


@pytest.mark.parametrize("words", [CLAW, CHAIN])
def test_goals_are_reached_though_links_are_in_each_others_way(made, words):
    batch = made(words, 8)
    episodes = run_episodes(batch, InverseKinematics(0), 1)
    assert sum(episode.success for episode in episodes) >= 7


def test_an_episode_of_push_scores_its_success_and_takes_its_time(made):
    batch = made("prims", 3, "push")
    episodes = run_episodes(batch, ScriptedPush(0), 1)
    assert any(episode.success for episode in episodes)
    for episode in episodes:
        assert episode.score == float(episode.success)
        assert episode.seconds == pytest.approx(episode.steps * CONTROL_PERIOD)


def test_an_episode_of_reach_scores_the_mean_of_its_steps(made):
    batch, scores = made("prims", 1), []
    step = batch.step

    def watched(actions):
        scores.append(step(actions))
        return scores[-1]

    batch.step = watched
    (episode,) = run_episodes(batch, InverseKinematics(0), 1)
    found = [float(each.score[0]) for each in scores]
    assert episode.steps == len(found) == REACH.max_episode_steps
    assert episode.score == pytest.approx(np.mean(found), rel=1e-4)
    assert episode.score != pytest.approx(found[-1], rel=1e-4)

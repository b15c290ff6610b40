"""The baseline ``ik`` reaches goals along collision-free paths; results of episodes."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.scenes import robot
from morphgen.rl.baselines.ik import InverseKinematics
from morphgen.rl.baselines.path_planner import PathFollower
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import make_batch

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


def test_joints_of_two_turns_take_the_shorter_way(made):
    batch = made("arm=ur5 ee=stick", 12)
    tables, steps, follow = batch.robot_tables, [], PathFollower.follow
    assert (tables.upper[0] - tables.lower[0])[tables.moves_tool[0]].max() > 4 * math.pi - 0.01
    half_turn = math.pi / tables.max_step[0][tables.moves_tool[0]].min()

    def record(follower, env, waypoints):
        if len(waypoints) == 1:  # a straight path
            change = torch.from_numpy(waypoints[0]) - batch.targets[env].double()
            steps.append((change / tables.max_step[0]).abs().max())
        follow(follower, env, waypoints)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(PathFollower, "follow", record)
        InverseKinematics(0).act(batch)
    assert len(steps) > 6
    assert max(steps) <= half_turn + 1e-3


@pytest.mark.parametrize("words", [CLAW, CHAIN])
def test_goals_are_reached_by_robots_whose_links_obstruct_each_other(made, words):
    batch = made(words, 8)
    episodes = run_episodes(batch, InverseKinematics(0), 1)
    assert sum(episode.success for episode in episodes) >= 7


@pytest.mark.parametrize("words", [CLAW, "prims"])
def test_poses_are_reached(made, words):
    batch = made(words, 8, configs=(replace(REACH, goal="pose"),))
    episodes = run_episodes(batch, InverseKinematics(0), 1)
    assert sum(episode.success for episode in episodes) >= 7


def test_a_reach_episode_scores_the_mean_of_its_steps(made):
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

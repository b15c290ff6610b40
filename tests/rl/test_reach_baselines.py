"""The baselines of reach: ``ik`` along collision-free paths, ``jacobian`` by columns."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.scenes import robot
from morphgen.model.kinematics_torch import frame_pose
from morphgen.rl.baselines import baselines_for
from morphgen.rl.baselines.ik import InverseKinematics
from morphgen.rl.baselines.path_planner import PathFollower
from morphgen.rl.baselines.simple import GAIN, JacobianColumns, column_steps
from morphgen.rl.inference import run_episodes
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import make_batch

REACH = ReachConfig(num_goals=10)
CLAW, CHAIN = "arm=arm3 ee=claw", "nlink"


@pytest.fixture
def made(tmp_path):
    opened = []

    def make(words, n, **options):
        given = {"cache": tmp_path, "configs": (REACH,), "sim": "mujoco", **options}
        opened.append(make_batch("reach", [robot(each) for each in words.split(", ")], n, **given))
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


def test_a_step_is_the_projection_on_the_column():
    J = torch.tensor([[[0.5, 0.0, 2.0, 1e-6], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 2.0, 0.0]]])
    error = torch.tensor([[0.1, -0.2, 0.3]])
    steps = column_steps(J, error)
    expected = torch.tensor([[0.05 / 0.25, -0.2, (0.2 + 0.6) / 8, 0.0]])
    assert torch.allclose(steps, expected)
    # Without the step of joint j, no other step along column j leaves a smaller error.
    for j in range(3):
        left = (error - J[:, :, j] * steps[:, j]).norm()
        for change in (-1e-3, 1e-3):
            assert (error - J[:, :, j] * (steps[:, j] + change)).norm() > left


def test_a_slide_moves_by_a_share_of_the_error_along_its_axis(made):
    batch = made("prims", 8)
    tables, before = batch.robot_tables, batch.targets.clone()
    # The first three joints are slides along x, y and z.
    assert tables.tool_chain.joints.is_prismatic[0, :3].all()
    tools = frame_pose(tables.tool_chain, batch.env_robot_index, before)[:, :3, 3]
    wanted = GAIN * (batch.field("goal")[:, :3] - tools)
    largest = tables.max_step[0, :3]
    assert (wanted.abs() > largest).any()
    assert (wanted.abs() < largest).any()
    batch.step(JacobianColumns().act(batch))
    expected = before[:, :3] + torch.clamp(wanted, -largest, largest)
    expected = torch.clamp(expected, tables.lower[0, :3], tables.upper[0, :3])
    assert torch.allclose(batch.targets[:, :3], expected, atol=1e-5)


def test_different_robots_reach_in_one_batch(made):
    assert baselines_for("reach") == ("ik", "jacobian", "zero", "random")
    assert baselines_for("push") == ("scripted", "zero", "random")
    batch = made("prims, arm=ur5 ee=stick", 16)
    episodes = run_episodes(batch, JacobianColumns(), 1)
    success = [[e.success for e in episodes if e.robot_index == i] for i in range(2)]
    assert all(success[0])
    assert sum(success[1]) >= 5


def test_orientations_are_approached_where_goals_are_poses(made):
    """A ball on a gantry turns about two axes: each joint has a column of its own."""
    pose = replace(REACH, goal="pose")
    batch = made("prims", 12, configs=(pose,))
    episodes = run_episodes(batch, JacobianColumns(), 1)
    by_position = made("prims", 12, configs=(pose,))
    blind = run_episodes(by_position, PositionOnly(), 1)
    assert sum(e.success for e in episodes) > sum(e.success for e in blind) + 2


class PositionOnly(JacobianColumns):
    """Acts as if the goals of a batch were positions."""

    def act(self, task):
        envs = task.groups["reach"]
        envs.needs_tool_rotation = False
        actions = super().act(task)
        envs.needs_tool_rotation = True
        return actions

"""The baseline ``jacobian``: each joint follows its own Jacobian column, whatever the robot."""

from dataclasses import replace

import pytest
import torch

from helpers.scenes import robot
from morphgen.model.kinematics_torch import frame_pose
from morphgen.rl.baselines import baselines_for
from morphgen.rl.baselines.simple import GAIN, JacobianColumns, column_steps
from morphgen.rl.rollouts import run_episodes
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import make_batch

REACH = ReachConfig(num_goals=10)


@pytest.fixture
def made(tmp_path):
    opened = []

    def make(words, n, **options):
        given = {"cache": tmp_path, "configs": (REACH,), "sim": "mujoco", **options}
        opened.append(make_batch("reach", [robot(each) for each in words], n, **given))
        opened[-1].reset()
        return opened[-1]

    yield make
    for batch in opened:
        batch.close()


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
    batch = made(["prims"], 8)
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
    batch = made(["prims", "arm=ur5 ee=stick"], 16)
    episodes = run_episodes(batch, JacobianColumns(), 1)
    success = [[e.success for e in episodes if e.robot_index == i] for i in range(2)]
    assert all(success[0])
    assert sum(success[1]) >= 5


def test_orientations_are_approached_where_goals_are_poses(made):
    """A ball on a gantry turns about two axes: each joint has a column of its own."""
    pose = replace(REACH, goal="pose")
    batch = made(["prims"], 12, configs=(pose,))
    episodes = run_episodes(batch, JacobianColumns(), 1)
    by_position = made(["prims"], 12, configs=(pose,))
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

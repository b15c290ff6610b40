"""Reach with goals that are poses: success, reward and score need the tool's orientation, too."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.resets import reset_envs
from helpers.scenes import robot
from morphgen.errors import TaskError
from morphgen.model.kinematics_torch import angle_between, matrix_from_quaternion
from morphgen.tasks.gym.env import TaskEnv
from morphgen.tasks.gym.vector import task_vector
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.envs import anybody_score, is_near, reach_terms
from morphgen.tasks.scenes.make import make_batch

POSITION = ReachConfig(num_goals=5, max_episode_steps=6)
POSE = replace(POSITION, goal="pose")


@pytest.fixture
def made(tmp_path):
    opened = []

    def make(config, words=("arm3-stick",), n=4, task="reach", **options):
        given = {"cache": tmp_path, "configs": (config,), "sim": "mujoco", **options}
        opened.append(make_batch(task, [robot(each) for each in words], n, **given))
        opened[-1].reset()
        return opened[-1]

    yield make
    for batch in opened:
        batch.close()


def turned(angle):
    """A rotation by an angle about an oblique axis."""
    axis = torch.tensor([1.0, -2.0, 0.5]) / math.sqrt(5.25)
    half = torch.tensor(angle / 2)
    return matrix_from_quaternion(torch.cat([torch.cos(half)[None], torch.sin(half) * axis]))


@pytest.mark.parametrize("angle", [0.0, 1e-4, 0.2, 1.5, 3.0, math.pi])
def test_angle_between_rotations(angle):
    first = turned(0.7)
    second = turned(angle) @ first
    measured = angle_between(first[None], second[None])
    assert measured.item() == pytest.approx(angle, abs=2e-3 if angle > 3 else 2e-6)


def test_success_needs_position_and_orientation():
    distance = torch.tensor([0.02, 0.02, 0.04, 0.04])
    angle = torch.tensor([9.0, 11.0, 9.0, 11.0]).deg2rad()
    assert is_near(POSE, distance, angle).tolist() == [True, False, False, False]
    assert is_near(POSITION, distance).tolist() == [True, True, False, False]
    score = anybody_score(POSE, distance, angle)
    assert score.tolist() == pytest.approx([200, -50 * 0.02**2, -50 * 0.04**2, -50 * 0.04**2])


def test_the_rotation_term_weighs_the_angle_as_the_distance_of_the_same_tolerance():
    config = replace(POSE, near=0.05, near_angle=0.25, rotation_weight=3.0)
    zeros = torch.zeros(2)
    terms = reach_terms(config, torch.tensor([0.05, 0.1]), zeros, zeros, torch.tensor([0.25, 0.5]))
    assert terms["rotation"].tolist() == pytest.approx([-0.15, -0.3])
    assert torch.allclose(terms["rotation"], 3 * terms["distance"])
    assert "rotation" not in reach_terms(config, zeros, zeros, zeros)


def test_at_its_goals_configuration_a_robot_succeeds_and_elsewhere_the_angle_is_that_of_the_tool(
    made,
):
    batch = made(POSE)
    envs = batch.groups["reach"]
    goal_q = envs.goal_configuration.clone()
    reset_envs(batch.simulation, torch.arange(4), goal_q)
    batch.targets = goal_q.clone()
    step = batch.step(torch.zeros(batch.action_mask.shape))
    assert step.success.all()
    assert (step.angle < math.radians(1)).all()
    assert torch.equal(envs.target_rotations(), matrix_from_quaternion(envs.goal[:, 3:]))


def test_goals_and_episodes_are_those_of_the_position(made):
    """Only the evaluation differs: the goal set has the same key, and physics does not change."""
    pose, position = made(POSE), made(POSITION)
    assert pose.specs[0].goals.key == position.specs[0].goals.key
    assert position.groups["reach"].target_rotations() is None
    for _ in range(3):
        actions = torch.rand(pose.action_mask.shape) * 2 - 1
        one, other = pose.step(actions), position.step(actions)
        assert torch.equal(one.q, other.q)
        assert torch.equal(one.distance, other.distance)
        assert other.angle is None
        assert "rotation" not in other.terms
        expected = other.reward - other.terms["near"] + one.terms["near"] + one.terms["rotation"]
        assert torch.allclose(one.reward, expected)
        assert (one.terms["near"] <= other.terms["near"]).all()


def test_in_a_batch_with_another_task_only_reach_has_angles(made):
    words, push = ("arm3-stick", "prims"), PushConfig(num_goals=3)
    batch = made(POSE, words, task=["reach", "push"], configs=(POSE, push))
    step = batch.step(torch.zeros(batch.action_mask.shape))
    assert torch.isfinite(step.angle).tolist() == [True, False, True, False]
    alone = made(POSE, words[:1], n=1)
    assert torch.equal(
        alone.step(torch.zeros(1, step.observation["links"].shape[1])).angle, step.angle[:1]
    )


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"goal": "poses"}, r"unknown goal of reach 'poses'.*pose"),
        ({"near_angle": 0.0}, r"near_angle 0: expected more than 0"),
        ({"near_angle": np.inf}, r"near_angle inf: expected finite numbers"),
        ({"near_angle": 4.0}, r"near_angle 4: expected more than 0, up to pi"),
    ],
)
def test_invalid_constants_are_named(values, words):
    with pytest.raises(TaskError, match=words):
        ReachConfig(**values)


def test_gymnasium_reports_the_angle(tmp_path):
    options = {"sim": "mujoco", "cache": tmp_path}
    env = TaskEnv("reach", robot("arm3-stick"), config=POSE, **options)
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[-1]
    assert 0 < info["angle"] <= math.pi
    env.close()
    vector = task_vector(2, task="reach", robot=robot("arm3-stick"), configs=(POSE,), **options)
    vector.reset(seed=0)
    infos = vector.step(np.zeros(vector.action_space.shape))[-1]
    assert infos["angle"].shape == (2,)
    assert (infos["angle"] > 0).all()
    vector.close()

"""Padded tensors of the robots of a batch."""

import numpy as np
import pytest
import torch

import morphgen
from morphgen.benchmark.tokens import tokens
from morphgen.errors import BenchmarkError, RobotError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import default_library
from morphgen.model.geometry import Box, Shape
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.tasks.observation import LinkTokens
from morphgen.tasks.scenes.robot_tables import STEP_SLIDE, STEP_TURN, build_robot_tables
from morphgen.tasks.sim.base import CONTROL_PERIOD

FOLDERS = default_library(()).folders
WORDS = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "chain beads=2", "prims", "arm3")


@pytest.fixture(scope="module")
def robots():
    return [morphgen.compose(words) for words in WORDS]


@pytest.fixture(scope="module")
def robot_tables(robots):
    return build_robot_tables(robots, FOLDERS)


def configurations(robots, robot_tables, n=20):
    """Return robot indices (n R,) and joint positions (n R, J) of n configurations per robot."""
    rng = np.random.default_rng(0)
    body = torch.arange(len(robots)).repeat_interleave(n)
    q = torch.zeros(len(body), robot_tables.max_joints, dtype=torch.float64)
    for i, robot in enumerate(robots):
        q[body == i, : robot.dof] = torch.from_numpy(random_configurations(robot, n, rng))
    return body, q


def test_position_codes_match_the_tokens(robots, robot_tables):
    body, q = configurations(robots, robot_tables, n=4)
    link_tokens = LinkTokens(robot_tables, body)(q.float())
    for i, robot in enumerate(robots):
        shapes = token_shapes(robot, FOLDERS)
        expected = tokens(robot, shapes, q[body == i, : robot.dof].numpy())
        together = link_tokens[body == i]
        n = len(robot.links)
        # The fastest sine has angular frequency 64 pi, which costs five digits in float32.
        assert together[:, :n].numpy() == pytest.approx(expected, abs=2e-4)
        assert (together[:, n:] == 0).all()


def test_masks_and_step_sizes_match_the_joints(robots, robot_tables):
    for i, robot in enumerate(robots):
        n = len(robot.links)
        assert robot_tables.link_mask[i].tolist() == [True] * n + [False] * (
            robot_tables.max_links - n
        )
        moved = [k + 1 for k in robot.independent_joints]
        assert torch.nonzero(robot_tables.joint_of_link[i] >= 0)[:, 0].tolist() == moved
        for j, k in enumerate(robot.independent_joints):
            joint = robot.joints[k]
            most = STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN
            expected = min(most, (joint.velocity or np.inf) * CONTROL_PERIOD)
            assert robot_tables.max_step[i, j] == pytest.approx(expected)
            assert robot_tables.lower[i, j] == pytest.approx(joint.effective_limits[0])
            assert robot_tables.upper[i, j] == pytest.approx(joint.effective_limits[1])
        assert (robot_tables.max_step[i, robot.dof :] == 0).all()


def test_fingers_are_actuated_in_push_but_not_in_reach(robots, robot_tables):
    panda = 1
    reach, push = (robot_tables.action_mask(fingers=fingers)[panda] for fingers in (False, True))
    names = [link.name for link in robots[panda].links]
    fingers = [names[i] for i in torch.nonzero(push & ~reach)[:, 0].tolist()]
    assert reach.sum() == 7
    assert fingers
    assert all("finger" in name for name in fingers)


def test_mimic_joint_follows_its_leader():
    links = tuple(Link(n, collisions=(Shape(Box((0.1, 0.1, 0.1))),)) for n in ("a", "b", "c"))
    joints = (
        Joint("lead", "revolute", "a", "b", axis=(0, 0, 1), limits=(-1.0, 1.0)),
        Joint(
            "follow",
            "prismatic",
            "b",
            "c",
            axis=(1, 0, 0),
            limits=(0.0, 1.0),
            mimic=morphgen.model.robot.Mimic("lead", 0.3, 0.1),
        ),
    )
    robot = Robot("r", links, joints, (Frame("tool", "c"),), (0.2,))
    robot_tables = build_robot_tables([robot])
    assert robot_tables.action_mask(fingers=True)[0].sum() == 1


@pytest.mark.parametrize(
    ("robot", "error", "words"),
    [
        (Robot("r", (Link("a"),)), RobotError, "tool"),
        (Robot("r", (Link("a"),), frames=(Frame("tool", "a"),)), RobotError, "no joint moves"),
    ],
)
def test_robots_without_a_tool_or_moving_joint_are_rejected(robot, error, words):
    with pytest.raises(error, match=words):
        build_robot_tables([robot])


def test_empty_batch_is_rejected():
    with pytest.raises(BenchmarkError, match="no robots"):
        build_robot_tables([])

"""Tables of robots, conversion of actions to joint targets, and rewards of positions and poses."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import morphgen
from helpers.resets import reset_envs
from helpers.scenes import robot
from morphgen.encoding.tokens import tokens
from morphgen.errors import BenchmarkError, RobotError, TaskError
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import default_library
from morphgen.model.kinematics import random_configurations
from morphgen.model.kinematics_torch import matrix_from_quaternion
from morphgen.model.robot import Frame, Link, Robot
from morphgen.tasks.actions import ActionDecoder, JointMotion
from morphgen.tasks.gym.vector import task_vector
from morphgen.tasks.observation import LinkTokens
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.push.envs import PushFormulas, curriculum_line, push_terms
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.envs import ReachFormulas, anybody_score, is_near, reach_terms
from morphgen.tasks.rows import limit_violation, numpy_row, positive_part
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.scenes.robot_tables import STEP_SLIDE, STEP_TURN, build_robot_tables
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.task import TaskState

CPU = torch.device("cpu")


@pytest.mark.parametrize(
    ("actions", "kind", "words"),
    [
        (torch.zeros(1, 3), "continuous", r"shape \(1, 3\); expected \(1, 2\)"),
        (torch.tensor([[0.0, np.nan]]), "continuous", "environment 0, link 1 is not finite"),
        (torch.tensor([[0, 11]]), "discrete", "environment 0, link 1: .* 0 to 10"),
        (torch.tensor([[0, -1]]), "discrete", "from 0 to 10"),
        (torch.tensor([[0.0, 1.0]]), "discrete", "integers from 0"),
        (torch.tensor([[0.0, 1.0]], dtype=torch.float16), "discrete", "integers from 0"),
    ],
)
def test_invalid_actions_are_rejected_and_others_clipped(actions, kind, words):
    decoders = {name: ActionDecoder(name, CPU) for name in ("continuous", "discrete")}
    numbers = decoders["continuous"](torch.tensor([[2.0, -0.5]]), (1, 2))
    assert numbers.tolist() == [[1.0, -0.5]]
    numbers = decoders["discrete"](torch.tensor([[0, 5, 10]]), (1, 3))
    assert numbers.tolist() == [[-1.0, 0.0, 1.0]]
    with pytest.raises(TaskError, match=words):
        decoders[kind](actions, (1, 2))


@pytest.mark.parametrize("dtype", ["uint8", "int8", "int16", "int32", "int64"])
def test_discrete_actions_are_integers_of_any_size(dtype):
    decode = ActionDecoder("discrete", CPU)
    actions = torch.tensor([[0, 5, 10]], dtype=getattr(torch, dtype))
    assert decode(actions, (1, 3)).tolist() == [[-1.0, 0.0, 1.0]]
    assert numpy_row(decode)(actions[0].numpy(), (3,)).tolist() == [-1.0, 0.0, 1.0]
    with pytest.raises(TaskError, match="integers from 0 to 10"):
        numpy_row(decode)(np.zeros(3, np.float16), (3,))


@pytest.mark.parametrize("value", [-1.0, 0.0, 2.0, np.nan])
def test_the_positive_part_is_the_same_in_numpy(value):
    batch = positive_part(torch.tensor([value]))[0].item()
    np.testing.assert_equal(float(positive_part(np.float32(value))), batch)


def test_targets_stay_within_limits_and_masked_links_do_not_move(robot_tables):
    body = torch.tensor([1])
    mask = robot_tables.action_mask(fingers=False)[body]
    motion = JointMotion(robot_tables, body)
    home = robot_tables.home[body]
    motion.targets.copy_(home)
    motion.act(0.5 * mask)
    half = torch.minimum(home + robot_tables.max_step[body] / 2, robot_tables.upper[body])
    moved = robot_tables.moves_tool[1]
    assert torch.equal(motion.targets, torch.where(moved, half, home))
    for _ in range(400):
        motion.act(1.0 * mask)
    assert torch.equal(motion.targets[0, moved], robot_tables.upper[1, moved])
    assert torch.equal(motion.targets[0, ~moved], home[0, ~moved])


def test_reach_reward_terms():
    config = ReachConfig()
    distance = torch.tensor([0.029, 0.031])
    violation = limit_violation(
        torch.tensor([[1.5, 0.0], [0.0, -2.5]]), torch.tensor([-1.0, -2.0]), torch.tensor([1.0, 2])
    )
    assert violation.tolist() == pytest.approx([0.5, 0.5])
    terms = reach_terms(config, distance, violation, torch.tensor([10.0, 0.0]))
    assert terms["near"].tolist() == [config.near_weight, 0.0]
    assert terms["distance"].tolist() == pytest.approx([-0.029, -0.031])
    assert terms["joint_limits"].tolist() == pytest.approx([-0.5, -0.5])
    assert terms["joint_acceleration"].tolist() == pytest.approx([-1e-4, 0.0])
    score = anybody_score(config, distance)
    assert score.tolist() == pytest.approx([200.0, -50 * 0.031**2])


def test_push_reward_terms():
    success = torch.tensor([True, False])
    terms = push_terms(
        PushConfig(),
        to_go=torch.tensor([0.0, 0.3]),
        approach=torch.tensor([0.1, 0.2]),
        limit_violation=torch.zeros(2),
        success=success,
    )
    assert terms["success"].tolist() == [10.0, 0.0]
    assert terms["distance"].tolist() == pytest.approx([0.0, -0.3])
    assert terms["approach"].tolist() == pytest.approx([-0.05, -0.1])


def test_a_diverged_step_is_never_a_success():
    """Even with the tool at the goal and the block across the line."""
    tool, block, zero = torch.zeros(2, 3), torch.zeros(2, 7), torch.zeros(2)
    state = TaskState(tool, block, zero, zero, diverged=torch.tensor([False, True]))
    reached = ReachFormulas(ReachConfig(), torch.zeros(2, 7), None).evaluate(state)
    assert reached.success.tolist() == [True, False]
    lines = torch.tensor([-0.1, -0.1])
    pushed = PushFormulas(PushConfig(), lines, torch.zeros(2, 13)).evaluate(state)
    assert pushed.success.tolist() == pushed.terminated.tolist() == [True, False]
    assert pushed.score.tolist() == [1.0, 0.0]


def test_curriculum_line_moves_during_the_first_half_of_training():
    line = torch.tensor([0.2, 0.1])
    places = [curriculum_line(PushConfig(), line, p / 100)[0].item() for p in range(101)]
    assert places[0] == pytest.approx(0.02)
    assert places == sorted(places)
    assert places[50:] == [pytest.approx(0.2)] * 51
    assert len(set(places)) == 51


FOLDERS = default_library(()).folders
WORDS = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "chain beads=2", "prims", "arm3")


@pytest.fixture(scope="module")
def robots():
    return [morphgen.compose(words) for words in WORDS]


@pytest.fixture(scope="module")
def robot_tables(robots):
    return build_robot_tables(robots, FOLDERS)


def configurations(robots, robot_tables, n=20):
    """Return each indices (n R,) and joint positions (n R, J) of n configurations per each."""
    rng = np.random.default_rng(0)
    body = torch.arange(len(robots)).repeat_interleave(n)
    q = torch.zeros(len(body), robot_tables.max_joints, dtype=torch.float64)
    for i, each in enumerate(robots):
        q[body == i, : each.dof] = torch.from_numpy(random_configurations(each, n, rng))
    return body, q


def test_position_codes_match_the_tokens(robots, robot_tables):
    body, q = configurations(robots, robot_tables, n=4)
    link_tokens = LinkTokens(robot_tables, body)(q.float())
    for i, each in enumerate(robots):
        shapes = token_shapes(each, FOLDERS)
        expected = tokens(each, shapes, q[body == i, : each.dof].numpy())
        together = link_tokens[body == i]
        n = len(each.links)
        # The fastest sine has angular frequency 64 pi, which costs five digits in float32.
        assert together[:, :n].numpy() == pytest.approx(expected, abs=2e-4)
        assert (together[:, n:] == 0).all()


def test_masks_and_step_sizes_match_the_joints(robots, robot_tables):
    for i, each in enumerate(robots):
        n = len(each.links)
        assert robot_tables.link_mask[i].tolist() == [True] * n + [False] * (
            robot_tables.max_links - n
        )
        moved = [k + 1 for k in each.independent_joints]
        assert torch.nonzero(robot_tables.joint_of_link[i] >= 0)[:, 0].tolist() == moved
        for j, k in enumerate(each.independent_joints):
            joint = each.joints[k]
            most = STEP_SLIDE if joint.kind == "prismatic" else STEP_TURN
            expected = min(most, (joint.velocity or np.inf) * CONTROL_PERIOD)
            assert robot_tables.max_step[i, j] == pytest.approx(expected)
            assert robot_tables.lower[i, j] == pytest.approx(joint.effective_limits[0])
            assert robot_tables.upper[i, j] == pytest.approx(joint.effective_limits[1])
        assert (robot_tables.max_step[i, each.dof :] == 0).all()


def test_fingers_are_actuated_in_push_but_not_in_reach(robots, robot_tables):
    panda = 1
    reach, push = (robot_tables.action_mask(fingers=fingers)[panda] for fingers in (False, True))
    names = [link.name for link in robots[panda].links]
    fingers = [names[i] for i in torch.nonzero(push & ~reach)[:, 0].tolist()]
    assert reach.sum() == 7
    assert fingers
    assert all("finger" in name for name in fingers)


@pytest.mark.parametrize(
    ("each", "error", "words"),
    [
        (Robot("r", (Link("a"),)), RobotError, "tool"),
        (Robot("r", (Link("a"),), frames=(Frame("tool", "a"),)), RobotError, "no joint moves"),
    ],
)
def test_robots_without_a_tool_or_moving_joint_are_rejected(each, error, words):
    with pytest.raises(error, match=words):
        build_robot_tables([each])
    with pytest.raises(BenchmarkError, match="no robots"):
        build_robot_tables([])


POSITION = ReachConfig(num_goals=5, max_episode_steps=6)
POSE = replace(POSITION, goal="pose")


@pytest.fixture
def made(tmp_path, opened):
    def make(config, words=("arm3-stick",), n=4, task="reach", **options):
        given = {"cache": tmp_path, "configs": (config,), "sim": "mujoco", **options}
        batch = opened(make_batch(task, [robot(each) for each in words], n, **given))
        batch.reset()
        return batch

    return make


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
    batch.targets.copy_(goal_q)
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


def test_vectors_report_the_angle(tmp_path):
    options = {"sim": "mujoco", "cache": tmp_path}
    vector = task_vector(2, task="reach", robot=robot("arm3-stick"), configs=(POSE,), **options)
    vector.reset(seed=0)
    infos = vector.step(np.zeros(vector.action_space.shape))[-1]
    assert infos["angle"].shape == (2,)
    assert (infos["angle"] > 0).all()
    vector.close()

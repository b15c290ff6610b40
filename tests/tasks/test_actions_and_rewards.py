"""Conversion of actions to joint targets, and reward terms."""

import numpy as np
import pytest
import torch

import morphgen
from morphgen.errors import TaskError
from morphgen.grammar.library import default_library
from morphgen.tasks.actions import BINS, JointTargets, decode_actions
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.push.envs import curriculum_line, evaluate_push, push_terms
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.reach.envs import anybody_score, evaluate_reach, reach_terms
from morphgen.tasks.rows import limit_violation
from morphgen.tasks.scenes.robot_tables import build_robot_tables
from morphgen.tasks.task import TaskState

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def robot_tables():
    robots = [morphgen.compose(words) for words in ("arm=ur5 ee=plane", "arm=panda ee=panda_hand")]
    return build_robot_tables(robots, default_library(()).folders)


def test_bins_are_symmetric_and_hold_zero():
    assert len(BINS) == 11
    assert tuple(sorted(BINS)) == BINS
    assert [-b for b in reversed(BINS)] == list(BINS)
    assert BINS[5] == 0


def test_continuous_actions_are_clipped_and_discrete_actions_index_bins():
    shares = decode_actions(torch.tensor([[2.0, -0.5]]), "continuous", (1, 2), CPU)
    assert shares.tolist() == [[1.0, -0.5]]
    shares = decode_actions(torch.tensor([[0, 5, 10]]), "discrete", (1, 3), CPU)
    assert shares.tolist() == [[-1.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    ("actions", "kind", "words"),
    [
        (torch.zeros(1, 3), "continuous", r"shape \(1, 3\); expected \(1, 2\)"),
        (torch.tensor([[0.0, np.nan]]), "continuous", "environment 0, link 1 is not finite"),
        (torch.tensor([[0, 11]]), "discrete", "environment 0, link 1: .* 0 to 10"),
        (torch.tensor([[0, -1]]), "discrete", "from 0 to 10"),
        (torch.tensor([[0.0, 1.0]]), "discrete", "integers from 0"),
    ],
)
def test_invalid_actions_are_rejected(actions, kind, words):
    with pytest.raises(TaskError, match=words):
        decode_actions(actions, kind, (1, 2), CPU)


def test_targets_move_from_the_previous_targets_by_each_joints_step(robot_tables):
    body = torch.tensor([0, 1, 1])
    mask = robot_tables.action_mask(fingers=True)[body]
    before = robot_tables.home[body]
    shares = torch.ones(3, robot_tables.max_links)
    after = JointTargets(robot_tables, body, mask)(before, shares)
    expected = torch.minimum(before + robot_tables.max_step[body], robot_tables.upper[body])
    assert torch.equal(after, expected)
    assert (after[0, 6:] == 0).all()


def test_targets_stay_within_limits_and_masked_links_do_not_move(robot_tables):
    body = torch.tensor([1])
    mask = robot_tables.action_mask(fingers=False)[body]
    targets = robot_tables.home[body]
    moved_by = JointTargets(robot_tables, body, mask)
    for _ in range(400):
        targets = moved_by(targets, torch.ones(1, robot_tables.max_links))
    moved = robot_tables.moves_tool[1]
    assert torch.equal(targets[0, moved], robot_tables.upper[1, moved])
    assert torch.equal(targets[0, ~moved], robot_tables.home[1, ~moved])


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
    reached = evaluate_reach(ReachConfig(), torch.zeros(2, 7), state)
    assert reached.success.tolist() == [True, False]
    pushed = evaluate_push(PushConfig(), torch.tensor([-0.1, -0.1]), state)
    assert pushed.success.tolist() == pushed.terminated.tolist() == [True, False]
    assert pushed.score.tolist() == [1.0, 0.0]


def test_curriculum_line_moves_during_the_first_half_of_training():
    line = torch.tensor([0.2, 0.1])
    places = [curriculum_line(PushConfig(), line, p / 100)[0].item() for p in range(101)]
    assert places[0] == pytest.approx(0.02)
    assert places == sorted(places)
    assert places[50:] == [pytest.approx(0.2)] * 51
    assert len(set(places)) == 51

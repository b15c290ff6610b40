"""Collision-free paths in joint space, and robots that follow them."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.scenes import ball, robot
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.kinematics import joint_limits
from morphgen.model.kinematics_torch import frame_pose
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.rl.baselines import baselines_for
from morphgen.rl.baselines.ik import InverseKinematics
from morphgen.rl.baselines.path_planner import (
    PathCost,
    PathFollower,
    PathPlanner,
    fractions_towards,
)
from morphgen.rl.baselines.simple import GAIN, JacobianColumns, column_steps
from morphgen.rl.inference import run_episodes
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.free_space import RESOLUTION, FreeSpace
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.sim.base import Block, Scene

STEP = np.array([0.02, 0.02])
FAR_AWAY = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
NO_DEADLINE = np.array([np.inf, np.inf])
NO_GOALS = np.zeros((0, 2))


def space_of(*walls):
    """Free space of a ball of 0.1 m on slides along x and y, with a block and walls."""
    return FreeSpace(Scene(ball(0.2), object=Block((0.1, 0.1, 0.1)), obstacles=walls))


def planner_of(*walls):
    return PathPlanner(space_of(*walls), STEP, 0)


def assert_free(space, start, path, least=1.0):
    for a, b in pairwise((start, *path.waypoints)):
        line = a + np.linspace(0, 1, 199)[:, None] * (b - a)
        assert space.free(line).mean() >= least


def test_straight_paths_to_the_nearest_goal_or_by_its_via():
    wall = Block((0.2, 2.0, 0.4), Pose((0.0, -1.0, 0.2)))
    planner, space = planner_of(wall), space_of(wall)
    start, goals = np.array([-0.5, -0.5]), np.array([[0.5, -0.5], [-0.5, 0.5]])
    block = np.array([1.5, 1.5, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert planner.steps(start, goals) == pytest.approx([50, 50])
    nearest = planner.plan_straight(start, goals, block=block)
    assert (nearest.goal, len(nearest.waypoints)) == (1, 1)
    assert planner.plan_straight(start, goals[:1], block=block) is None
    via = np.array([[-0.5, 0.5]])
    around = planner.plan_straight(start, np.array([[0.5, 0.5]]), vias=via, block=block)
    assert [q.tolist() for q in around.waypoints] == [[-0.5, 0.5], [0.5, 0.5]]
    assert_free(space, start, around)
    inside = np.array([[0.0, -0.5]])
    assert planner.plan_straight(start, inside, block=block) is None
    on_the_goal = np.array([-0.5, 0.5, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert planner.plan_straight(start, goals[1:], block=on_the_goal) is None
    path = planner.plan_straight(start, goals[1:])
    assert path.waypoints[-1].tolist() == goals[1].tolist()


def test_rrt_connect_finds_a_way_out_of_a_pocket():
    """The pocket is open to the other side; of two goals one is in a wall."""
    walls = (
        Block((0.1, 1.2, 0.4), Pose((0.5, 0.0, 0.2))),
        Block((1.0, 0.1, 0.4), Pose((0.0, 0.6, 0.2))),
        Block((1.0, 0.1, 0.4), Pose((0.0, -0.6, 0.2))),
    )
    planner, space = planner_of(*walls), space_of(*walls)
    start, goals = np.array([0.2, 0.0]), np.array([[0.5, 0.0], [1.0, 0.0]])
    assert planner.plan_straight(start, goals) is None
    path, _ = planner.plan_rrt(start, goals)
    assert path.goal == 1
    assert path.waypoints[-1].tolist() == [1.0, 0.0]
    assert_free(space, start, path)
    again, _ = planner.plan_rrt(start, goals)
    assert all((a == b).all() for a, b in zip(path.waypoints, again.waypoints, strict=True))
    for unreachable in (goals[:1], NO_GOALS):
        path, tree = planner.plan_rrt(start, unreachable, iterations=50)
        assert path is None
        assert space.free(np.array(tree.nodes)).all()


def test_immovable_joints_keep_their_position():
    """A ball on slides along x and y, and a slide that does not move it."""
    links = [Link("base"), Link("cart"), Link("ball", collisions=(Shape(Sphere(0.1)),))]
    joints = (
        Joint("x", "prismatic", "base", "cart", Pose((0, 0, 0.2)), (1, 0, 0), (-2.0, 2.0)),
        Joint("y", "prismatic", "cart", "ball", Pose(), (0, 1, 0), (-2.0, 2.0)),
        Joint("idle", "prismatic", "base", "idle", Pose(), (0, 0, 1), (-1.0, 1.0)),
    )
    frames = (Frame("tool", "ball"),)
    slides = Robot("ball", (*links, Link("idle")), joints, frames, (0.0, 0.0, 0.0))
    wall = Block((0.2, 1.0, 0.4), Pose((0.0, -0.5, 0.2)))
    space = FreeSpace(Scene(slides, obstacles=(wall,)))
    planner = PathPlanner(space, np.full(3, 0.05), 0, np.array([True, True, False]))
    start, goals = np.array([-0.5, -0.5, 0.7]), np.array([[0.5, -0.5, 0.7]])
    path, tree = planner.plan_rrt(start, goals)
    assert len(path.waypoints) > 1
    assert {q[2] for q in (*path.waypoints, *tree.nodes)} == {0.7}
    assert_free(space, start, path)


def test_a_tree_stays_on_its_side_of_a_wall():
    wall = Block((0.2, 10.0, 0.4), Pose((0.0, 0.0, 0.2)))
    planner, start = planner_of(wall), np.array([-1.0, 0.0])

    def nodes(attempt=0):
        _, tree = planner.plan_rrt(start, NO_GOALS, attempt=attempt, iterations=100)
        return np.array(tree.nodes)

    assert nodes()[:, 0].max() < -0.19
    assert np.ptp(nodes(), axis=0).min() > 0.5
    assert np.array_equal(nodes(), nodes())
    assert not np.array_equal(nodes(), nodes(attempt=1))


def test_paths_along_a_tree_lead_to_goals_that_it_can_reach():
    """A wall without a gap hides the cheaper one of two goals, so the path leads to the other."""
    walls = (
        Block((0.1, 4.5, 0.4), Pose((0.5, 0.0, 0.2))),
        Block((0.1, 1.0, 0.4), Pose((-0.3, 0.0, 0.2))),
    )
    planner, space = planner_of(*walls), space_of(*walls)
    start, goals = np.array([0.0, 0.0]), np.array([[1.0, 0.0], [-1.0, 0.0]])
    _, tree = planner.plan_rrt(start, NO_GOALS, block=FAR_AWAY, iterations=400)
    assert max(q[0] for q in tree.nodes) < 0.5

    def plan(goals, goal_cost):
        cost = PathCost(np.array(goal_cost), NO_DEADLINE[: len(goals)])
        options = {"vias": goals, "cost": cost, "block": FAR_AWAY, "tree": tree}
        return planner.plan_straight(start, goals, **options)

    path = plan(goals, [0.0, 500.0])
    assert path.goal == 1
    assert path.waypoints[-1].tolist() == [-1.0, 0.0]
    assert_free(space, start, path, least=0.95)
    assert planner.length(start, path) >= 50
    assert plan(goals[:1], [0.0]) is None
    assert plan(NO_GOALS, np.zeros(0)) is None


@pytest.mark.parametrize(
    ("with_tree", "goals", "goal_cost", "deadline", "goal"),
    [
        (True, [[1.8, 1.8], [0.3, 0.0]], [0.0, 40.0], np.inf, 1),
        (True, [[1.8, 1.8], [0.3, 0.0]], [0.0, 120.0], np.inf, 0),
        (True, [[1.8, 1.8], [0.3, 0.0]], [0.0, 120.0], 70.0, 1),  # the other path would be late
        (False, [[1.0, 0.0], [0.3, 0.0]], [0.0, 100.0], np.inf, 0),
        (False, [[1.0, 0.0], [0.3, 0.0]], [0.0, 100.0], [51.0, 0.0], 0),
        (False, [[1.0, 0.0], [0.3, 0.0]], [0.0, 100.0], 40.0, 1),
        (False, [[1.0, 0.0], [0.3, 0.0]], [0.0, 100.0], -30.0, 0),  # both are far too late
    ],
)
def test_the_cheapest_path_is_taken(with_tree, goals, goal_cost, deadline, goal):
    planner, start = planner_of(), np.array([0.0, 0.0])
    tree = None
    if with_tree:
        _, tree = planner.plan_rrt(start, NO_GOALS, block=FAR_AWAY, iterations=400)
    cost = PathCost(np.array(goal_cost), np.broadcast_to(deadline, 2))
    options = {"cost": cost, "block": FAR_AWAY, "tree": tree}
    assert planner.plan_straight(start, np.array(goals), **options).goal == goal


@pytest.fixture
def slider_batch(tmp_path):
    batches = []

    def make(n, **options):
        batch = make_batch("reach", [robot("prims")], n, cache=tmp_path, sim="mujoco", **options)
        batches.append(batch)
        batch.reset()
        return batch

    yield make
    for batch in batches:
        batch.close()


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_robots_pass_waypoints_that_the_smallest_bin_cannot_reach(slider_batch, kind):
    batch = slider_batch(1, kind=kind)
    follower = PathFollower(batch)
    start = batch.targets[0].numpy().astype(np.float64)
    low, high = joint_limits(batch.specs[0].robot).T
    waypoint, goal = 0.6 * start + 0.4 * low, 0.6 * start + 0.4 * high
    follower.follow(0, [waypoint, goal])
    for _ in range(200):
        finished = follower.advance()
        batch.step(encode_actions(fractions_towards(batch, follower.waypoint), kind))
    assert finished.all()
    step = batch.robot_tables.max_step[0]
    assert ((batch.targets[0] - torch.from_numpy(goal)).abs() <= step / 16 + 1e-6).all()


def test_followers_take_paths_of_any_length(slider_batch):
    batch = slider_batch(2)
    follower = PathFollower(batch)
    starts = batch.targets.numpy().astype(np.float64)
    other = starts[1] + 0.1
    follower.follow(1, [starts[1], other])
    follower.follow(0, [starts[0]] * 27)
    finished = torch.stack([follower.advance() for _ in range(27)])
    assert finished[:, 0].tolist() == [False] * 26 + [True]
    assert follower.waypoint[1].numpy() == pytest.approx(other, abs=1e-6)


@pytest.mark.parametrize("resolution", [RESOLUTION, RESOLUTION / 5])
@pytest.mark.parametrize("far", [0.0, 0.0501, 0.0999, 0.52])
def test_tested_configurations_are_no_farther_apart_than_the_resolution(
    far, resolution, monkeypatch
):
    space, tested, free = space_of(), [], FreeSpace.free
    monkeypatch.setattr(
        FreeSpace, "free", lambda *args, **stop: tested.append(args[1]) or free(*args, **stop)
    )
    start = np.array([-0.5, -0.5])
    end = start + np.array([far, far / 3])
    planner = PathPlanner(space, STEP, 0, resolution=resolution)
    assert planner.plan_straight(start, end[None]) is not None
    assert tested[-1][[0, -1]] == pytest.approx(np.array([end, start]))
    assert np.abs(np.diff(tested[-1], axis=0)).max() <= resolution + 1e-12


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

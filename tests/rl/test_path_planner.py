"""The planner of paths, and the scripted controllers of push and of articulated objects."""

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.goal_sets import draw_spec
from helpers.scenes import PYBULLET, ball, reset_envs, robot
from morphgen.grammar.library import default_library
from morphgen.model.geometry import Box, Pose, Shape
from morphgen.model.kinematics import joint_limits
from morphgen.model.kinematics_torch import frame_pose, frame_positions
from morphgen.model.robot import Joint, Link
from morphgen.rl.baselines import baselines_for, path_planner
from morphgen.rl.baselines import scripted_push as pushing
from morphgen.rl.baselines.path_planner import PathCost, PathFollower, PathPlanner
from morphgen.rl.baselines.path_push import PathPush
from morphgen.rl.baselines.reach import GAIN, InverseKinematics, JacobianColumns
from morphgen.rl.baselines.scripted_articulated import Scripted
from morphgen.rl.baselines.scripted_push import Push, PushPlanner, ScriptedPush, ToolKinematics
from morphgen.rl.inference import run_episodes
from morphgen.splits.split import read_split
from morphgen.tasks.actions import encode_actions
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.registry import SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig, member_spec
from morphgen.tasks.scenes.make import batch_from_specs, make_batch
from morphgen.tasks.scenes.robot_tables import build_robot_tables
from morphgen.tasks.sim.base import Block, Scene

STEP = np.array([0.02, 0.02])
FAR_AWAY = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
NO_DEADLINE = np.array([np.inf, np.inf])
X = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
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
    back = Block((0.1, 1.2, 0.4), Pose((0.5, 0.0, 0.2)))
    walls = (back, *(Block((1.0, 0.1, 0.4), Pose((0.0, y, 0.2))) for y in (0.6, -0.6)))
    planner, space = planner_of(*walls), space_of(*walls)
    start, goals = np.array([0.2, 0.0]), np.array([[0.5, 0.0], [1.0, 0.0]])
    assert planner.plan_straight(start, goals) is None
    path, _ = planner.plan_rrt(start, goals)
    assert path.goal == 1
    assert path.waypoints[-1].tolist() == [1.0, 0.0]
    assert_free(space, start, path)
    again, _ = planner.plan_rrt(start, goals)
    assert all((a == b).all() for a, b in zip(path.waypoints, again.waypoints, strict=True))
    (_, tree), (_, other) = (planner.plan_rrt(start, NO_GOALS, attempt=k) for k in (0, 1))
    assert not np.array_equal(tree.nodes, other.nodes)
    for unreachable in (goals[:1], NO_GOALS):
        path, tree = planner.plan_rrt(start, unreachable, iterations=50)
        assert path is None
        assert space.free(np.array(tree.nodes)).all()


def test_immovable_joints_keep_their_position():
    """A ball on slides along x and y, and a slide that does not move it."""
    slides, idle = ball(0.2), Joint("idle", "prismatic", "base", "idle", Pose(), (0, 0, 1), (-1, 1))
    links, joints = (*slides.links, Link("idle")), (*slides.joints, idle)
    slides = replace(slides, links=links, joints=joints, home=(0.0, 0.0, 0.0))
    wall = Block((0.2, 1.0, 0.4), Pose((0.0, -0.5, 0.2)))
    space = FreeSpace(Scene(slides, obstacles=(wall,)))
    planner = PathPlanner(space, np.full(3, 0.05), 0, np.array([True, True, False]))
    start, goals = np.array([-0.5, -0.5, 0.7]), np.array([[0.5, -0.5, 0.7]])
    path, tree = planner.plan_rrt(start, goals)
    assert len(path.waypoints) > 1
    assert {q[2] for q in (*path.waypoints, *tree.nodes)} == {0.7}
    assert_free(space, start, path)


def test_paths_along_a_tree_lead_to_goals_that_it_can_reach():
    """A wall without a gap hides the cheaper one of two goals, so the path leads to the other."""
    sizes = ((0.5, 4.5), (-0.3, 1.0))
    walls = [Block((0.1, width, 0.4), Pose((x, 0.0, 0.2))) for x, width in sizes]
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


REACH = ReachConfig(num_goals=10)
CLAW, CHAIN = "arm=arm3 ee=claw", "nlink"


@pytest.fixture
def made(tmp_path, opened):
    def make(words, n, **options):
        given = {"cache": tmp_path, "configs": (REACH,), "sim": "mujoco", **options}
        robots = [robot(each) for each in words.split(", ")]
        batch = opened(make_batch("reach", robots, n, **given))
        batch.reset()
        return batch

    return make


@pytest.mark.parametrize("kind", ["continuous", "discrete"])
def test_robots_pass_waypoints_that_the_smallest_bin_cannot_reach(made, kind):
    batch = made("prims", 1, kind=kind)
    follower = PathFollower(batch)
    start = batch.targets[0].numpy().astype(np.float64)
    low, high = joint_limits(batch.specs[0].robot).T
    waypoint, goal = 0.6 * start + 0.4 * low, 0.6 * start + 0.4 * high
    follower.follow(0, [waypoint, goal])
    for _ in range(200):
        finished = follower.advance()
        batch.step(encode_actions(path_planner.fractions_towards(batch, follower.waypoint), kind))
    assert finished.all()
    step = batch.robot_tables.max_step[0]
    assert ((batch.targets[0] - torch.from_numpy(goal)).abs() <= step / 16 + 1e-6).all()


def test_joints_of_two_turns_take_the_shorter_way(made, monkeypatch):
    batch = made("arm=ur5 ee=stick", 12)
    tables, steps, follow = batch.robot_tables, [], PathFollower.follow
    assert (tables.upper[0] - tables.lower[0])[tables.moves_tool[0]].max() > 4 * math.pi - 0.01
    half_turn = math.pi / tables.max_step[0][tables.moves_tool[0]].min()

    def record(follower, env, waypoints):
        if len(waypoints) == 1:  # a straight path
            change = torch.from_numpy(waypoints[0]) - batch.targets[env].double()
            steps.append((change / tables.max_step[0]).abs().max())
        follow(follower, env, waypoints)

    monkeypatch.setattr(PathFollower, "follow", record)
    InverseKinematics(0).act(batch)
    assert len(steps) > 6
    assert max(steps) <= half_turn + 1e-3


@pytest.mark.parametrize(
    ("words", "goal"), [(CLAW, "position"), (CHAIN, "position"), (CLAW, "pose"), ("prims", "pose")]
)
def test_goals_are_reached_also_by_robots_whose_links_obstruct_each_other(made, words, goal):
    batch = made(words, 8, configs=(replace(REACH, goal=goal),))
    episodes = run_episodes(batch, InverseKinematics(0), 1)
    assert sum(episode.success for episode in episodes) >= 7


def test_a_reach_episode_scores_the_mean_of_its_steps(made):
    batch, steps = made("prims", 1), []
    step = batch.step
    batch.step = lambda actions: steps.append(step(actions)) or steps[-1]
    (episode,) = run_episodes(batch, InverseKinematics(0), 1)
    found = [float(each.score[0]) for each in steps]
    assert episode.steps == len(found) == REACH.max_episode_steps
    assert episode.score == pytest.approx(np.mean(found), rel=1e-4)
    assert episode.score != pytest.approx(found[-1], rel=1e-4)


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
    assert baselines_for("push") == ("scripted", "path", "zero", "random")
    batch = made("prims, arm=ur5 ee=stick", 16)
    episodes = run_episodes(batch, JacobianColumns(), 1)
    success = [[e.success for e in episodes if e.robot_index == i] for i in range(2)]
    assert all(success[0])
    assert sum(success[1]) >= 5


def test_orientations_are_approached_where_goals_are_poses(made):
    """A ball on a gantry turns about two axes: each joint has a column of its own."""

    def successes(controller):
        batch = made("prims", 12, configs=(replace(REACH, goal="pose"),))
        return sum(episode.success for episode in run_episodes(batch, controller, 1))

    assert successes(JacobianColumns()) > successes(PositionOnly()) + 2


class PositionOnly(JacobianColumns):
    """Acts as if the goals of a batch were positions."""

    def act(self, task):
        envs = task.groups["reach"]
        envs.needs_tool_rotation = False
        actions = super().act(task)
        envs.needs_tool_rotation = True
        return actions


UR5, PANDA, PLANE = "arm=ur5 ee=plane", "arm=panda ee=panda_hand", "prims"


def push_planner_of(setting):
    tables = build_robot_tables([setting.robot])
    return PushPlanner(setting, setting.scene, tables, 0, np.random.default_rng(0))


PUSH = PushConfig(num_goals=8, train_layouts=2, eval_layouts=1)
FEW_REACH = ReachConfig(num_goals=4)


def test_a_plan_has_a_free_path_behind_the_block(tmp_path):
    setting = draw_spec(robot(PANDA), PUSH, obstacles=True, seed=0, cache=tmp_path)
    planner = push_planner_of(setting)
    space, tool = FreeSpace(setting.scene), ToolKinematics(build_robot_tables([setting.robot]), 0)
    for q, block in zip(setting.goals.q[:3], setting.goals.blocks, strict=False):
        (plan,) = planner.plan([Push(q, block)])
        points = [q, *plan.path]
        for a, b in pairwise(points):
            between = a + np.linspace(0, 1, 200)[:, None] * (b - a)
            assert space.free(between, np.tile(block, (200, 1))).mean() > 0.99
        position, rotation = (each[0] for each in tool.poses(points[-1][None]))
        assert position[1] < block[1] - setting.goals.block.size[1] / 2
        assert position[2] == pytest.approx(plan.height)
        assert plan.rotation.numpy() == pytest.approx(rotation, abs=1e-6)
    across = (setting.goals.line - block[1]) / pushing.SPEED
    hasty, late = (Push(q, block, steps_left=across + each) for each in (-1, 1))
    plans = planner.plan([hasty, late, Push(q, block)])
    assert [plan is None for plan in plans] == [True, False, False]
    assert np.array_equal(plans[2].path, planner.plan([Push(q, block)])[0].path)


@pytest.mark.slow
def test_obstructed_arms_push_below_the_middle(tmp_path):
    """Starts of YuMi without a straight path behind the block."""
    members = read_split("extrapolation/arms/push").train
    member = next(each for each in members if each.name == "yumi")
    setting = member_spec(replace(member, obstacles=False), default_library(()), cache=tmp_path)
    planner = push_planner_of(setting)
    space, edge = FreeSpace(setting.scene), setting.goals.block.size[0]
    for q, block in zip(setting.goals.q[3:5], setting.goals.blocks[3:5], strict=True):
        end = planner.plan([Push(q, block)])[0].path[-1]
        contacts = pushing.find_contacts(space, end[None], block[None], edge)
        centred = block[None] + contacts.offset[0] * X
        assert pushing.overhang(space, end[None], centred, edge)[0] < 0.05


def space_at_block(pusher):
    """Free space of a robot beside a block of 0.4 m."""
    return FreeSpace(Scene(pusher, object=Block((0.4, 0.4, 0.4)), ground=None))


def test_contacts_are_found_where_the_robot_touches_the_block():
    blocks = np.array([[0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]] * 3)
    q = np.array([[0.0, -0.5], [0.1, -0.5], [1.5, -0.5]])
    spaces = [space_at_block(ball(height)) for height in (0.2, 0.35)]
    low = pushing.find_contacts(spaces[0], q, blocks, 0.4)
    assert low.q.tolist() == q[:2].tolist()
    assert low.gap == pytest.approx(0.2, abs=0.002)
    assert low.offset == pytest.approx([0.0, 0.1], abs=0.05)
    assert low.width == pytest.approx(0.5, abs=0.12)
    assert pushing.overhang(spaces[0], q[:2], blocks[:2], 0.4).max() == 0
    assert pushing.overhang(spaces[1], q[:2], blocks[:2], 0.4).min() == pushing.MAX_OVERHANG


@pytest.mark.parametrize(("ahead", "over"), [(0.01, 0.025), (0.002, 0.005), (-0.01, 0.0)])
def test_the_overhang_of_a_brim_is_its_lead(ahead, over):
    """A box that touches the block below its middle, and a brim at its upper edge."""
    foot = Shape(Box((0.2, 0.1, 0.1)))
    brim = Shape(Box((0.2, 0.1, 0.02)), Pose((0.0, ahead, 0.3)))
    space = space_at_block(ball(0.1).with_links([Link("ball", collisions=(foot, brim))]))
    q = np.array([[0.0, -0.5]] * 2)
    blocks = np.array([[x, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0] for x in (0.0, 3.0)])
    found = pushing.find_contacts(space, q, blocks, 0.4)
    assert found.row.tolist() == [0]
    assert found.gap[0] == pytest.approx(0.25 - max(ahead, 0), abs=0.002)
    assert pushing.overhang(space, q, blocks, 0.4) == pytest.approx([over, 0], abs=0.0035)


@pytest.fixture
def batch(tmp_path, opened):
    def make(words, n, task="push", sim="mujoco", **options):
        given = {"cache": tmp_path, "configs": (FEW_REACH, PUSH), "sim": sim, **options}
        return opened(make_batch(task, [robot(each) for each in words], n, **given))

    return make


@pytest.mark.slow
@pytest.mark.parametrize("sim", [PYBULLET, "mujoco"])
@pytest.mark.parametrize("words", [UR5, PANDA, PLANE])
def test_four_of_five_blocks_cross_the_line(words, sim, batch):
    episodes = run_episodes(batch([words], 20, sim=sim), ScriptedPush(0), 1)
    assert sum(each.success for each in episodes) >= 16


@pytest.mark.slow
def test_actions_may_be_discrete(batch):
    episodes = run_episodes(batch([PLANE], 3, kind="discrete"), ScriptedPush(0), 1)
    assert sum(each.success for each in episodes) >= 2


@pytest.mark.slow
def test_the_seed_determines_the_actions(batch):
    def actions(seed):
        task, controller = batch([UR5], 2), ScriptedPush(seed)
        task.reset()
        found = []
        for _ in range(30):
            found.append(controller.act(task))
            task.step(found[-1])
        return torch.stack(found)

    assert torch.equal(actions(0), actions(0))
    assert not torch.equal(actions(0), actions(1))


def test_actions_are_in_range_and_reach_robots_do_not_move(batch):
    task, controller = batch([UR5, PLANE], 4, task=["reach", "push"]), ScriptedPush(0)
    task.reset()
    moved = torch.zeros(4, dtype=torch.bool)
    for _ in range(60):
        actions = controller.act(task)
        assert actions.abs().max() <= 1
        moved |= actions.abs().amax(dim=1) > 0
        task.step(actions)
    assert moved.tolist() == [False, True, False, True]


def test_a_block_that_slips_away_is_replanned(batch, monkeypatch):
    made = []
    plan = PushPlanner.plan

    def counted(self, pushes):
        made.extend(pushes)
        return plan(self, pushes)

    monkeypatch.setattr(PushPlanner, "plan", counted)
    task, controller = batch([PLANE], 1), ScriptedPush(0)
    task.reset()
    for i in range(PUSH.max_episode_steps):
        if i % 60 == 59:
            away = task.simulation.object_pose.clone()
            away[0, 0] = -away[0, 0] + (0.15 if away[0, 0] < 0 else -0.15)
            away[0, 1] = -0.2
            reset_envs(task.simulation, [0], task.simulation.q.clone(), away)
            task.targets[:] = task.q
        if task.step(controller.act(task)).terminated.any():
            break
    assert 2 <= len(made) <= pushing.MAX_PLANS
    assert not np.allclose(made[0].block, made[1].block)
    left = [push.steps_left for push in made]
    assert left[0] == PUSH.max_episode_steps
    assert left == sorted(left, reverse=True)
    assert left[1] <= PUSH.max_episode_steps - 59


@pytest.mark.parametrize("free", [True, False])
def test_a_tool_rises_when_its_arm_collides(free, batch, monkeypatch):
    def said(self, q):
        assert q.ndim == 2
        return np.full(len(q), free)

    monkeypatch.setattr(PushPlanner, "free", said)
    task, controller = batch([PLANE], 1), ScriptedPush(0)
    task.reset()
    heights = []
    while len(heights) < 12:
        acting = controller.act(task)
        if controller.pushing[0]:
            robots, targets = task.env_robot_index, task.targets
            tools = frame_positions(task.robot_tables.tool_chain, robots, targets)
            heights.append(float(tools[0, 2]))
        assert not task.step(acting).terminated.any()
    rise = 0.0 if free else pushing.RISE
    assert np.diff(heights[1:]) == pytest.approx(rise, abs=pushing.RISE / 3)


OBJECTS = ("drawer", "door", "dial")
WITH_REACH = (*OBJECTS, "reach")
EPISODES = 4  # of a task


def batch_of_objects(cache, sim):
    """Make environments of an arm at the tasks, and begin episodes that no success ends."""
    configs = [TASKS[task].config_type(num_goals=EPISODES) for task in WITH_REACH]
    n, options = len(WITH_REACH), {"sim": sim, "configs": configs, "cache": cache}
    made = make_batch(WITH_REACH, [robot("arm3-stick")] * n, EPISODES * n, **options)
    made.reset()
    for name in OBJECTS:
        made.groups[name].formulas.travel.fill_(100.0)
    return made


def positions(task):
    """Return the positions of the objects' joints, and how far they are from their goals."""
    return task.observe()["object_joint"][:, 7:].clone().unbind(1)


@dataclass
class Recording:
    """Actions in MuJoCo, (T, n, L), and the objects' joints when they pass their goals."""

    actions: torch.Tensor
    steps: torch.Tensor  # until then, shape (n,); -1: never
    positions: torch.Tensor  # shape (n,) [rad or m]
    travels: torch.Tensor


@pytest.fixture(scope="module")
def recorded(cache):
    """Episodes of the controller."""
    task, controller = batch_of_objects(cache, "mujoco"), Scripted(0)
    _, to_go = positions(task)
    steps = torch.where(task.task_mask("reach"), 0, -1)
    ends, actions = torch.zeros_like(to_go), []
    while (steps < 0).any() and len(actions) < 299:
        actions.append(torch.where(steps[:, None] < 1, controller.act(task), 0.0))
        task.step(actions[-1])
        now, left = positions(task)
        over = (steps < 0) & (left * to_go.sign() < 0)
        steps = torch.where(over, len(actions), steps)
        ends = torch.where(over, now, ends)
    task.close()
    return Recording(torch.stack(actions), steps, ends, to_go.abs())


def test_episodes_succeed_and_other_tasks_stand_still(recorded):
    actions = recorded.actions.view(-1, EPISODES, len(WITH_REACH), recorded.actions.shape[2])
    assert (recorded.steps >= 0).all()
    assert recorded.steps.max() < 200
    assert actions.abs().max() <= 1
    assert actions[:, :, :-1].any(dim=3).any(dim=0).all()
    assert not actions[:, :, -1].any()


@pytest.mark.parametrize(
    ("task", "name"),
    [
        # The plate need not turn with the dial, which then moves less than the tool.
        ("dial", "plane-000001"),
        # A slide of the gantry takes a thin stick through the tray's front between coarse tests.
        ("drawer", "cylinder-000003"),
    ],
)
def test_gantries_with_large_and_thin_tools_succeed(task, name, opened):
    members = read_split(f"composition/ee-arm/{task}").side("train")
    member = next(member for member in members if member.name == name)
    spec = member_spec(member, default_library(), GoalConfig())
    task_batch = opened(batch_from_specs([spec], EPISODES, layouts="eval"))
    assert all(episode.success for episode in run_episodes(task_batch, Scripted(0), 1))


@pytest.mark.parametrize("task", ["push", *OBJECTS])
def test_the_path_behind_an_object_leads_on_along_its_motion(task, cache, opened):
    config = TASKS[task].config_type(num_goals=EPISODES)
    made = make_batch((task,), [robot("arm3-stick")], EPISODES, configs=[config], cache=cache)
    episodes = run_episodes(opened(made), PathPush(0), 1)
    assert [each.success for each in episodes].count(True) >= EPISODES - 1


@pytest.mark.slow
@pytest.mark.parametrize("sim", [PYBULLET, "warp"])
def test_the_same_actions_move_objects_as_far_in_other_simulators(
    sim, recorded, cache, monkeypatch
):
    on_cpu = replace(SIMULATORS[sim], devices=("cpu",))  # on which Warp is slow, but works
    monkeypatch.setitem(SIMULATORS._loaded, sim, on_cpu)
    task = batch_of_objects(cache, sim)
    ends = torch.zeros_like(recorded.positions)
    for step, action in enumerate(recorded.actions, start=1):
        task.step(action)
        ends = torch.where(recorded.steps == step, positions(task)[0], ends)
    task.close()
    apart = (ends - recorded.positions).abs()
    assert (apart <= 0.05 * recorded.travels).all(), apart / recorded.travels

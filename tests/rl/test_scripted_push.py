"""The scripted push: it plans where nothing is in its way, and blocks get across."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from morphgen.benchmark.split_file import read_split
from morphgen.grammar.library import default_library
from morphgen.model.geometry import Box, Pose, Shape, Sphere
from morphgen.model.kinematics import bounds, forward_kinematics, random_configurations
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.rl import push_plans
from morphgen.rl.cartesian import OneTool, towards
from morphgen.rl.free_ways import FreeWays, Price, whole_turns
from morphgen.rl.push_contacts import leaning, poised
from morphgen.rl.push_plans import SPEED, PushPlanner
from morphgen.rl.scripted_push import PLANS, RISE, ScriptedPush
from morphgen.tasks.bodies import bodies_of
from morphgen.tasks.config import PushConfig, ReachConfig
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.kinematics import tool_frames, tool_positions
from morphgen.tasks.make import make_batch
from morphgen.tasks.settings import member_setting, push_setting, reach_setting
from morphgen.tasks.sim.base import Block, Scene
from scenes import robot

NO_HURRY = np.array([np.inf, np.inf])
UR5, PANDA, PLANE = "arm=ur5 ee=plane", "arm=panda ee=panda_hand", "prims"
PUSH, REACH = PushConfig(starts=8), ReachConfig(goals=4)


def batch(words, n, cache, task="push", **options):
    robots = [robot(each) for each in words]
    return make_batch(task, robots, n, cache=cache, push=PUSH, reach=REACH, **options)


def successes(task, controller, steps=PUSH.steps):
    """Which of the first episodes end with the block across, shape (n,), bool."""
    task.reset()
    over = torch.zeros(task.num_envs, dtype=torch.bool)
    across = over.clone()
    for _ in range(steps):
        step = task.step(controller.act(task))
        across |= step.success & ~over
        over |= step.terminated | step.truncated
        if over.all():
            break
    task.close()
    return across


@pytest.mark.slow
@pytest.mark.parametrize("sim", ["pybullet", "mujoco"])
def test_blocks_get_across(sim, tmp_path):
    across = successes(batch([PLANE, UR5], 6, tmp_path, sim=sim), ScriptedPush(0))
    assert across[::2].sum() >= 2
    assert across[1::2].sum() >= 2


@pytest.mark.slow
@pytest.mark.parametrize("sim", ["pybullet", "mujoco"])
@pytest.mark.parametrize("words", [UR5, PANDA, PLANE])
def test_four_of_five_blocks_get_across(words, sim, tmp_path):
    across = successes(batch([words], 20, tmp_path, sim=sim), ScriptedPush(0))
    assert across.float().mean() >= 0.8


def test_actions_may_be_discrete(tmp_path):
    task = batch([PLANE], 3, tmp_path, sim="mujoco", kind="discrete")
    assert successes(task, ScriptedPush(0)).sum() >= 2


def test_the_same_seed_does_the_same(tmp_path):
    def actions(seed):
        task, controller = batch([UR5], 2, tmp_path, sim="mujoco"), ScriptedPush(seed)
        task.reset()
        found = []
        for _ in range(30):
            found.append(controller.act(task))
            task.step(found[-1])
        task.close()
        return torch.stack(found)

    assert torch.equal(actions(0), actions(0))
    assert not torch.equal(actions(0), actions(1))


def test_actions_are_in_range_and_reaching_robots_stand_still(tmp_path):
    task = batch([UR5, PLANE], 4, tmp_path, task=["reach", "push"], sim="mujoco")
    controller = ScriptedPush(0)
    task.reset()
    moved = torch.zeros(4, dtype=torch.bool)
    for _ in range(60):
        actions = controller.act(task)
        assert actions.abs().max() <= 1
        moved |= actions.abs().amax(dim=1) > 0
        task.step(actions)
    task.close()
    assert moved.tolist() == [False, True, False, True]


def test_a_block_that_slips_away_is_planned_for_again(tmp_path, monkeypatch):
    made = []
    plan = PushPlanner.plan

    def counted(self, *args):
        made.append(args)
        return plan(self, *args)

    monkeypatch.setattr(PushPlanner, "plan", counted)
    task, controller = batch([PLANE], 1, tmp_path, sim="mujoco"), ScriptedPush(0)
    task.reset()
    env = torch.tensor([0])
    for i in range(PUSH.steps):
        if i % 60 == 59:
            away = task.simulation.block_pose.clone()
            away[0, 0] = -away[0, 0] + (0.15 if away[0, 0] < 0 else -0.15)
            away[0, 1] = -0.2
            task.simulation.reset(env, task.simulation.q.clone(), away)
            task.targets[:] = task.q
        if task.step(controller.act(task)).terminated.any():
            break
    task.close()
    assert 2 <= len(made) <= PLANS
    assert not np.allclose(made[0][1], made[1][1])
    left = [args[3] for args in made]
    assert left[0] == PUSH.steps
    assert left == sorted(left, reverse=True)
    assert left[1] <= PUSH.steps - 59


@pytest.mark.parametrize("free", [True, False])
def test_a_tool_whose_arm_gets_into_something_rises(free, tmp_path, monkeypatch):
    def said(self, q):
        assert q.ndim == 2
        return np.full(len(q), free)

    monkeypatch.setattr(PushPlanner, "free", said)
    task, controller = batch([PLANE], 1, tmp_path, sim="mujoco"), ScriptedPush(0)
    task.reset()
    heights = []
    while len(heights) < 12:
        acting = controller.act(task)
        if controller._state.pushing[0]:
            heights.append(float(tool_positions(task.bodies.chain, task.body, task.targets)[0, 2]))
        assert not task.step(acting).terminated.any()
    task.close()
    rise = 0.0 if free else RISE
    assert np.diff(heights[1:]) == pytest.approx(rise, abs=RISE / 3)


def test_a_plan_goes_behind_the_block_by_a_free_way(tmp_path):
    setting = push_setting(robot(PANDA), PUSH, obstacles=True, seed=0, cache=tmp_path)
    planner = PushPlanner(setting, bodies_of([setting.robot]), 0, np.random.default_rng(0))
    space, tool = FreeSpace(setting.scene), OneTool(bodies_of([setting.robot]), 0)
    for q, block in zip(setting.pushes.q[:3], setting.pushes.blocks, strict=False):
        plan = planner.plan(q, block)
        points = [q, *plan.way]
        for a, b in pairwise(points):
            between = a + np.linspace(0, 1, 200)[:, None] * (b - a)
            assert space.free(between, np.tile(block, (200, 1))).mean() > 0.99
        position, rotation = (each[0] for each in tool.poses(points[-1][None]))
        assert position[1] < block[1] - setting.pushes.block.size[1] / 2
        assert position[2] == pytest.approx(plan.height)
        assert plan.rotation.numpy() == pytest.approx(rotation, abs=1e-6)
    across = (setting.pushes.line - block[1]) / SPEED
    assert planner.plan(q, block, left=across + 1) is not None
    assert planner.plan(q, block, left=across - 1) is None


def test_a_plan_does_not_come_to_lean_over_the_block(tmp_path, monkeypatch):
    """Configurations near the first plan's last one are said to, on the way of the push."""
    setting = push_setting(robot(PANDA), PUSH, obstacles=False, seed=0, cache=tmp_path)
    planner = PushPlanner(setting, bodies_of([setting.robot]), 0, np.random.default_rng(0))
    q, block = setting.pushes.q[0], setting.pushes.blocks[0]
    first = planner.plan(q, block).way[-1]

    def near(configurations):
        return np.abs(configurations - first).max(axis=-1) < 1.0

    def said(space, configurations, blocks, edge):
        assert blocks.shape == (len(configurations), 7)
        assert (blocks[:, 1] > block[1]).all()
        return near(configurations).astype(float)

    monkeypatch.setattr(push_plans, "leaning", said)
    assert near(first)
    assert not near(planner.plan(q, block).way[-1])


def test_a_setting_of_another_task_is_refused(tmp_path):
    setting = reach_setting(robot(PLANE), REACH, obstacles=False, seed=0, cache=tmp_path)
    with pytest.raises(ValueError, match="does not push"):
        PushPlanner(setting, bodies_of([setting.robot]), 0, np.random.default_rng(0))


def test_tools_are_moved_first_and_turned_with_what_is_left():
    bodies = bodies_of([robot(PANDA), robot(PLANE), robot("nlink")])
    body = torch.arange(3)
    q = bodies.home + 0.2 * (bodies.upper - bodies.home).clamp(max=1.0)
    T = tool_frames(bodies.chain, body, q)[:, -1]
    goal = T[:, :3, 3] + torch.tensor([[0.0, 0.05, 0.02], [0.0, 0.05, -0.02], [-0.05, 0.05, 0.0]])
    turned = T[:, :3, :3]
    for _ in range(30):
        q = towards(bodies, body, q, goal, turned)
    found = tool_frames(bodies.chain, body, q)[:, -1]
    assert (found[:, :3, 3] - goal).abs().max() < 5e-3
    off = (found[:, :3, :3] - turned).abs().amax(dim=(1, 2))
    assert off[:2].max() < 0.02
    assert off[2] > 0.1, "two hinges have nothing left"


def test_joints_at_their_limits_leave_it_to_the_others():
    bodies = bodies_of([robot(UR5)])
    body, q = torch.tensor([0]), bodies.home.clone()
    T = tool_frames(bodies.chain, body, q)[:, -1]
    for _ in range(100):
        q = towards(bodies, body, q, T[:, :3, 3] + 9.0, T[:, :3, :3])
        assert (q >= bodies.lower).all()
        assert (q <= bodies.upper).all()


def test_who_is_in_haste_turns_no_farther_than_joints_get_in_a_step():
    bodies = bodies_of([robot(PANDA)])
    body, q = torch.tensor([0]), bodies.home.clone()
    T = tool_frames(bodies.chain, body, q)[:, -1]
    goal = T[:, :3, 3] + torch.tensor([[0.0, 0.004, 0.0]])
    quarter = torch.tensor([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    turned = quarter @ T[:, :3, :3]
    slow = towards(bodies, body, q, goal, turned) - q
    fast = towards(bodies, body, q, goal, turned, hasty=True) - q
    assert (slow.abs() > bodies.step).any()
    assert (fast.abs() <= bodies.step).all()
    moved = tool_frames(bodies.chain, body, q + fast)[0, -1, :3, 3]
    assert moved.numpy() == pytest.approx(goal[0].numpy(), abs=5e-4)
    near = T[:, :3, :3]
    both = [towards(bodies, body, q, goal, near, hasty=hasty) for hasty in (False, True)]
    assert torch.equal(*both), "where all joints are fast enough nothing is given up"


def ball(height):
    """A ball of 0.1 m on slides along x and y."""
    base, cart, last = Link("base"), Link("cart"), Link("ball", collisions=(Shape(Sphere(0.1)),))
    joints = (
        Joint("x", "prismatic", "base", "cart", Pose((0, 0, height)), (1, 0, 0), (-2.0, 2.0)),
        Joint("y", "prismatic", "cart", "ball", Pose(), (0, 1, 0), (-2.0, 2.0)),
    )
    return Robot("ball", (base, cart, last), joints, (Frame("tool", "ball"),), (0.0, 0.0))


def test_contacts_are_where_the_block_would_be_touched():
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    q = np.array([[0.0, -0.5], [0.1, -0.5], [1.5, -0.5]])

    def found(height):
        scene = Scene(ball(height), block=Block((0.4, 0.4, 0.4)), ground=None)
        return poised(FreeSpace(scene), q, block, 0.4)

    low = found(0.2)
    assert low.q.tolist() == q[:2].tolist()
    assert low.gap == pytest.approx(0.2, abs=0.002)
    assert low.middle == pytest.approx([0.0, 0.1], abs=0.05)
    assert low.width == pytest.approx(0.5, abs=0.12)
    assert low.over.max() == 0
    assert found(0.35).over.min() > 0.5


@pytest.mark.parametrize(("ahead", "over"), [(0.01, 0.025), (0.002, 0.005), (-0.01, 0.0)])
def test_a_brim_that_is_ahead_leans_over_the_block_by_as_much(ahead, over):
    """A box that touches the block below its middle, and a brim at its upper edge."""
    foot = Shape(Box((0.2, 0.1, 0.1)))
    brim = Shape(Box((0.2, 0.1, 0.02)), Pose((0.0, ahead, 0.3)))
    wide = ball(0.1).with_links([Link("ball", collisions=(foot, brim))])
    scene = Scene(wide, block=Block((0.4, 0.4, 0.4)), ground=None)
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    found = poised(FreeSpace(scene), np.array([[0.0, -0.5]]), block, 0.4)
    assert found.gap[0] == pytest.approx(0.25 - max(ahead, 0), abs=0.002)
    assert found.over[0] == pytest.approx(over, abs=0.0035)

    beyond = np.array([[0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]])
    each = leaning(FreeSpace(scene), np.array([[0.0, -0.5]] * 2), beyond, 0.4)
    assert each[0] == found.over[0]
    assert each[1] == 0


def test_ways_go_round_what_is_in_between():
    wall = Block((0.2, 2.0, 0.4), Pose((0.0, -1.0, 0.2)))
    scene = Scene(ball(0.2), block=Block((0.1, 0.1, 0.1)), obstacles=(wall,))
    space, step = FreeSpace(scene), np.array([0.02, 0.02])
    ways = FreeWays(space, step, np.random.default_rng(0))
    start, ends = np.array([-0.5, -0.5]), np.array([[0.5, -0.5], [-0.5, 0.5]])
    block = np.array([1.5, 1.5, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert ways.steps(start, ends) == pytest.approx([50, 50])
    nearest = ways.find(start, ends, block=block)
    assert nearest.end == 1
    assert len(nearest.points) == 1
    over = ways.find(start, ends[:1], vias=np.array([[0.5, 0.5]]), block=block)
    assert over.end == 0
    assert len(over.points) >= 2
    for a, b in zip((start, *over.points), over.points, strict=False):
        between = a + np.linspace(0, 1, 99)[:, None] * (b - a)
        assert space.free(between).all()
    inside = np.array([[0.0, -0.5]])
    assert ways.find(start, inside, block=block) is None
    on_the_end = np.array([-0.5, 0.5, 0.1, 1.0, 0.0, 0.0, 0.0])
    assert ways.find(start, ends[1:], block=on_the_end) is None
    assert ways.find(start, ends[1:]).points[-1].tolist() == ends[1].tolist()


def test_ends_are_those_that_turn_least():
    body = robot(UR5)
    ways = FreeWays(FreeSpace(Scene(body)), np.full(6, 0.1), np.random.default_rng(0))
    rng = np.random.default_rng(0)
    start, ends = rng.uniform(-6, 6, 6), random_configurations(body, 200, rng)
    found = ways.unwound(start, ends)
    assert forward_kinematics(body, found) == pytest.approx(forward_kinematics(body, ends))
    lower, upper = bounds(body).T
    assert (lower <= found).all()
    assert (found <= upper).all()
    apart = np.abs(found - start)
    assert (apart <= np.abs(ends - start) + 1e-9).all()
    others = [found + turn for turn in (-2 * np.pi, 2 * np.pi)]
    nearer = [
        (np.abs(each - start) < apart - 1e-9) & (lower <= each) & (each <= upper) for each in others
    ]
    assert not np.any(nearer)
    assert (apart < np.abs(ends - start) - 6).any()


def test_a_joint_that_another_follows_is_not_turned_back():
    turns = whole_turns(robot(PANDA))
    assert turns.tolist() == [True] * 7 + [False]


def test_a_plate_touches_on_its_whole_breadth():
    plate = Link("ball", collisions=(Shape(Box((0.8, 0.02, 0.3))),))
    wide = ball(0.2).with_links([plate])
    scene = Scene(wide, block=Block((0.4, 0.4, 0.4)), ground=None)
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    found = poised(FreeSpace(scene), np.array([[0.0, -0.5]]), block, 0.4)
    assert found.width[0] == 1


def test_a_way_round_about_is_found_where_no_simple_one_is():
    """Out of a pocket that is open to the other side, to the nearer of two ends that is free."""
    walls = (
        Block((0.1, 1.2, 0.4), Pose((0.5, 0.0, 0.2))),
        Block((1.0, 0.1, 0.4), Pose((0.0, 0.6, 0.2))),
        Block((1.0, 0.1, 0.4), Pose((0.0, -0.6, 0.2))),
    )
    scene = Scene(ball(0.2), block=Block((0.1, 0.1, 0.1)), obstacles=walls)
    space = FreeSpace(scene)
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    start, ends = np.array([0.2, 0.0]), np.array([[0.5, 0.0], [1.0, 0.0]])
    found = ways.find_round_about(start, ends)
    assert found.end == 1
    assert found.points[-1].tolist() == [1.0, 0.0]
    for a, b in pairwise((start, *found.points)):
        assert space.free(a + np.linspace(0, 1, 199)[:, None] * (b - a)).all()
    again = ways.find_round_about(start, ends)
    assert all((a == b).all() for a, b in zip(found.points, again.points, strict=True))
    assert ways.find_round_about(start, ends[:1]) is None
    assert ways.find_round_about(start, ends[:0]) is None


def test_ends_are_got_to_along_a_tree_if_it_grows_there():
    """Of two ends the cheaper is behind a wall without a gap."""
    walls = (
        Block((0.1, 4.5, 0.4), Pose((0.5, 0.0, 0.2))),
        Block((0.1, 1.0, 0.4), Pose((-0.3, 0.0, 0.2))),
    )
    scene = Scene(ball(0.2), block=Block((0.1, 0.1, 0.1)), obstacles=walls)
    space = FreeSpace(scene)
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    block = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
    start, ends = np.array([0.0, 0.0]), np.array([[1.0, 0.0], [-1.0, 0.0]])
    tree = ways.explored(start, 400, block=block)
    assert max(q[0] for q in tree.nodes) < 0.5
    price = Price(np.array([0.0, 500.0]), NO_HURRY)
    found = ways.find_along(tree, ends, vias=ends, price=price, block=block)
    assert found.end == 1
    assert found.points[-1].tolist() == [-1.0, 0.0]
    for a, b in pairwise((start, *found.points)):
        assert space.free(a + np.linspace(0, 1, 199)[:, None] * (b - a)).mean() > 0.95
    assert ways.length(start, found) >= 50
    one = Price(np.zeros(1), NO_HURRY[:1])
    assert ways.find_along(tree, ends[:1], vias=ends, price=one, block=block) is None
    none = np.zeros((0, 2))
    nothing = Price(np.zeros(0), np.zeros(0))
    assert ways.find_along(tree, none, vias=none, price=nothing, block=block) is None


def test_of_the_ways_along_a_tree_it_is_the_one_that_costs_least():
    """Not the one to the end that costs least itself, which is far."""
    space = FreeSpace(Scene(ball(0.2), block=Block((0.1, 0.1, 0.1))))
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    block = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
    tree = ways.explored(np.array([0.0, 0.0]), 400, block=block)
    ends, costs = np.array([[1.8, 1.8], [0.3, 0.0]]), np.array([0.0, 40.0])

    def end(costs, left):
        return ways.find_along(tree, ends, vias=ends, price=Price(costs, left), block=block).end

    assert end(costs, NO_HURRY) == 1
    assert end(3 * costs, NO_HURRY) == 0
    assert end(3 * costs, np.array([70.0, 70.0])) == 1, "the other is too far for what is left"


def test_ways_that_take_longer_than_there_is_time_come_last():
    space = FreeSpace(Scene(ball(0.2), block=Block((0.1, 0.1, 0.1))))
    ways = FreeWays(space, np.array([0.02, 0.02]), np.random.default_rng(0))
    block = np.array([0.0, 0.0, 5.0, 1.0, 0.0, 0.0, 0.0])
    start, ends = np.array([0.0, 0.0]), np.array([[1.0, 0.0], [0.3, 0.0]])

    def end(left):
        price = Price(np.array([0.0, 100.0]), np.array(left))
        return ways.find(start, ends, price=price, block=block).end

    assert end([np.inf, np.inf]) == 0
    assert end([51.0, 0.0]) == 0
    assert end([40.0, 40.0]) == 1
    assert end([-30.0, -30.0]) == 0, "both are far too late"


@pytest.mark.slow
def test_arms_in_each_others_way_push_below_the_middle(tmp_path):
    """Starts of YuMi from which no simple way leads behind the block."""
    members = read_split("extrapolation/arms/push").train
    member = next(each for each in members if each.name == "yumi")
    setting = member_setting(replace(member, obstacles=False), default_library(()), cache=tmp_path)
    bodies = bodies_of([setting.robot])
    planner = PushPlanner(setting, bodies, 0, np.random.default_rng(0))
    space, edge = FreeSpace(setting.scene), setting.pushes.block.size[0]
    over = []
    for i in (3, 4, 29, 31, 36, 39):
        plan = planner.plan(setting.pushes.q[i], setting.pushes.blocks[i])
        if plan is not None:
            block = setting.pushes.blocks[i]
            over += poised(space, plan.way[-1][None], block, edge).over.tolist()
    assert (np.array(over) < 0.05).sum() >= 5

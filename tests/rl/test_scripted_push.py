"""The scripted push: its plans, its contacts with the block, and episodes of it."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from helpers.goal_sets import draw_spec
from helpers.resets import reset_envs
from helpers.scenes import ball, robot
from helpers.simulators import PYBULLET
from morphgen.grammar.library import default_library
from morphgen.model.geometry import Box, Pose, Shape
from morphgen.model.kinematics_torch import frame_positions
from morphgen.model.robot import Link
from morphgen.rl.baselines import scripted_push
from morphgen.rl.baselines.scripted_push import (
    MAX_PLANS,
    RISE,
    SPEED,
    PushPlanner,
    ScriptedPush,
    ToolKinematics,
    find_contacts,
    overhang,
)
from morphgen.splits.split_file import read_split
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.env_specs import member_spec
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.scenes.robot_tables import build_robot_tables
from morphgen.tasks.sim.base import Block, Scene

UR5, PANDA, PLANE = "arm=ur5 ee=plane", "arm=panda ee=panda_hand", "prims"


def planner_of(setting):
    tables = build_robot_tables([setting.robot])
    return PushPlanner(setting, setting.scene, tables, 0, np.random.default_rng(0))


PUSH, REACH = PushConfig(num_goals=8), ReachConfig(num_goals=4)


def test_a_plan_has_a_free_path_behind_the_block(tmp_path):
    setting = draw_spec(robot(PANDA), PUSH, obstacles=True, seed=0, cache=tmp_path)
    planner = planner_of(setting)
    space, tool = FreeSpace(setting.scene), ToolKinematics(build_robot_tables([setting.robot]), 0)
    for q, block in zip(setting.goals.q[:3], setting.goals.blocks, strict=False):
        plan = planner.plan(q, block)
        points = [q, *plan.path]
        for a, b in pairwise(points):
            between = a + np.linspace(0, 1, 200)[:, None] * (b - a)
            assert space.free(between, np.tile(block, (200, 1))).mean() > 0.99
        position, rotation = (each[0] for each in tool.poses(points[-1][None]))
        assert position[1] < block[1] - setting.goals.block.size[1] / 2
        assert position[2] == pytest.approx(plan.height)
        assert plan.rotation.numpy() == pytest.approx(rotation, abs=1e-6)
    across = (setting.goals.line - block[1]) / SPEED
    assert planner.plan(q, block, steps_left=across + 1) is not None
    assert planner.plan(q, block, steps_left=across - 1) is None


def test_a_plan_avoids_overhang(tmp_path, monkeypatch):
    """A patched overhang penalises configurations near the end of the first plan."""
    setting = draw_spec(robot(PLANE), PUSH, obstacles=False, seed=0, cache=tmp_path)
    planner = planner_of(setting)
    q, block = setting.goals.q[0], setting.goals.blocks[0]
    first = planner.plan(q, block).path[-1]

    def near(configurations):
        return np.abs(configurations - first).max(axis=-1) < 1.0

    def said(space, configurations, blocks, edge):
        assert blocks.shape == (len(configurations), 7)
        assert (blocks[:, 1] >= block[1]).all()
        return near(configurations).astype(float)

    monkeypatch.setattr(scripted_push, "overhang", said)
    assert near(first)
    assert not near(planner.plan(q, block).path[-1])


def test_the_planner_rejects_other_tasks(tmp_path):
    setting = draw_spec(robot(PLANE), REACH, obstacles=False, seed=0, cache=tmp_path)
    with pytest.raises(ValueError, match="does not push"):
        planner_of(setting)


@pytest.mark.slow
def test_obstructed_arms_push_below_the_middle(tmp_path):
    """Starts of YuMi without a straight path behind the block."""
    members = read_split("extrapolation/arms/push").train
    member = next(each for each in members if each.name == "yumi")
    setting = member_spec(replace(member, obstacles=False), default_library(()), cache=tmp_path)
    planner = planner_of(setting)
    space, edge = FreeSpace(setting.scene), setting.goals.block.size[0]
    for q, block in zip(setting.goals.q[3:5], setting.goals.blocks[3:5], strict=True):
        end = planner.plan(q, block).path[-1]
        assert find_contacts(space, end[None], block, edge).overhang[0] < 0.05


def test_the_tool_can_turn_around():
    tables = build_robot_tables([robot(PANDA)])
    tool, q = ToolKinematics(tables, 0), np.array([tables.robots[0].home])
    position, rotation = tool.poses(q)
    turned = rotation @ np.diag([-1.0, -1.0, 1.0])
    reached = tool.poses(tool.move_towards(q, position, turned, 60))
    assert np.abs(reached[0] - position).max() < 5e-3
    assert np.abs(reached[1] - turned).max() < 0.02


def test_contacts_are_found_where_the_robot_touches_the_block():
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    q = np.array([[0.0, -0.5], [0.1, -0.5], [1.5, -0.5]])

    def found(height):
        scene = Scene(ball(height), object=Block((0.4, 0.4, 0.4)), ground=None)
        return find_contacts(FreeSpace(scene), q, block, 0.4)

    low = found(0.2)
    assert low.q.tolist() == q[:2].tolist()
    assert low.gap == pytest.approx(0.2, abs=0.002)
    assert low.offset == pytest.approx([0.0, 0.1], abs=0.05)
    assert low.width == pytest.approx(0.5, abs=0.12)
    assert low.overhang.max() == 0
    assert found(0.35).overhang.min() > 0.5


def test_the_contact_of_a_plate_is_as_wide_as_the_plate():
    plate = Link("ball", collisions=(Shape(Box((0.8, 0.02, 0.3))),))
    wide = ball(0.2).with_links([plate])
    scene = Scene(wide, object=Block((0.4, 0.4, 0.4)), ground=None)
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    found = find_contacts(FreeSpace(scene), np.array([[0.0, -0.5]]), block, 0.4)
    assert found.width[0] == 1


@pytest.mark.parametrize(("ahead", "over"), [(0.01, 0.025), (0.002, 0.005), (-0.01, 0.0)])
def test_the_overhang_of_a_brim_is_its_lead(ahead, over):
    """A box that touches the block below its middle, and a brim at its upper edge."""
    foot = Shape(Box((0.2, 0.1, 0.1)))
    brim = Shape(Box((0.2, 0.1, 0.02)), Pose((0.0, ahead, 0.3)))
    wide = ball(0.1).with_links([Link("ball", collisions=(foot, brim))])
    scene = Scene(wide, object=Block((0.4, 0.4, 0.4)), ground=None)
    block = np.array([0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    found = find_contacts(FreeSpace(scene), np.array([[0.0, -0.5]]), block, 0.4)
    assert found.gap[0] == pytest.approx(0.25 - max(ahead, 0), abs=0.002)
    assert found.overhang[0] == pytest.approx(over, abs=0.0035)

    beyond = np.array([[0.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0], [3.0, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]])
    each = overhang(FreeSpace(scene), np.array([[0.0, -0.5]] * 2), beyond, 0.4)
    assert each[0] == found.overhang[0]
    assert each[1] == 0


def batch(words, n, cache, task="push", **options):
    robots = [robot(each) for each in words]
    return make_batch(task, robots, n, cache=cache, configs=(REACH, PUSH), **options)


def successes(task, controller, steps=PUSH.max_episode_steps):
    """Return which first episodes end with the block across the line, shape (n,), bool."""
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
@pytest.mark.parametrize("sim", [PYBULLET, "mujoco"])
@pytest.mark.parametrize("words", [UR5, PANDA, PLANE])
def test_four_of_five_blocks_cross_the_line(words, sim, tmp_path):
    across = successes(batch([words], 20, tmp_path, sim=sim), ScriptedPush(0))
    assert across.float().mean() >= 0.8


@pytest.mark.slow
def test_actions_may_be_discrete(tmp_path):
    task = batch([PLANE], 3, tmp_path, sim="mujoco", kind="discrete")
    assert successes(task, ScriptedPush(0)).sum() >= 2


@pytest.mark.slow
def test_the_seed_determines_the_actions(tmp_path):
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


def test_actions_are_in_range_and_reach_robots_do_not_move(tmp_path):
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


def test_a_block_that_slips_away_is_replanned(tmp_path, monkeypatch):
    made = []
    plan = PushPlanner.plan

    def counted(self, *args):
        made.append(args)
        return plan(self, *args)

    monkeypatch.setattr(PushPlanner, "plan", counted)
    task, controller = batch([PLANE], 1, tmp_path, sim="mujoco"), ScriptedPush(0)
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
    task.close()
    assert 2 <= len(made) <= MAX_PLANS
    assert not np.allclose(made[0][1], made[1][1])
    left = [args[3] for args in made]
    assert left[0] == PUSH.max_episode_steps
    assert left == sorted(left, reverse=True)
    assert left[1] <= PUSH.max_episode_steps - 59


@pytest.mark.parametrize("free", [True, False])
def test_a_tool_rises_when_its_arm_collides(free, tmp_path, monkeypatch):
    def said(self, q):
        assert q.ndim == 2
        return np.full(len(q), free)

    monkeypatch.setattr(PushPlanner, "free", said)
    task, controller = batch([PLANE], 1, tmp_path, sim="mujoco"), ScriptedPush(0)
    task.reset()
    heights = []
    while len(heights) < 12:
        acting = controller.act(task)
        if controller.pushing[0]:
            robots, targets = task.env_robot_index, task.targets
            tools = frame_positions(task.robot_tables.tool_chain, robots, targets)
            heights.append(float(tools[0, 2]))
        assert not task.step(acting).terminated.any()
    task.close()
    rise = 0.0 if free else RISE
    assert np.diff(heights[1:]) == pytest.approx(rise, abs=RISE / 3)

"""The scripted push moves blocks across the line, and plans again after failures."""

import numpy as np
import pytest
import torch

from helpers.resets import reset_envs
from helpers.scenes import robot
from helpers.simulators import PYBULLET
from morphgen.model.kinematics_torch import frame_positions
from morphgen.rl.baselines.push_planner import PushPlanner
from morphgen.rl.baselines.scripted_push import MAX_PLANS, RISE, ScriptedPush
from morphgen.tasks.push.config import PushConfig
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import make_batch

UR5, PANDA, PLANE = "arm=ur5 ee=plane", "arm=panda ee=panda_hand", "prims"
PUSH, REACH = PushConfig(num_goals=8), ReachConfig(num_goals=4)


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
            away = task.simulation.block_pose.clone()
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

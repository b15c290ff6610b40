"""Tests that faults of AnyBody's released task code do not occur here.

Related tests are elsewhere: goal sets in ``test_goals`` and ``test_split_goals``; the target
critic, the action standard deviation and the learning rate in ``tests/rl``.
"""

from contextlib import closing
from dataclasses import replace

import pytest
import torch

import morphgen
from helpers.goal_sets import draw_spec
from helpers.resets import reset_envs
from helpers.simulators import PYBULLET
from morphgen.model.dynamics import actuation
from morphgen.tasks.reach.config import ReachConfig
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.sim.base import Contacts

SIMS = (PYBULLET, "mujoco")
FEW = replace(ReachConfig(), num_goals=12, max_episode_steps=40)


@pytest.fixture(scope="module")
def cache(tmp_path_factory):
    return tmp_path_factory.mktemp("goals")


@pytest.fixture(scope="module")
def robot():
    return morphgen.compose("arm=ur5 ee=plane", geometry="primitive")


@pytest.mark.parametrize("sim", SIMS)
def test_joints_are_reset_within_their_limits_and_stay_there(robot, sim, cache):
    """The original code computed the clamped joint positions and discarded them.

    Contacts are off, because a contact can press a joint past its limit for a while.
    """
    setting = draw_spec(robot, FEW, obstacles=False, seed=0, cache=cache)
    free = Contacts(False, False)
    with closing(batch_from_specs([setting], 4, sim=sim, contacts=free)) as batch:
        batch.reset()
        low, high = batch.robot_tables.lower, batch.robot_tables.upper
        outwards = torch.ones(batch.action_mask.shape)
        for k in range(2 * FEW.max_episode_steps):
            assert (batch.targets >= low).all()
            assert (batch.targets <= high).all()
            step = batch.step(outwards)
            assert (step.q >= low - 0.02).all()
            assert (step.q <= high + 0.02).all(), k
            if step.truncated.any():
                starts = torch.from_numpy(setting.goals.q).float()
                apart = (batch.q[:, None] - starts).abs().amax(dim=2).amin(dim=1)
                assert apart.max() < 1e-6


@pytest.mark.parametrize("sim", SIMS)
def test_gains_of_a_robot_are_those_that_move_it(robot, sim, cache):
    """The original code computed gains for each robot and never used them.

    Ten times the inertia gives ten times the stiffness, so the motion stays the same.
    """
    heavy = robot.with_links(
        [
            replace(
                link,
                inertial=replace(
                    link.inertial,
                    mass=10 * link.inertial.mass,
                    inertia=tuple(10 * value for value in link.inertial.inertia),
                ),
            )
            if link.inertial is not None
            else link
            for link in robot.links
        ]
    )
    strong = [replace(joint, effort=None if joint.effort is None else 100 * joint.effort)
              for joint in heavy.joints]  # fmt: skip
    heavy = replace(heavy, joints=tuple(strong))
    light_stiffness, heavy_stiffness = (
        [each.stiffness for each in actuation(body)] for body in (robot, heavy)
    )
    assert heavy_stiffness == pytest.approx([10 * value for value in light_stiffness], rel=0.05)
    ends = []
    for body in (robot, heavy):
        setting = draw_spec(body, FEW, obstacles=False, seed=0, cache=cache)
        with closing(batch_from_specs([setting], 1, sim=sim)) as batch:
            batch.reset()
            start = torch.tensor(body.home)[None].float()
            reset_envs(batch.simulation, [0], start)
            for _ in range(15):
                batch.simulation.step(start + 0.1)
            ends.append(batch.simulation.q.clone())
    assert (ends[0] - ends[1]).abs().max() < 0.01
    assert (ends[0] - torch.tensor(robot.home)).abs().min() > 0.05

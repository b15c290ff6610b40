"""Joints in PyBullet: forward kinematics, motor law and limits."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.robots import arm
from helpers.scenes import robot
from morphgen.model.dynamics import mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    forward_kinematics,
    joint_limits,
    movable_positions,
)
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP, Block, Contacts, Scene
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from helpers.pybullet_states import client_of, reset
from morphgen.tasks.sim.bullet_batch import OVERSPEED


@pytest.mark.parametrize("request_", ["arm=ur5 ee=plane", "arm=panda ee=panda_hand"])
def test_link_poses_match_forward_kinematics(simulate, request_):
    T = Pose.from_xyz_rpy((0.3, -0.2, 0.5), (0.2, 0.4, -0.7))
    body = robot(request_)
    simulation = simulate(Scene(body, T), contacts=Contacts(False, False))
    q = np.array(body.home) + 0.1
    reset(simulation, q)
    loaded = client_of(simulation)
    merged = merge_rigid_links(body)
    T_world_link = T.matrix @ forward_kinematics(body, q)
    for k in merged.movable_joints:
        name = merged.joints[k].child
        found = pybullet.getLinkState(
            loaded.robot,
            loaded.driven[merged.movable_joints.index(k)],
            computeForwardKinematics=True,
            physicsClientId=loaded.id,
        )
        expected = T_world_link[body.link_index[name], :3, 3]
        assert found[4] == pytest.approx(expected, abs=1e-6), name


def test_effort_is_limited(simulate):
    body = robot("prims")
    weak = tuple(replace(j, effort=5.0) if j.name == "gantry_x" else j for j in body.joints)
    body = replace(body, joints=weak)
    simulation = simulate(Scene(body))
    q = reset(simulation, body.home)
    q[0, 0] = 0.5
    simulation.step(q)
    acceleration = 5.0 / mass_matrix(body, body.home)[0, 0]
    expected = acceleration * SUBSTEPS * TIMESTEP
    assert float(simulation.qd[0, 0]) == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("pushes", [False, True])
def test_joints_return_to_their_limits(simulate, pushes):
    """Joints return whatever pushed them; scenes with a block use another solver."""
    body = arm()
    block = Block((0.1, 0.1, 0.1), Pose((3.0, 0.0, 0.05)), 1.0) if pushes else None
    simulation = simulate(Scene(body, Pose((0.0, 0.0, 1.0)), block=block))
    q = reset(simulation, [1.95, 0.0, 0.0, 0.0])
    loaded = client_of(simulation)
    link = loaded.driven[0]
    farthest = 0.0
    for _ in range(100):
        pybullet.applyExternalTorque(
            loaded.robot,
            link,
            [0.0, 200.0, 0.0],
            pybullet.WORLD_FRAME,
            physicsClientId=loaded.id,
        )
        simulation.step(q)
        farthest = max(farthest, float(simulation.q[0, 0]))
    assert farthest > 2.0
    assert float(simulation.q[0, 0]) == pytest.approx(2.0, abs=1e-3)


@pytest.mark.slow
def test_strong_contacts_do_not_exceed_joint_speed_limits(simulate):
    """The arm presses against itself and the ground with full effort."""
    body = robot("arm=ur5 ee=plane")
    simulation = simulate(*[Scene(body)] * 8)
    corners = torch.randn(8, body.dof, generator=torch.Generator().manual_seed(0)).sign()
    low, high = (torch.tensor(each, dtype=torch.float32) for each in joint_limits(body).T)
    final_targets = torch.where(corners > 0, high, low)
    q = reset(simulation)
    fastest = max(joint.velocity for joint in body.joints if joint.is_movable)
    for _ in range(200):
        before = simulation.q.clone()
        q = q + (final_targets - q).clamp(-0.05, 0.05)
        simulation.step(q)
        moved = (simulation.q - before).abs().max()
        assert float(moved) <= OVERSPEED * fastest * SUBSTEPS * TIMESTEP * (1 + 1e-4)


def test_mimic_joints_follow_their_leaders(simulate):
    body = arm()
    simulation = simulate(Scene(body, Pose((0.0, 0.0, 1.0))))
    q = reset(simulation, body.home)
    q[0, 3] = 0.035
    loaded = client_of(simulation)
    for _ in range(40):
        simulation.step(q)
        states = pybullet.getJointStates(loaded.robot, loaded.driven, physicsClientId=loaded.id)
        expected = movable_positions(body, simulation.q[0].numpy())
        np.testing.assert_allclose([s[0] for s in states], expected, atol=2e-4)
    assert float(simulation.q[0, 3]) == pytest.approx(0.035, abs=1e-4)

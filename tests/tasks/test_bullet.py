"""PyBullet in one process: resets, clients, joints, motors, contacts, friction."""

import gc
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.robots import arm
from helpers.scenes import mixed_scenes, push_scene, reach_scene, real_arm_scene, robot
from morphgen.errors import SimulationError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    forward_kinematics,
    joint_limits,
)
from morphgen.tasks.sim.base import GRAVITY, SUBSTEPS, TIMESTEP, Block, Contacts, Scene
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from helpers.pybullet_states import PUSHING, client_of, reset, touching, wander
from morphgen.tasks.sim import bullet
from morphgen.tasks.sim.bullet import BulletSimulation
from morphgen.tasks.sim.bullet_batch import FRICTION, OVERSPEED


def touching_starts(scene, seed):
    """Start states in contact, so that PyBullet keeps contact points between steps."""
    rng = np.random.default_rng(seed)
    if scene.block:
        q = np.array(PUSHING)
        q[1] = -0.079
        return q, (0.01 * seed, 0.0, 0.0749, 1.0, 0.0, 0.0, 0.0)
    return np.array(scene.robot.home) + rng.normal(size=scene.robot.dof) * 0.5, (0.0,) * 7


@pytest.mark.parametrize("scene", [push_scene, reach_scene, real_arm_scene])
def test_reset_removes_all_earlier_state(simulate, scene):
    """Random earlier motion near contact; without new broad-phase entries it would matter."""
    rng = np.random.default_rng(3)
    used = simulate(scene())
    for seed in range(12):
        q, pose = touching_starts(scene(), seed % 8)
        size, ahead = rng.choice([0.0, 0.003, 0.03, 0.1]), rng.choice([0.0, 0.006, 0.02])
        fresh = simulate(scene())
        expected = wander(fresh, reset(fresh, q, pose), 40, size=size, ahead=ahead)
        for _ in range(3):
            near = q + rng.choice([0.0, 0.001, 0.003]) * rng.normal(size=len(q))
            steps = int(rng.integers(1, 30))
            wander(used, reset(used, near, pose), steps, seed + 1, size, ahead)
        found = wander(used, reset(used, q, pose), 40, size=size, ahead=ahead)
        assert torch.equal(found, expected), seed


def test_robot_file_is_written_once(simulate, monkeypatch):
    written = []
    original = bullet.write_bundle

    def counted(body, *args, **options):
        written.append(body)
        return original(body, *args, **options)

    monkeypatch.setattr(bullet, "write_bundle", counted)
    simulate(*mixed_scenes(), *mixed_scenes())
    assert len(written) == 3


def test_a_diverged_environment_must_be_reset(simulate):
    simulation = simulate(push_scene())
    q, loaded = reset(simulation), client_of(simulation)
    pybullet.resetJointState(loaded.robot, loaded.driven[0], np.nan, physicsClientId=loaded.id)
    assert simulation.step(q).tolist() == [True]
    with pytest.raises(
        SimulationError, match=r"environment 0 \('prims.*diverged.*expected a reset"
    ):
        simulation.step(q)


def test_client_limit_error_names_the_limit(monkeypatch):
    monkeypatch.setattr(pybullet, "connect", lambda *_: -1)
    with pytest.raises(SimulationError, match="no client left: a process has 1024"):
        BulletSimulation([push_scene()])


def test_closing_frees_the_clients(simulate):
    simulation = simulate(push_scene())
    client = client_of(simulation).id
    assert pybullet.isConnected(client)
    simulation.close()
    simulation.close()
    assert not pybullet.isConnected(client)
    with pytest.raises(SimulationError, match="closed"):
        simulation.step(torch.zeros(1, 5))


def test_garbage_collected_simulation_frees_its_clients():
    simulation = BulletSimulation([push_scene()])
    client = client_of(simulation).id
    del simulation
    gc.collect()
    assert not pybullet.isConnected(client)


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


def block_scene(friction=1.0, height=0.5, mass=0.1):
    edge = 0.1
    block = Block((edge, edge, edge / 2), Pose((0.4, 0.0, height)), mass, friction)
    return Scene(robot("arm=ur5 ee=plane"), Pose((-1.0, 0.0, 0.3)), block)


@pytest.mark.parametrize("friction", [0.3, 0.6])
@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_friction_follows_coulombs_law(simulate, friction, degrees):
    simulation = simulate(block_scene(friction, height=0.025))
    q = reset(simulation)
    simulation.step(q)
    before = simulation.block_pose[0, :2].clone()
    loaded = client_of(simulation)
    ahead = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    pybullet.resetBaseVelocity(loaded.block, (*0.8 * ahead, 0.0), physicsClientId=loaded.id)
    for _ in range(60):
        simulation.step(q)
    expected = 0.8**2 / (2 * friction * GRAVITY) * ahead
    moved = (simulation.block_pose[0, :2] - before).numpy()
    np.testing.assert_allclose(moved, expected, atol=0.05 * np.linalg.norm(expected))


def test_robots_have_the_specified_friction(simulate):
    loaded = client_of(simulate(push_scene()))
    for link in (-1, *loaded.driven):
        info = pybullet.getDynamicsInfo(loaded.robot, link, physicsClientId=loaded.id)
        assert info[1] == FRICTION


def test_plate_passes_through_the_block_without_contacts(simulate):
    simulation = simulate(push_scene(), contacts=Contacts(scene=False))
    q = reset(simulation)
    for _ in range(60):
        q[:, 1] += 0.008
        simulation.step(q)
    assert float(simulation.q[0, 1]) > 0.2
    assert float(simulation.block_pose[0, 1]) == pytest.approx(0.0, abs=1e-3)
    assert float(simulation.block_pose[0, 2]) == pytest.approx(0.075, abs=1e-3)


def test_fixed_base_touches_blocks_but_not_static_objects(simulate):
    """The arm's base overlaps the ground and a box, and touches a block."""
    box = Block((0.1, 0.1, 0.05), Pose((0.0, 0.0, -0.01)))
    scene = Scene(robot("arm=ur5 ee=plane"), obstacles=(box,))
    simulation = simulate(scene, replace(scene, block=replace(box, mass=0.1), obstacles=()))
    q = reset(simulation)
    simulation.step(q)
    assert touching(simulation) == set()
    loaded = client_of(simulation, 1)
    assert ((loaded.robot, -1), (loaded.block, -1)) in touching(simulation, 1)


def self_contact(simulate, body, **contacts):
    simulation = simulate(
        Scene(body, Pose((0.0, 0.0, 2.0)), ground=None), contacts=Contacts(**contacts)
    )
    reset(simulation, (0.0, 0.0, 0.0, 0.0))
    # Before a step, because a step separates overlapping bodies.
    client = client_of(simulation).id
    pybullet.performCollisionDetection(physicsClientId=client)
    points = pybullet.getContactPoints(physicsClientId=client)
    return {((p[1], p[3]), (p[2], p[4])) for p in points if p[8] < 0}


def overlapping():
    """An arm whose third link overlaps its base."""
    body = arm()
    joints = list(body.joints)
    joints[2] = replace(joints[2], T_parent_joint=Pose((0.0, 0.0, -0.4)))
    return replace(body, joints=tuple(joints))


def test_links_collide_unless_their_pair_is_ignored(simulate):
    body = overlapping()
    touched = self_contact(simulate, body)
    assert touched
    merged = merge_rigid_links(body)
    names = {-1: merged.root.name} | {k: joint.child for k, joint in enumerate(merged.joints)}
    pairs = {tuple(sorted((names[a], names[b]))) for (_, a), (_, b) in touched}
    assert ("base", "slider") in pairs or ("slider", "upper") in pairs
    assert self_contact(simulate, replace(body, ignore_pairs=tuple(sorted(pairs)))) == set()
    assert self_contact(simulate, body, self_collision=False) == set()
    assert self_contact(simulate, body, scene=False) == touched

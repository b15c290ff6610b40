"""PyBullet: resets, clients, joints, motor forces, contacts, friction."""

import gc
import tempfile
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.faulty_robots import with_joint
from helpers.robots import arm
from helpers.scenes import homes, push_scene, reach_scene, real_arm_scene, reset_envs, robot, state
from morphgen.errors import SimulationError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import joint_limits
from morphgen.tasks.sim.articulated import merge_rigid_links
from morphgen.tasks.sim.base import GRAVITY, SUBSTEPS, TIMESTEP, Block, Contacts, Scene

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from morphgen.tasks.sim import bullet
from morphgen.tasks.sim.bullet import OVERSPEED, BulletSimulation

PUSHING = (0.0, -0.2, 0.62, np.pi / 2, 0.0)
"""The gantry's plate upright behind the block, off the ground."""


def reset(simulation, q=None, pose=None, envs=None):
    """Reset to joints and block poses, by default home or behind the block, and these poses."""
    envs = torch.arange(len(simulation.scenes)) if envs is None else envs
    home, blocks = homes(simulation)
    for env, scene in enumerate(simulation.scenes):
        if scene.block and scene.robot.name == "prims":
            home[env, : len(PUSHING)] = torch.tensor(PUSHING)
    q = home[envs] if q is None else torch.as_tensor(q, dtype=torch.float32).reshape(len(envs), -1)
    pose = blocks[envs] if pose is None else torch.as_tensor(pose, dtype=torch.float32)
    reset_envs(simulation, envs, q, pose.reshape(len(envs), 7))
    return q


def client_of(simulation, env=0):
    return simulation._loaded[env]


def wander(simulation, q, steps, seed=0, size=0.03, ahead=0.0):
    """Step with targets on a random walk from ``q``, the same for every environment.

    ``ahead`` is added to the second joint's target each step; it is the gantry's y axis.
    """
    generator = torch.Generator().manual_seed(seed)
    seen = []
    for _ in range(steps):
        q = q + size * torch.randn(q.shape[1], generator=generator)
        q[:, 1] += ahead
        simulation.step(q)
        seen.append(state(simulation))
    return torch.stack(seen)


def touching(simulation, env=0):
    """Pairs of (body, link) in contact after the last step."""
    points = pybullet.getContactPoints(physicsClientId=client_of(simulation, env).id)
    return {((p[1], p[3]), (p[2], p[4])) for p in points if p[9] > 0}


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


def test_a_diverged_environment_must_be_reset(simulate):
    simulation = simulate(push_scene())
    q, loaded = reset(simulation), client_of(simulation)
    pybullet.resetJointState(loaded.robot, loaded.driven[0], np.nan, physicsClientId=loaded.id)
    assert simulation.step(q).tolist() == [True]
    with pytest.raises(
        SimulationError, match=r"environment 0 \(robot 'prims.*diverged.*expected a reset"
    ):
        simulation.step(q)


def test_client_limit_error_names_the_limit(monkeypatch):
    monkeypatch.setattr(pybullet, "connect", lambda *_: -1)
    with pytest.raises(SimulationError, match="no client left: a process has 1024"):
        BulletSimulation([push_scene()])


@pytest.mark.parametrize("pushes", [False, True])
def test_joints_return_to_their_limits(simulate, pushes):
    """Joints return whatever pushed them; scenes with a block use another solver."""
    body = arm()
    block = Block((0.1, 0.1, 0.1), Pose((3.0, 0.0, 0.05)), 1.0) if pushes else None
    simulation = simulate(Scene(body, Pose((0.0, 0.0, 1.0)), object=block))
    q = reset(simulation, [1.95, 0.0, 0.0, 0.0])
    loaded = client_of(simulation)
    link = loaded.driven[0]
    farthest = 0.0
    for _ in range(100):
        pybullet.applyExternalTorque(
            loaded.robot, link, [0.0, 200.0, 0.0], pybullet.WORLD_FRAME, physicsClientId=loaded.id
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


@pytest.mark.parametrize("friction", [0.3, 0.6])
@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_friction_follows_coulombs_law(simulate, friction, degrees):
    block = Block((0.1, 0.1, 0.05), Pose((0.4, 0.0, 0.025)), 0.1, friction)
    simulation = simulate(Scene(robot("arm=ur5 ee=plane"), Pose((-1.0, 0.0, 0.3)), block))
    q = reset(simulation)
    simulation.step(q)
    before = simulation.object_pose[0, :2].clone()
    loaded = client_of(simulation)
    ahead = np.array([np.cos(np.radians(degrees)), np.sin(np.radians(degrees))])
    pybullet.resetBaseVelocity(loaded.block, (*0.8 * ahead, 0.0), physicsClientId=loaded.id)
    for _ in range(60):
        simulation.step(q)
    expected = 0.8**2 / (2 * friction * GRAVITY) * ahead
    moved = (simulation.object_pose[0, :2] - before).numpy()
    np.testing.assert_allclose(moved, expected, atol=0.05 * np.linalg.norm(expected))


def test_plate_passes_through_the_block_without_contacts(simulate):
    simulation = simulate(push_scene(), contacts=Contacts(scene=False))
    q = reset(simulation)
    for _ in range(60):
        q[:, 1] += 0.008
        simulation.step(q)
    assert float(simulation.q[0, 1]) > 0.2
    assert float(simulation.object_pose[0, 1]) == pytest.approx(0.0, abs=1e-3)
    assert float(simulation.object_pose[0, 2]) == pytest.approx(0.075, abs=1e-3)


def test_fixed_base_touches_blocks_but_not_static_objects(simulate):
    """The arm's base overlaps the ground and a box, and touches a block."""
    box = Block((0.1, 0.1, 0.05), Pose((0.0, 0.0, -0.01)))
    scene = Scene(robot("arm=ur5 ee=plane"), obstacles=(box,))
    simulation = simulate(scene, replace(scene, object=replace(box, mass=0.1), obstacles=()))
    q = reset(simulation)
    simulation.step(q)
    assert touching(simulation) == set()
    loaded = client_of(simulation, 1)
    assert ((loaded.robot, -1), (loaded.block, -1)) in touching(simulation, 1)


def self_contact(simulate, body, **contacts):
    scene = Scene(body, Pose((0.0, 0.0, 2.0)), ground=None)
    simulation = simulate(scene, contacts=Contacts(**contacts))
    reset(simulation, (0.0, 0.0, 0.0, 0.0))
    # Before a step, because a step separates overlapping bodies.
    client = client_of(simulation).id
    pybullet.performCollisionDetection(physicsClientId=client)
    points = pybullet.getContactPoints(physicsClientId=client)
    return {((p[1], p[3]), (p[2], p[4])) for p in points if p[8] < 0}


def test_links_collide_unless_their_pair_is_ignored(simulate):
    """The third link of this arm overlaps its base."""
    body = with_joint(arm(), "extend", T_parent_joint=Pose((0.0, 0.0, -0.4)))
    touched = self_contact(simulate, body)
    assert touched
    merged = merge_rigid_links(body)
    names = {-1: merged.root.name} | {k: joint.child for k, joint in enumerate(merged.joints)}
    pairs = {tuple(sorted((names[a], names[b]))) for (_, a), (_, b) in touched}
    assert ("base", "slider") in pairs or ("slider", "upper") in pairs
    assert self_contact(simulate, replace(body, ignore_pairs=tuple(sorted(pairs)))) == set()
    assert self_contact(simulate, body, self_collision=False) == set()
    assert self_contact(simulate, body, scene=False) == touched


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """Folder for temporary files of this test."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def test_robot_that_cannot_be_loaded_is_named(monkeypatch, scratch):
    original = bullet.export_scenes

    def lost(scenes, folder):
        exported = original(scenes, folder)
        return [replace(each, urdf=each.urdf.with_name("none.urdf")) for each in exported]

    monkeypatch.setattr(bullet, "export_scenes", lost)
    with pytest.raises(SimulationError, match="robot 'prims': PyBullet cannot load it"):
        BulletSimulation([push_scene()])
    assert [*scratch.iterdir()] == []


@pytest.mark.parametrize("closes", [True, False], ids=["closed", "garbage-collected"])
def test_nothing_is_left_of_a_simulation(scratch, closes):
    simulation = BulletSimulation([push_scene(), push_scene()])
    clients = [client_of(simulation, env).id for env in range(2)]
    if closes:
        simulation.close()
        simulation.close()
    del simulation
    gc.collect()
    assert not any(map(pybullet.isConnected, clients))
    assert [*scratch.iterdir()] == []

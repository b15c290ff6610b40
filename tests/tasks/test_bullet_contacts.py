"""Contacts in PyBullet: blocks, friction, obstacles and self-contact."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm
from helpers.scenes import push_scene, robot
from morphgen.model.geometry import Pose
from morphgen.tasks.sim.base import GRAVITY, Block, Contacts, Scene
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from helpers.pybullet_states import client_of, reset, touching
from morphgen.tasks.sim.bullet_batch import FRICTION


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


def push(simulation, steps=60):
    q = reset(simulation)
    for _ in range(steps):
        q[:, 1] += 0.008
        simulation.step(q)


def test_gantry_pushes_the_block(simulate):
    simulation = simulate(push_scene())
    push(simulation)
    plate = float(simulation.q[0, 1]) + 0.005
    assert float(simulation.block_pose[0, 1]) == pytest.approx(plate + 0.075, abs=0.01)
    assert float(simulation.block_pose[0, 1]) > 0.2


def test_plate_passes_through_the_block_without_contacts(simulate):
    simulation = simulate(push_scene(), contacts=Contacts(scene=False))
    push(simulation)
    assert float(simulation.q[0, 1]) > 0.2
    assert float(simulation.block_pose[0, 1]) == pytest.approx(0.0, abs=1e-3)
    assert float(simulation.block_pose[0, 2]) == pytest.approx(0.075, abs=1e-3)


def test_obstacles_stop_the_robot(simulate):
    wall = Block((1.0, 0.1, 1.0), Pose((0.0, 0.1, 0.5)))
    simulation = simulate(replace(push_scene(), block=None, obstacles=(wall,)))
    push(simulation, 80)
    half_plate = 0.3
    assert float(simulation.q[0, 1]) == pytest.approx(0.05 - half_plate, abs=0.01)


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

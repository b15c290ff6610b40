"""One process of PyBullet: the control law, contacts, and no memory of the past."""

import gc
from dataclasses import replace

import numpy as np
import pybullet
import pytest
import torch

from morphgen.errors import SimulationError
from morphgen.model.dynamics import BANDWIDTH, mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import bounds, forward_kinematics, frame_pose, movable_positions
from morphgen.tasks.sim import bullet_batch
from morphgen.tasks.sim.base import GRAVITY, SUBSTEPS, TIMESTEP, Block, Contacts, Scene
from morphgen.tasks.sim.bullet import BulletSimulation
from morphgen.tasks.sim.bullet_scene import FRICTION
from morphgen.tasks.sim.rigid_bodies import rigid_bodies
from robots import arm
from scenes import mixed_scenes, push_scene, reach_scene, real_arm_scene, robot

PUSHING = (0.0, -0.2, 0.62, np.pi / 2, 0.0)
"""The gantry's plate upright behind the block, off the ground."""


@pytest.fixture
def simulate():
    made = []

    def make(*scenes, contacts=None):
        made.append(BulletSimulation(scenes, contacts))
        return made[-1]

    yield make
    for simulation in made:
        simulation.close()


def starts(simulation):
    """Home, or behind the block, for every environment; blocks where the scenes have them."""
    q = torch.zeros_like(simulation.q)
    pose = torch.zeros_like(simulation.block_pose)
    for env, scene in enumerate(simulation.scenes):
        values = PUSHING if scene.block and scene.robot.name == "prims" else scene.robot.home
        q[env, : scene.robot.dof] = torch.tensor(values)
        if scene.block:
            pose[env] = torch.tensor([*scene.block.pose.position, *scene.block.pose.quaternion])
    return q, pose


def reset(simulation, q=None, pose=None, envs=None):
    envs = torch.arange(len(simulation.scenes)) if envs is None else envs
    home, blocks = starts(simulation)
    q = home[envs] if q is None else torch.as_tensor(q, dtype=torch.float32).reshape(len(envs), -1)
    pose = blocks[envs] if pose is None else torch.as_tensor(pose, dtype=torch.float32)
    simulation.reset(envs, q, pose.reshape(len(envs), 7))
    return q


def client_of(simulation, env=0):
    """The PyBullet client of an environment."""
    return simulation._own[0]._loaded[env]


def state(simulation):
    parts = (simulation.q, simulation.qd, simulation.block_pose, simulation.block_velocity)
    return torch.cat(parts, dim=1).clone()


def wander(simulation, q, steps, seed=0, size=0.03, ahead=0.0):
    """Targets on a random walk from ``q``, the same for every environment.

    With ``ahead``, the second joint of each, which is the gantry's along y, moves on besides.
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


def test_tensors_are_padded_and_stay_the_same(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    before = simulation.q
    simulation.step(q)
    assert simulation.q is before
    assert simulation.q.shape == simulation.qd.shape == (3, 9)
    assert simulation.block_pose.shape == (3, 7)
    assert simulation.block_velocity.shape == (3, 6)
    assert {t.dtype for t in (simulation.q, simulation.block_pose)} == {torch.float32}
    assert simulation.device.type == "cpu"
    assert not simulation.q[1, 5:].any()
    assert not simulation.qd[1, 5:].any()
    assert not simulation.block_pose[[0, 2]].any()
    assert simulation.block_pose[1, 3] == pytest.approx(1, abs=1e-6)


def test_padding_of_targets_may_be_anything(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    q[1, 5:] = torch.nan
    simulation.step(q)
    assert torch.isfinite(simulation.q).all()


@pytest.mark.parametrize("request_", ["arm=ur5 ee=plane", "arm=panda ee=panda_hand"])
def test_links_are_where_the_kinematics_put_them(simulate, request_):
    T = Pose.from_xyz_rpy((0.3, -0.2, 0.5), (0.2, 0.4, -0.7))
    body = robot(request_)
    simulation = simulate(Scene(body, T), contacts=Contacts(False, False))
    q = np.array(body.home) + 0.1
    reset(simulation, q)
    loaded = client_of(simulation)
    merged = rigid_bodies(body)
    T_world_link = T.matrix @ forward_kinematics(body, q)
    for k in merged.movable:
        name = merged.joints[k].child
        found = pybullet.getLinkState(
            loaded.robot,
            loaded.driven[merged.movable.index(k)],
            computeForwardKinematics=True,
            physicsClientId=loaded.id,
        )
        expected = T_world_link[body.link_index[name], :3, 3]
        assert found[4] == pytest.approx(expected, abs=1e-6), name


@pytest.mark.parametrize("request_", ["arm=ur5 ee=plane", "arm=arm3 ee=claw", "prims"])
def test_motors_follow_the_critically_damped_law(simulate, request_):
    body = robot(request_)
    free = replace(body, joints=tuple(replace(j, effort=None, velocity=None) for j in body.joints))
    simulation = simulate(Scene(free, ground=None), contacts=Contacts(False, False))
    q = np.array(body.home)
    target = np.clip(q + 0.05 * (np.arange(body.dof) % 3 - 1), *bounds(body).T)
    reset(simulation, q)
    v = np.zeros_like(q)
    for _ in range(50):
        simulation.step(torch.tensor(target, dtype=torch.float32)[None])
        for _ in range(SUBSTEPS):
            v = v + TIMESTEP * (BANDWIDTH**2 * (target - q) - 2 * BANDWIDTH * v)
            q = q + TIMESTEP * v
        np.testing.assert_allclose(simulation.q[0].numpy(), q, atol=3e-3)
    np.testing.assert_allclose(simulation.q[0].numpy(), target, atol=1e-4)


@pytest.mark.parametrize("scene", [reach_scene, real_arm_scene, push_scene])
def test_robots_carry_their_own_weight(simulate, scene):
    simulation = simulate(scene())
    q = reset(simulation)
    for _ in range(300):
        simulation.step(q)
    body = simulation.scenes[0].robot
    tools = frame_pose(body, np.stack([simulation.q[0].numpy(), q[0].numpy()]))[:, :3, 3]
    assert np.linalg.norm(tools[0] - tools[1]) < 1e-4


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


def test_velocity_is_limited(simulate):
    body = robot("prims")
    simulation = simulate(Scene(body))
    q = reset(simulation, body.home)
    q[0, 0] = 0.5
    fastest = 0.0
    for _ in range(20):
        simulation.step(q)
        fastest = max(fastest, float(simulation.qd[0, 0]))
    assert fastest == pytest.approx(body.joints[0].velocity, rel=1e-4)


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


def block_scene(friction=1.0, height=0.5, mass=0.1):
    edge = 0.1
    block = Block((edge, edge, edge / 2), Pose((0.4, 0.0, height)), mass, friction)
    return Scene(robot("arm=ur5 ee=plane"), Pose((-1.0, 0.0, 0.3)), block)


def test_blocks_fall_and_come_to_rest(simulate):
    simulation = simulate(block_scene())
    q = reset(simulation)
    for _ in range(10):
        simulation.step(q)
    t, n = 0.2, 10 * SUBSTEPS
    fallen = 0.5 * GRAVITY * t**2 * (n + 1) / n
    assert float(simulation.block_pose[0, 2]) == pytest.approx(0.5 - fallen, abs=1e-5)
    assert float(simulation.block_velocity[0, 2]) == pytest.approx(-GRAVITY * t, rel=1e-5)
    for _ in range(100):
        simulation.step(q)
    assert float(simulation.block_pose[0, 2]) == pytest.approx(0.025, abs=1e-3)
    assert float(simulation.block_velocity.abs().max()) < 1e-3


@pytest.mark.parametrize("friction", [0.3, 0.6])
@pytest.mark.parametrize("degrees", [0, 30, 45])
def test_friction_is_coulombs_with_the_blocks_coefficient(simulate, friction, degrees):
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


def test_robots_have_the_stated_friction(simulate):
    loaded = client_of(simulate(push_scene()))
    for link in (-1, *loaded.driven):
        info = pybullet.getDynamicsInfo(loaded.robot, link, physicsClientId=loaded.id)
        assert info[1] == FRICTION


def test_a_block_without_mass_stays_where_it_is_put(simulate):
    scene = block_scene(mass=0.0)
    simulation = simulate(scene)
    pose = torch.tensor([[0.1, 0.2, 0.7, 1.0, 0.0, 0.0, 0.0]])
    q = reset(simulation, pose=pose)
    for _ in range(20):
        simulation.step(q)
    assert torch.allclose(simulation.block_pose, pose)
    assert not simulation.block_velocity.any()


def push(simulation, steps=60):
    q = reset(simulation)
    for _ in range(steps):
        q[:, 1] += 0.008
        simulation.step(q)


def test_the_gantry_pushes_the_block(simulate):
    simulation = simulate(push_scene())
    push(simulation)
    plate = float(simulation.q[0, 1]) + 0.005
    assert float(simulation.block_pose[0, 1]) == pytest.approx(plate + 0.075, abs=0.01)
    assert float(simulation.block_pose[0, 1]) > 0.2


def test_without_contacts_the_plate_passes_through(simulate):
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


def test_what_is_held_does_not_touch_what_stands(simulate):
    """The foot of the arm stands in the ground and in a box, and on a block."""
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
    q = reset(simulation, (0.0, 0.0, 0.0, 0.0))
    simulation.step(q)
    return touching(simulation)


def overlapping():
    """An arm whose third link lies in its base."""
    body = arm()
    joints = list(body.joints)
    joints[2] = replace(joints[2], T_parent_joint=Pose((0.0, 0.0, -0.4)))
    return replace(body, joints=tuple(joints))


def test_links_touch_each_other_unless_ignored(simulate):
    body = overlapping()
    touched = self_contact(simulate, body)
    assert touched
    merged = rigid_bodies(body)
    names = {-1: merged.root.name} | {k: joint.child for k, joint in enumerate(merged.joints)}
    pairs = {tuple(sorted((names[a], names[b]))) for (_, a), (_, b) in touched}
    assert ("base", "slider") in pairs or ("slider", "upper") in pairs
    assert self_contact(simulate, replace(body, ignore_pairs=tuple(sorted(pairs)))) == set()
    assert self_contact(simulate, body, self_collision=False) == set()
    assert self_contact(simulate, body, scene=False) == touched


def touching_starts(scene, seed):
    """A start in which bodies touch, so that contact points are kept between steps."""
    rng = np.random.default_rng(seed)
    if scene.block:
        q = np.array(PUSHING)
        q[1] = -0.079
        return q, (0.01 * seed, 0.0, 0.0749, 1.0, 0.0, 0.0, 0.0)
    return np.array(scene.robot.home) + rng.normal(size=scene.robot.dof) * 0.5, (0.0,) * 7


@pytest.mark.parametrize("scene", [push_scene, reach_scene, real_arm_scene])
def test_a_reset_leaves_no_trace_of_the_past(simulate, scene):
    """Random pasts near a touching start; without new broad-phase entries some show."""
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


def test_the_touching_starts_touch(simulate):
    """Without contacts the test above would show little."""
    simulation = simulate(push_scene())
    q, pose = touching_starts(push_scene(), 0)
    simulation.step(reset(simulation, q, pose))
    loaded = client_of(simulation)
    bodies = {frozenset((a, b)) for (a, _), (b, _) in touching(simulation)}
    assert frozenset((loaded.robot, loaded.block)) in bodies


def test_an_environment_gives_the_same_bits_alone_and_among_many(simulate):
    scenes = [scene for _ in range(17) for scene in mixed_scenes()][:50]
    many = simulate(*scenes)
    together = wander(many, reset(many), 30)
    for env in (0, 1, 2, 48):
        alone = simulate(scenes[env])
        dof = scenes[env].robot.dof
        q = reset(alone)
        generator = torch.Generator().manual_seed(0)
        for step in range(30):
            q = q + 0.03 * torch.randn(9, generator=generator)[:dof]
            alone.step(q)
            assert torch.equal(alone.q[0], together[step, env, :dof])
            assert torch.equal(alone.qd[0], together[step, env, 9 : 9 + dof])
            assert torch.equal(alone.block_pose[0], together[step, env, 18:25])


def test_resetting_some_leaves_the_others_alone(simulate):
    scenes = mixed_scenes()
    a, b = simulate(*scenes), simulate(*scenes)
    q = reset(a)
    reset(b)
    for step in range(10):
        a.step(q + 0.01 * step)
        b.step(q + 0.01 * step)
    reset(b, envs=torch.tensor([1]))
    a.step(q)
    b.step(q)
    assert torch.equal(state(a)[[0, 2]], state(b)[[0, 2]])
    assert not torch.equal(state(a)[1], state(b)[1])


def test_a_reset_reports_the_state(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    assert torch.equal(simulation.q, q)
    assert not simulation.qd.any()
    _, pose = starts(simulation)
    assert torch.allclose(simulation.block_pose, pose, atol=1e-6)


def test_a_robot_is_written_once(simulate, monkeypatch):
    written = []
    original = bullet_batch.export
    monkeypatch.setattr(
        bullet_batch, "export", lambda *args: (written.append(args), original(*args))[1]
    )
    simulate(*mixed_scenes(), *mixed_scenes())
    assert len(written) == 3


def test_an_unstable_environment_is_named_and_can_be_reset(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    simulation.step(q)
    loaded = client_of(simulation, 2)
    pybullet.resetJointState(loaded.robot, loaded.driven[0], np.nan, physicsClientId=loaded.id)
    for _ in range(2):
        with pytest.raises(SimulationError, match=r"environment 2 \('ur5-plane'\).* step 2 after"):
            simulation.step(q)
    reset(simulation, envs=torch.tensor([2]))
    fresh = simulate(real_arm_scene())
    reset(fresh)
    simulation.step(q + 0.01)
    fresh.step(q[2:, :6] + 0.01)
    assert torch.equal(simulation.q[2, :6], fresh.q[0])


def test_wrong_arguments_are_refused_before_anything_moves(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    before = state(simulation)
    bad = q.clone()
    bad[2, 3] = torch.nan
    with pytest.raises(ValueError, match=r"environment 2 .*targets"):
        simulation.step(bad)
    with pytest.raises(ValueError, match=r"shape \(3, 4\), not \(3, 9\)"):
        simulation.step(q[:, :4])
    with pytest.raises(ValueError, match=r"environment 2 .*reset to"):
        reset(simulation, bad)
    with pytest.raises(ValueError, match="there are 3"):
        simulation.reset(torch.tensor([3]), q[:1], torch.zeros(1, 7))
    assert torch.equal(state(simulation), before)


def test_the_limit_of_clients_is_named(monkeypatch):
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


def test_a_forgotten_simulation_frees_its_clients():
    simulation = BulletSimulation([push_scene()])
    client = client_of(simulation).id
    del simulation
    gc.collect()
    assert not pybullet.isConnected(client)

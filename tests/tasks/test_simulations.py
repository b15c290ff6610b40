"""Conduct of all simulations on the CPU: states, targets, resets, divergence, blocks and errors."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.joint_targets import held
from helpers.resets import reset_envs
from helpers.scenes import mixed_scenes, push_scene, reach_scene, real_arm_scene, robot
from helpers.simulators import PYBULLET
from morphgen.errors import SimulationError
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose, joint_limits
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.sim.base import GRAVITY, SUBSTEPS, TIMESTEP, Block, Contacts, Scene

ALL, WITH_CONTACTS = ("kinematic", "mujoco", PYBULLET), ("mujoco", PYBULLET)
NOTHING_TOUCHES = Contacts(False, False)


@pytest.fixture
def load(sim, opened):
    """Create simulations of scenes, reset to their homes."""

    def of(*scenes, contacts=None):
        loaded = opened(SIMULATORS[sim].load(scenes, contacts, 1, torch.device("cpu")))
        put_home(loaded)
        return loaded

    return of


@pytest.fixture
def scenes(sim):
    """Three scenes of different robots, one of them with a block and obstacles if there can be."""
    if SIMULATORS[sim].simulates_contacts:
        return mixed_scenes()
    return [replace(scene, block=None, obstacles=()) for scene in mixed_scenes()]


def homes(sim):
    """Return the joint positions at home, and the poses of the blocks in their scenes."""
    q, poses = torch.zeros_like(sim.q), torch.zeros(len(sim.scenes), 7)
    for env, scene in enumerate(sim.scenes):
        q[env, : scene.robot.dof] = torch.tensor(scene.robot.home)
        if scene.block is not None:
            poses[env] = torch.tensor((*scene.block.pose.position, *scene.block.pose.quaternion))
    return q, poses


def put_home(sim, envs=None):
    """Reset all environments, or some of them, to their homes."""
    envs = list(range(len(sim.scenes)) if envs is None else envs)
    q, poses = homes(sim)
    reset_envs(sim, envs, q[envs], poses[envs])


def state(sim):
    return torch.cat([sim.q, sim.qd, sim.block_pose, sim.block_velocity], dim=1).clone()


def drive(sim, steps=25, seed=0):
    """Step with random targets that do not depend on an environment's index."""
    start = homes(sim)[0]
    for k in range(steps):
        change = np.random.default_rng([seed, k]).uniform(-0.3, 0.3, 32)
        sim.step(start + torch.from_numpy(change).float()[: start.shape[1]])


def break_physics(sim, env):
    """Set a velocity or position to nan."""
    if hasattr(sim, "_data"):
        sim._data[env].qvel[0] = math.nan
        return
    import pybullet

    loaded = sim._local_batches[0]._loaded[env]
    pybullet.resetJointState(loaded.robot, loaded.driven[0], math.nan, physicsClientId=loaded.id)


@pytest.mark.parametrize("sim", ALL)
def test_states_are_at_home_and_padded(load, scenes):
    sim = load(*scenes)
    q, poses = homes(sim)
    assert torch.equal(sim.q, q)
    assert sim.q.shape == sim.qd.shape == (3, 9)
    torch.testing.assert_close(sim.block_pose, poses)
    assert sim.block_velocity.shape == (3, 6)
    assert sim.q.dtype == sim.block_pose.dtype == torch.float32
    targets = q.clone()
    targets[1, 5:] = torch.nan  # padding is ignored
    assert not sim.step(targets).any()
    assert sim.q.isfinite().all()
    assert not sim.q[1, 5:].any()
    assert not sim.qd[1, 5:].any()


@pytest.mark.parametrize("sim", ALL)
def test_a_reset_forgets_the_past_and_leaves_other_environments(load, scenes):
    used, fresh = load(*scenes), load(*scenes)
    drive(used, 40, seed=5)
    before = state(used)
    put_home(used, [0, 1])
    assert torch.equal(state(used)[2], before[2])
    put_home(used)
    assert torch.equal(state(used), state(fresh))
    drive(used, 60)
    drive(fresh, 60)
    assert torch.equal(state(used), state(fresh))


@pytest.mark.parametrize("sim", ALL)
def test_a_reset_of_one_environment_does_not_change_the_next_steps_of_others(load, scenes):
    one, other = load(*scenes), load(*scenes)
    for sim in (one, other):
        drive(sim, 20)
    put_home(one, [1])
    for sim in (one, other):
        drive(sim, 5)
    assert torch.equal(state(one)[[0, 2]], state(other)[[0, 2]])
    assert not torch.equal(state(one)[1], state(other)[1])


@pytest.mark.parametrize("sim", ALL)
def test_environments_give_the_same_bits_alone_and_in_a_batch(load, scenes):
    together = load(*scenes, *scenes)
    drive(together, 30)
    for env, scene in enumerate(scenes):
        alone, dof = load(scene), scene.robot.dof
        drive(alone, 30)
        for same in (env, env + 3):
            assert torch.equal(together.q[same, :dof], alone.q[0])
            assert torch.equal(together.qd[same, :dof], alone.qd[0])
            assert torch.equal(together.block_pose[same], alone.block_pose[0])
            assert torch.equal(together.block_velocity[same], alone.block_velocity[0])


@pytest.mark.parametrize("sim", WITH_CONTACTS)
@pytest.mark.parametrize("scene", [reach_scene, real_arm_scene, push_scene])
def test_motors_hold_the_robot_against_gravity(load, scene):
    sim = held(load(scene()), 300)
    body = sim.scenes[0].robot
    tools = frame_pose(body, np.stack([sim.q[0].numpy(), np.array(body.home)]))[:, :3, 3]
    assert np.linalg.norm(tools[0] - tools[1]) < 1e-4
    assert sim.qd.abs().max() < 1e-3


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_motors_are_critically_damped_in_a_whole_batch(load):
    """Motors have the gains of their own robot, whatever else is in the batch."""
    bodies = []
    for words in ("arm=ur5 ee=plane", "arm=arm3 ee=claw", "prims"):
        joints = (replace(j, effort=None, velocity=None) for j in robot(words).joints)
        bodies.append(replace(robot(words), joints=tuple(joints)))
    sim = load(*(Scene(body, ground=None) for body in bodies), contacts=NOTHING_TOUCHES)
    q, target = sim.q.double().numpy().copy(), np.zeros(sim.q.shape)
    for env, body in enumerate(bodies):
        moved = np.array(body.home) + 0.05 * (np.arange(body.dof) % 3 - 1)
        target[env, : body.dof] = np.clip(moved, *joint_limits(body).T)
    v = np.zeros_like(q)
    for _ in range(50):
        sim.step(torch.from_numpy(target).float())
        for _ in range(SUBSTEPS):
            v = v + TIMESTEP * (BANDWIDTH**2 * (target - q) - 2 * BANDWIDTH * v)
            q = q + TIMESTEP * v
        np.testing.assert_allclose(sim.q.numpy(), q, atol=3e-3)
    np.testing.assert_allclose(sim.q.numpy(), target, atol=1e-4)


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_effort_limits_hold_in_a_whole_batch(load):
    """Motors have the limits of their own robot: the weaker the motors, the later the arm."""
    arm, scenes = robot("arm=ur5 ee=plane"), [Scene(robot("prims"), ground=None)]
    for effort in (5.0, 15.0, 150.0):
        joints = (replace(j, effort=effort) if j.effort else j for j in arm.joints)
        scenes.append(Scene(replace(arm, joints=tuple(joints)), ground=None))
    sim = load(*scenes, contacts=NOTHING_TOUCHES)
    start, target = sim.q.clone(), sim.q.clone()
    target[1:, 0] += 0.3
    for _ in range(5):
        sim.step(target)
    still, weak, medium, strong = (sim.q - start)[:, 0].tolist()
    assert abs(still) < 1e-4
    assert 0 < weak < 0.05
    assert 2 * weak < medium < strong / 2
    assert strong > 0.15


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_far_targets_are_approached_at_the_speed_limit(load):
    body = robot("prims")
    sim = load(Scene(body), contacts=NOTHING_TOUCHES)
    target, fastest = sim.q.clone(), 0.0
    target[0, 0] = 5.0
    for _ in range(25):
        sim.step(target)
        fastest = max(fastest, sim.qd[0, 0].item())
    assert 0.9 < fastest / body.joints[body.independent_joints[0]].velocity < 1.35


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_a_diverged_environment_is_reported_and_a_reset_repairs_it(load, scenes):
    sim, whole = load(*scenes), load(*scenes)
    q = homes(sim)[0]
    sim.step(q)
    whole.step(q)
    break_physics(sim, 2)
    whole.step(q)
    assert sim.step(q).tolist() == [False, False, True]
    assert list(sim.faults()) == [2]
    assert re.match(r"environment 2 \(.*'ur5-plane'.*diverged", sim.faults()[2])
    assert torch.equal(state(sim)[:2], state(whole)[:2])
    put_home(sim, [2])
    put_home(whole, [2])
    assert not sim.step(q + 0.01).any()
    assert sim.faults() == {}
    whole.step(q + 0.01)
    assert torch.equal(state(sim), state(whole))


@pytest.mark.parametrize("sim", ALL)
def test_invalid_arguments_change_nothing(load, scenes):
    sim = load(*scenes)
    q, poses = homes(sim)
    bad, before = q.clone(), state(sim)
    bad[2, 3] = torch.inf
    every = torch.ones(3, dtype=torch.bool)
    for call, error, words in (
        (lambda: sim.step(bad), ValueError, "environment 2 .*target"),
        (lambda: sim.step(q[:, :4]), ValueError, r"shape \(3, 4\)"),
        (lambda: reset_envs(sim, [2], bad[2:], poses[2:]), ValueError, "environment 2 .*reset to"),
        (lambda: sim.reset(every[:1], q, poses), ValueError, r"mask of shape \(1,\)"),
        (lambda: sim.reset(every.long(), q, poses), ValueError, r"\(3,\) and torch.bool"),
        (lambda: sim.reset(every, q[:1], poses), ValueError, r"expected \(3, 9\)"),
    ):
        with pytest.raises(error, match=words):
            call()
    assert torch.equal(state(sim), before)
    with pytest.raises(ValueError, match="scenes"):
        load()
    sim.close()
    sim.close()
    for call in (lambda: sim.step(q), lambda: sim.reset(every, q, poses)):
        with pytest.raises(SimulationError, match="closed"):
            call()


def block_scene(height, mass=0.1):
    return Scene(
        robot("prims"), Pose((5.0, 0.0, 0.0)), Block((0.1,) * 3, Pose((0, 0, height)), mass)
    )


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_blocks_fall_freely_and_come_to_rest(load):
    sim = held(load(block_scene(1.0)), 10)
    fallen = GRAVITY * TIMESTEP**2 * 40 * 41 / 2
    assert sim.block_pose[0, 2] == pytest.approx(1.0 - fallen, abs=1e-5)
    assert sim.block_velocity[0, 2] == pytest.approx(-GRAVITY * 0.2, rel=1e-5)
    held(sim, 100)
    assert sim.block_pose[0, 2] == pytest.approx(0.05, abs=1e-3)
    assert sim.block_velocity.abs().max() < 1e-3


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_a_block_without_mass_stays_where_a_reset_puts_it(load):
    sim = load(block_scene(0.5, mass=0.0))
    pose = torch.tensor([[0.1, 0.2, 0.7, 0.0, 1.0, 0.0, 0.0]])
    reset_envs(sim, [0], sim.q.clone(), pose)
    held(sim, 20)
    torch.testing.assert_close(sim.block_pose, pose)
    assert not sim.block_velocity.any()

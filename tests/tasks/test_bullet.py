"""PyBullet in one process: padding, resets, errors and closing."""

import gc
import re

import numpy as np
import pytest
import torch

from helpers.scenes import mixed_scenes, push_scene, reach_scene, real_arm_scene
from morphgen.errors import SimulationError

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from helpers.pybullet_states import PUSHING, client_of, reset, starts, state, touching, wander
from morphgen.tasks.sim import bullet
from morphgen.tasks.sim.bullet import BulletSimulation


def test_state_tensors_are_padded_and_reused(simulate):
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


def test_padding_of_targets_is_ignored(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    q[1, 5:] = torch.nan
    simulation.step(q)
    assert torch.isfinite(simulation.q).all()


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


def test_touching_starts_are_in_contact(simulate):
    """The test above needs contacts."""
    simulation = simulate(push_scene())
    q, pose = touching_starts(push_scene(), 0)
    simulation.step(reset(simulation, q, pose))
    loaded = client_of(simulation)
    bodies = {frozenset((a, b)) for (a, _), (b, _) in touching(simulation)}
    assert frozenset((loaded.robot, loaded.block)) in bodies


@pytest.mark.slow
def test_environment_is_bit_identical_alone_and_in_a_batch(simulate):
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


def test_partial_reset_does_not_change_other_environments(simulate):
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


def test_reset_reports_the_state(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    assert torch.equal(simulation.q, q)
    assert not simulation.qd.any()
    _, pose = starts(simulation)
    assert torch.allclose(simulation.block_pose, pose, atol=1e-6)


def test_robot_file_is_written_once(simulate, monkeypatch):
    written = []
    original = bullet.write_bundle

    def counted(body, *args, **options):
        written.append(body)
        return original(body, *args, **options)

    monkeypatch.setattr(bullet, "write_bundle", counted)
    simulate(*mixed_scenes(), *mixed_scenes())
    assert len(written) == 3


def test_diverged_environment_is_reported_and_can_be_reset(simulate):
    simulation = simulate(*mixed_scenes())
    q = reset(simulation)
    simulation.step(q)
    loaded = client_of(simulation, 2)
    pybullet.resetJointState(loaded.robot, loaded.driven[0], np.nan, physicsClientId=loaded.id)
    assert simulation.step(q).tolist() == [False, False, True]
    assert list(simulation.faults()) == [2]
    message = r"environment 2 \('ur5-plane'\).* step 2 after"
    assert re.match(message, simulation.faults()[2])
    with pytest.raises(SimulationError, match=message + r".*expected a reset"):
        simulation.step(q)
    reset(simulation, envs=torch.tensor([2]))
    fresh = simulate(real_arm_scene())
    reset(fresh)
    assert not simulation.step(q + 0.01).any()
    assert simulation.faults() == {}
    fresh.step(q[2:, :6] + 0.01)
    assert torch.equal(simulation.q[2, :6], fresh.q[0])


def test_invalid_arguments_are_rejected_before_stepping(simulate):
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
    with pytest.raises(ValueError, match=r"mask of shape \(1,\).*; expected \(3,\)"):
        simulation.reset(torch.ones(1, dtype=torch.bool), q[:1], torch.zeros(1, 7))
    assert torch.equal(state(simulation), before)


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

"""PyBullet in one process: padding, resets, errors and closing."""

import gc

import numpy as np
import pytest
import torch

from helpers.scenes import mixed_scenes, push_scene, reach_scene, real_arm_scene
from morphgen.errors import SimulationError

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
import pybullet

from helpers.pybullet_states import PUSHING, client_of, reset, touching, wander
from morphgen.tasks.sim import bullet
from morphgen.tasks.sim.bullet import BulletSimulation


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


def test_robot_file_is_written_once(simulate, monkeypatch):
    written = []
    original = bullet.write_bundle

    def counted(body, *args, **options):
        written.append(body)
        return original(body, *args, **options)

    monkeypatch.setattr(bullet, "write_bundle", counted)
    simulate(*mixed_scenes(), *mixed_scenes())
    assert len(written) == 3


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

"""A finger pushes a block with the same force and motion in both simulators."""

import numpy as np
import pytest
import torch

from helpers.resets import reset_envs
from helpers.robots import finger
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.geometry import Pose
from morphgen.tasks.sim.base import CONTROL_PERIOD, GRAVITY, Block, Scene
from morphgen.tasks.sim.motor_law import GAIN
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
from morphgen.tasks.sim.bullet import BulletSimulation

EDGE = 0.08


@pytest.fixture(params=[BulletSimulation, MujocoSimulation])
def simulator(request):
    return request.param


def pushed(simulator, block_mass, speed, way, finger_mass=2.0, height=0.3):
    """Rows of (lag of the finger, rise of the block, its tilt), and how far it got, metres, rad."""
    block = Block((EDGE, EDGE, EDGE), Pose((0.0, 0.0, EDGE / 2)), block_mass)
    simulation = simulator([Scene(finger(finger_mass), block=block)])
    try:
        q = torch.tensor([[-EDGE / 2 - 0.011, height * EDGE]])
        pose = torch.tensor([[0.0, 0.0, EDGE / 2, 1.0, 0.0, 0.0, 0.0]])
        reset_envs(simulation, [0], q, pose)
        rows = []
        for _ in range(round((way + 0.004) / speed / CONTROL_PERIOD)):
            q[:, 0] += speed * CONTROL_PERIOD
            simulation.step(q)
            _, _, z, _, x, y, _ = simulation.block_pose[0].tolist()
            tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))
            rows.append((float(q[0, 0] - simulation.q[0, 0]), z - EDGE / 2, tilt))
        return np.array(rows), float(simulation.block_pose[0, 1])
    finally:
        simulation.close()


@pytest.mark.parametrize(("block_mass", "finger_mass"), [(3.0, 2.0), (6.0, 2.0), (6.0, 4.0)])
def test_finger_deflection_matches_its_stiffness(simulator, block_mass, finger_mass):
    speed = 0.02
    rows, _ = pushed(simulator, block_mass, speed, 0.06, finger_mass)
    load = block_mass * GRAVITY / (GAIN * BANDWIDTH**2 * (finger_mass + 0.2))
    free = 2 * speed / BANDWIDTH
    lag = rows[len(rows) // 2 :, 0].mean()
    assert lag == pytest.approx(free + load, rel=0.35)


def test_pushed_block_stays_on_the_ground(simulator):
    rows, far = pushed(simulator, 0.1, 0.3, 0.25)
    assert far > 0.2
    assert rows[:, 1].max() < 1e-3
    assert np.degrees(rows[:, 2].max()) < 3

"""Links whose height and tilt never change, and their ground contacts in the simulators."""

import numpy as np
import pytest
import torch

from helpers.resets import reset_envs
from helpers.scenes import robot
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import forward_kinematics, joint_limits
from morphgen.tasks.sim.base import Block, Contacts, Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation
from morphgen.tasks.sim.rigid_bodies import ground_contact_links

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
from morphgen.tasks.sim.bullet import BulletSimulation

ARM = "arm=arm3 ee=claw"


@pytest.mark.parametrize(
    ("request_", "roll", "count"),
    [(ARM, 0.0, 2), (ARM, 0.1, 1), ("arm=ur5 ee=plane", 0.0, None), ("planar_arm", 0.0, None)],
)
def test_level_links_have_constant_height_and_tilt(request_, roll, count):
    body, T_world_root = robot(request_), Pose.from_xyz_rpy(rpy=(roll, 0.0, 0.0))
    drawn = np.random.default_rng(0).uniform(*joint_limits(body).T, (9, body.dof))
    T_world_link = T_world_root.matrix @ np.array([forward_kinematics(body, q) for q in drawn])
    moved = np.ptp(T_world_link[:, :, 2], axis=0).max(axis=1)
    steady = {link.name for link, by in zip(body.links, moved, strict=True) if by < 1e-9}
    assert ground_contact_links(body, T_world_root) == steady
    assert count is None or len(steady) == count


@pytest.mark.parametrize("simulation", [MujocoSimulation, BulletSimulation])
def test_turntable_on_the_ground_does_not_disturb_the_arm(simulation):
    """The disc of arm3 rests on the ground and no joint changes its height."""
    body = robot(ARM)
    block = Block((0.1, 0.1, 0.1), Pose((0.0, -0.7, 0.05)), mass=0.1)
    n = 16
    scene = Scene(body, block=block)
    places = torch.tensor([*block.pose.position, *block.pose.quaternion]).repeat(n, 1)
    q = torch.tensor(body.home, dtype=torch.float32).repeat(n, 1)
    q[:, 0] = torch.linspace(0.2, 2.0, n)
    paths = []
    for contacts in (Contacts(self_collision=False), Contacts(False, False)):
        sim = simulation([scene] * n, contacts)
        reset_envs(sim, torch.arange(n), q, places)
        path = []
        for i in range(1, 16):
            turned = q.clone()
            turned[:, 0] += 0.05 * i
            turned[:, 3] -= 0.03 * i
            sim.step(turned)
            path.append(sim.q.clone())
        sim.close()
        paths.append(torch.stack(path))
    torch.testing.assert_close(*paths, atol=1e-4, rtol=0)


@pytest.mark.parametrize("simulation", [MujocoSimulation, BulletSimulation])
def test_links_on_a_turntable_collide_with_obstacles(simulation):
    """The horizontally stretched arm is stopped by a post."""
    body = robot("arm=arm3 ee=claw arm.length=0.3")
    q = torch.tensor([body.home], dtype=torch.float32)
    q[0, 1:4] = torch.tensor([0.0, 0.0, 0.0])
    post = Block((0.05, 0.05, 0.4), Pose((0.25, 0.35, 0.2)))
    places = torch.zeros(1, 7)
    for obstacles in ((), (post,)):
        sim = simulation([Scene(body, obstacles=obstacles)], Contacts(self_collision=False))
        reset_envs(sim, [0], q, places)
        for i in range(1, 40):
            turned = q.clone()
            turned[0, 0] = min(float(q[0, 0]) + 0.05 * i, 3.1)
            sim.step(turned)
        base = float(sim.q[0, 0])
        sim.close()
        assert (base > 3.0) == (not obstacles)

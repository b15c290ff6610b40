"""MuJoCo simulation: the block, the ground and contacts of the robot with itself."""

import math

import numpy as np
import pytest
import torch

from helpers.joint_targets import held
from helpers.resets import reset_envs
from helpers.scenes import reach_scene, robot
from morphgen.errors import SimulationError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import joint_limits
from morphgen.tasks.sim.base import GRAVITY, Block, Contacts, Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation


def block_scene(block, **rest):
    return Scene(robot("prims"), Pose((5.0, 0.0, 0.0)), block=block, **rest)


@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_friction_is_that_of_the_block(friction):
    """The slope is 10 % steeper or flatter than the friction limit."""
    travelled = []
    for share in (0.9, 1.1):
        angle = math.atan(friction * share)
        ramp = Pose.from_xyz_rpy((0, 0, 3.0), (angle, 0, 0))
        block = Block((0.1,) * 3, ramp @ Pose((0, 0, 0.1)), 0.1, friction)
        sim = MujocoSimulation(
            [block_scene(block, obstacles=(Block((2, 4, 0.1), ramp, friction=0.9),))]
        )
        held(sim, 50)
        before = sim.block_pose[0, :3].clone()
        held(sim, 25)
        travelled.append((sim.block_pose[0, :3] - before).norm().item())
    slide = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
    assert travelled[0] < 1e-3
    assert travelled[1] == pytest.approx(slide / 2 * (1.5**2 - 1), rel=0.05)


def test_spin_is_in_the_world_frame():
    """A block that leans on an edge topples about the world's x, however it is turned itself."""
    lean = Pose.from_xyz_rpy((0, 0, 0.15), (-0.9, 0, 0))
    turned = lean @ Pose.from_xyz_rpy((0, 0, 0), (0, 0, math.pi / 2))
    spins = []
    for pose in (lean, turned):
        sim = held(MujocoSimulation([block_scene(Block((0.2,) * 3, pose, 0.1))]), 8)
        spins.append(sim.block_velocity[0, 3:].tolist())
    assert abs(spins[0][0]) > 0.5
    assert spins[1] == pytest.approx(spins[0], abs=0.02)


@pytest.mark.parametrize(
    ("contacts", "lowest"), [(Contacts(), -0.02), (Contacts(scene=False), -10.0)]
)
def test_ground_contacts_are_optional(contacts, lowest):
    sim = MujocoSimulation([Scene(robot("prims"), Pose((0, 0, -0.5)))], contacts)
    q = sim.q.clone()
    depth = sim.scenes[0].robot.joint_index["gantry_z"]
    column = sim.scenes[0].robot.independent_joints.index(depth)
    for _ in range(60):
        q[0, column] = max(q[0, column] - 0.02, 0.2)
        sim.step(q)
    reached = sim.q[0, column].item()
    assert (reached < 0.21) == (lowest < -1)


def test_self_contacts_are_optional_and_respect_ignored_pairs():
    body = robot("arm=panda ee=panda_hand")
    q = np.clip(np.array([0, 1.2, 0, -3.0, 0, 0.2, 0.8, 0.0]), *joint_limits(body).T)
    counts = []
    for contacts in (Contacts(), Contacts(self_collision=False)):
        sim = MujocoSimulation([Scene(body, ground=None)], contacts)
        held(sim, 1)
        assert sim._data[0].ncon == 0
        reset_envs(sim, [0], torch.from_numpy(q[None]))
        held(sim, 1)
        counts.append(sim._data[0].ncon)
    assert counts[0] > 0
    assert counts[1] == 0


def test_mujoco_errors_become_one_line():
    scene = block_scene(Block((0.1, 0.0, 0.1), mass=0.1))
    with pytest.raises(
        SimulationError, match=r"environment 1, robot 'prims.*MuJoCo refuses"
    ) as info:
        MujocoSimulation([reach_scene(), scene])
    assert "\n" not in str(info.value)

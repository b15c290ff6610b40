"""The same joint targets lead to the same states in PyBullet and MuJoCo."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.joint_targets import SECOND, smooth_walk
from helpers.resets import reset_envs
from helpers.scenes import PAPER_ROBOTS, push_scene, robot
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import frame_pose
from morphgen.tasks.sim.base import CONTROL_PERIOD, Block, Contacts, Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

pytest.importorskip("pybullet", reason="PyBullet has no wheel for this Python")
from morphgen.tasks.sim.bullet import BulletSimulation

SIMULATIONS = (MujocoSimulation, BulletSimulation)
IN_FREE_SPACE = Contacts(scene=False, self_collision=False)

SOME = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "arm3", "prims", "chain beads=2")
FAST = [pytest.param(words, id=words) for words in SOME]
SLOW = [pytest.param(words, id=words, marks=pytest.mark.slow) for words in PAPER_ROBOTS]


def begun(simulation, scene, q, contacts=None):
    """Return a simulation of one scene, reset to a state."""
    sim = simulation([scene], contacts)
    block = scene.block.pose if scene.block is not None else Pose()
    reset_envs(sim, [0], torch.tensor([q]), torch.tensor([(*block.position, *block.quaternion)]))
    return sim


def positions(simulation, scene, targets, contacts):
    """Return the joint positions after every step, (steps, dof)."""
    sim = begun(simulation, scene, scene.robot.home, contacts)
    path = []
    for target in torch.from_numpy(targets).float():
        sim.step(target[None])
        path.append(sim.q[0].double().numpy().copy())
    sim.close()
    return np.array(path)


@pytest.mark.parametrize("words", [*FAST, *SLOW])
def test_tool_paths_agree_in_free_space(words):
    body = robot(words)
    for seed in range(3):
        targets = smooth_walk(body, seed)
        mujoco, bullet = (
            frame_pose(body, positions(each, Scene(body, ground=None), targets, IN_FREE_SPACE))
            for each in SIMULATIONS
        )
        apart = np.linalg.norm(mujoco[:, :3, 3] - bullet[:, :3, 3], axis=1)
        assert apart.max() < 0.01, f"seed {seed}: {1e3 * apart.max():.1f} mm"
        home = frame_pose(body, body.home)[:3, 3]
        assert np.linalg.norm(mujoco[:, :3, 3] - home, axis=1).max() > 0.05


@pytest.mark.parametrize(
    ("edge", "mass", "turn"),
    [(0.15, 0.1, (0, 0, 0.4)), (0.15, 0.1, (0.2, 0.1, 0.0)), (0.06, 0.5, (0.0, 0.3, 1.0))],
)
def test_dropped_blocks_come_to_rest_at_the_same_pose(edge, mass, turn):
    start = Pose.from_xyz_rpy((0.3, -0.4, edge + 0.05), turn)
    scene = Scene(robot("prims"), Pose((5, 0, 0)), Block((edge,) * 3, start, mass))
    ends = []
    for simulation in SIMULATIONS:
        sim = begun(simulation, scene, scene.robot.home)
        q = sim.q.clone()
        for _ in range(2 * SECOND):
            sim.step(q)
        assert sim.block_velocity.abs().max() < 0.01
        ends.append(sim.block_pose[0].clone())
        sim.close()
    assert ends[0][2].item() == pytest.approx(edge / 2, abs=1e-3)
    assert ends[1][2].item() == pytest.approx(edge / 2, abs=1e-3)
    assert (ends[0][:2] - ends[1][:2]).norm() < 0.02
    assert (ends[0][3:] * ends[1][3:]).sum().abs() > 0.995


@pytest.mark.parametrize("friction", [0.5, 1.0])
@pytest.mark.parametrize("aside", [0.0, 0.03])
def test_pushed_blocks_move_the_same_distance(friction, aside):
    """The gantry's vertical plate pushes the block at 0.2 m/s without touching the ground."""
    scene = replace(push_scene(friction=friction), obstacles=())
    ends = []
    for simulation in SIMULATIONS:
        sim = begun(simulation, scene, (aside, -0.2, 0.62, np.pi / 2, 0.0))
        target = sim.q.clone()
        for _ in range(2 * SECOND):
            target[0, 1] += 0.2 * CONTROL_PERIOD
            sim.step(target)
        ends.append(sim.block_pose[0].clone())
        sim.close()
    assert ends[0][1] > 0.2
    assert (ends[0][:3] - ends[1][:3]).norm() < 0.02
    assert (ends[0][3:] * ends[1][3:]).sum().abs() > 0.995

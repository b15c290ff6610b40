"""The same joint targets lead to the same states in PyBullet and MuJoCo, also under contact."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.joint_targets import SECOND, smooth_walk
from helpers.resets import reset_envs
from helpers.robots import finger
from helpers.scenes import PAPER_ROBOTS, push_scene, robot
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import forward_kinematics, frame_pose, joint_limits
from morphgen.tasks.sim.base import CONTROL_PERIOD, GRAVITY, Block, Contacts, Scene
from morphgen.tasks.sim.motor_law import GAIN
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation
from morphgen.tasks.sim.rigid_bodies import ground_contact_links

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


EDGE = 0.08


@pytest.fixture(params=SIMULATIONS)
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

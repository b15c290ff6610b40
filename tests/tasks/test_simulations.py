"""Simulators: what all have in common, and MuJoCo."""

import math
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
import pytest
import torch

from helpers.faulty_robots import with_joint
from helpers.robots import arm, finger
from helpers.scenes import (
    PAPER_ROBOTS,
    PYBULLET,
    SECOND,
    drive,
    held,
    homes,
    mixed_scenes,
    needs_pybullet,
    push_scene,
    put_home,
    reach_scene,
    real_arm_scene,
    reset_envs,
    robot,
    smooth_walk,
    state,
)
from morphgen.checks.self_collision import adjacent_pairs, untested_pairs
from morphgen.errors import SimulationError
from morphgen.formats.mjcf.write import to_spec
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import sample_robot
from morphgen.model.dynamics import BANDWIDTH, armature, mass_matrix, movable_mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    forward_kinematics,
    frame_pose,
    joint_limits,
    movable_positions,
)
from morphgen.model.robot import Inertial, Joint, Link, Mimic, Robot
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.sim import mujoco_model
from morphgen.tasks.sim.articulated import ground_contact_links, merge_rigid_links
from morphgen.tasks.sim.base import (
    CONTROL_PERIOD,
    GAIN,
    GRAVITY,
    SUBSTEPS,
    TIMESTEP,
    Block,
    Contacts,
    Scene,
)
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

ALL, WITH_CONTACTS = ("kinematic", "mujoco", PYBULLET), ("mujoco", PYBULLET)
NOTHING_TOUCHES = Contacts(False, False)


@pytest.fixture
def load_in(opened):
    """Create simulations of scenes in a simulator, reset to their homes."""

    def of(name, *scenes, contacts=None):
        loaded = opened(SIMULATORS[name].load(scenes, contacts, 1, torch.device("cpu")))
        put_home(loaded)
        return loaded

    return of


@pytest.fixture
def load(sim, load_in):
    return partial(load_in, sim)


@pytest.fixture
def load_both(load_in):
    return lambda *args, **options: [
        load_in(name, *args, **options) for name in ("mujoco", "pybullet")
    ]


@pytest.fixture
def scenes(sim):
    """Three scenes of different robots, one of them with a block and obstacles if there can be."""
    if SIMULATORS[sim].simulates_contacts:
        return mixed_scenes()
    return [replace(scene, object=None, obstacles=()) for scene in mixed_scenes()]


def break_physics(sim, env):
    """Set a velocity or position to nan."""
    if isinstance(sim, MujocoSimulation):
        sim._data[env].qvel[0] = math.nan
    else:
        import pybullet

        at = sim._loaded[env]
        pybullet.resetJointState(at.robot, at.driven[0], math.nan, physicsClientId=at.id)


@pytest.mark.parametrize("sim", ALL)
def test_states_are_at_home_and_padded(load, scenes):
    sim = load(*scenes)
    q, poses = homes(sim)
    assert torch.equal(sim.q, q)
    assert sim.q.shape == sim.qd.shape == (3, 9)
    torch.testing.assert_close(sim.object_pose, poses)
    assert sim.object_velocity.shape == (3, 3)
    assert sim.q.dtype == sim.object_pose.dtype == torch.float32
    targets = q.clone()
    targets[1, 5:] = torch.nan  # padding is ignored
    assert not sim.step(targets).any()
    assert sim.q.isfinite().all()
    assert not sim.q[1, 5:].any()
    assert not sim.qd[1, 5:].any()


@pytest.mark.parametrize("sim", ALL)
def test_a_reset_forgets_the_past_and_leaves_other_environments(load, scenes):
    used, other, fresh = (load(*scenes) for _ in range(3))
    for each in (used, other):
        drive(each, 40, seed=5)
    before = state(used)
    put_home(used, [1])
    assert torch.equal(state(used)[[0, 2]], before[[0, 2]])
    for each in (used, other):
        drive(each, 5)
    assert torch.equal(state(used)[[0, 2]], state(other)[[0, 2]])
    assert not torch.equal(state(used)[1], state(other)[1])
    put_home(used)
    assert torch.equal(state(used), state(fresh))
    for each in (used, fresh):
        drive(each, 60)
    assert torch.equal(state(used), state(fresh))


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
            assert torch.equal(together.object_pose[same], alone.object_pose[0])
            assert torch.equal(together.object_velocity[same], alone.object_velocity[0])


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
    assert torch.equal(state(sim)[:2], state(whole)[:2])
    put_home(sim, [2])
    put_home(whole, [2])
    assert not sim.step(q + 0.01).any()
    whole.step(q + 0.01)
    assert torch.equal(state(sim), state(whole))


@pytest.mark.parametrize("sim", ALL)
def test_invalid_arguments_change_nothing(load, scenes):
    sim = load(*scenes)
    q, poses = homes(sim)
    bad, before = q.clone(), state(sim)
    bad[2, 3] = torch.inf
    for call, words in (
        (lambda: sim.step(bad), "environment 2 .*target"),
        (lambda: sim.step(q[:, :4]), r"shape \(3, 4\)"),
        (lambda: reset_envs(sim, [2], bad[2:], poses[2:]), "environment 2 .*reset to"),
    ):
        with pytest.raises(ValueError, match=words):
            call()
    assert torch.equal(state(sim), before)
    sim.close()
    sim.close()
    for call in (lambda: sim.step(q), lambda: reset_envs(sim, [0], q[:1], poses[:1])):
        with pytest.raises(SimulationError, match="closed"):
            call()


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_blocks_fall_freely_and_come_to_rest(load):
    sim = held(load(block_on_arm(Block((0.1,) * 3, Pose((0, 0, 1.0)), 0.1))), 10)
    fallen = GRAVITY * TIMESTEP**2 * 40 * 41 / 2
    assert sim.object_pose[0, 2] == pytest.approx(1.0 - fallen, abs=1e-5)
    assert sim.object_velocity[0, 2] == pytest.approx(-GRAVITY * 0.2, rel=1e-5)
    held(sim, 100)
    assert sim.object_pose[0, 2] == pytest.approx(0.05, abs=1e-3)
    assert sim.object_velocity.abs().max() < 1e-3


def block_on_arm(block, **rest):
    """A scene with a block, whose robot is far away."""
    return Scene(robot("prims"), Pose((5.0, 0.0, 0.0)), object=block, **rest)


SOME = ("arm=ur5 ee=plane", "arm=panda ee=panda_hand", "arm3", "prims", "chain beads=2")


@needs_pybullet
@pytest.mark.parametrize(
    "words", [*SOME, *(pytest.param(words, marks=pytest.mark.slow) for words in PAPER_ROBOTS)]
)
def test_tool_paths_agree_in_free_space(load_both, words):
    body = robot(words)
    home = frame_pose(body, body.home)[:3, 3]
    for seed in range(3):
        paths = []
        for sim in load_both(Scene(body, ground=None), contacts=NOTHING_TOUCHES):
            path = []
            for target in torch.from_numpy(smooth_walk(body, seed)).float():
                sim.step(target[None])
                path.append(sim.q[0].double().numpy().copy())
            paths.append(frame_pose(body, np.array(path))[:, :3, 3])
        apart = np.linalg.norm(paths[0] - paths[1], axis=1)
        assert apart.max() < 0.01, f"seed {seed}: {1e3 * apart.max():.1f} mm"
        assert np.linalg.norm(paths[0] - home, axis=1).max() > 0.05


def assert_blocks_agree(sims):
    ends = [sim.object_pose[0] for sim in sims]
    assert (ends[0][:3] - ends[1][:3]).norm() < 0.02
    assert (ends[0][3:] * ends[1][3:]).sum().abs() > 0.995


@needs_pybullet
@pytest.mark.parametrize(
    ("edge", "mass", "turn"),
    [(0.15, 0.1, (0, 0, 0.4)), (0.15, 0.1, (0.2, 0.1, 0.0)), (0.06, 0.5, (0.0, 0.3, 1.0))],
)
def test_dropped_blocks_come_to_rest_at_the_same_pose(load_both, edge, mass, turn):
    start = Pose.from_xyz_rpy((0.3, -0.4, edge + 0.05), turn)
    sims = load_both(block_on_arm(Block((edge,) * 3, start, mass)))
    for sim in sims:
        held(sim, 2 * SECOND)
        assert sim.object_velocity.abs().max() < 0.01
        assert sim.object_pose[0, 2].item() == pytest.approx(edge / 2, abs=1e-3)
    assert_blocks_agree(sims)


@needs_pybullet
@pytest.mark.parametrize("friction", [0.5, 1.0])
@pytest.mark.parametrize("aside", [0.0, 0.03])
def test_pushed_blocks_move_the_same_distance(load_both, friction, aside):
    """The gantry's vertical plate pushes the block at 0.2 m/s without touching the ground."""
    scene = replace(push_scene(friction=friction), obstacles=())
    body = replace(scene.robot, home=(aside, -0.2, 0.62, np.pi / 2, 0.0))
    sims = load_both(replace(scene, robot=body))
    for sim in sims:
        target = sim.q.clone()
        for _ in range(2 * SECOND):
            target[0, 1] += 0.2 * CONTROL_PERIOD
            sim.step(target)
    assert sims[0].object_pose[0, 1] > 0.2
    assert_blocks_agree(sims)


EDGE = 0.08


def pushed(load, block_mass, speed, way, finger_mass=2.0):
    """Return the simulation, and rows of the lag of the finger, rise and tilt of the block."""
    block = Block((EDGE, EDGE, EDGE), Pose((0.0, 0.0, EDGE / 2)), block_mass)
    body = replace(finger(finger_mass), home=(-EDGE / 2 - 0.011, 0.3 * EDGE))
    sim, rows = load(Scene(body, object=block)), []
    q = sim.q.clone()
    for _ in range(round((way + 0.004) / speed / CONTROL_PERIOD)):
        q[:, 0] += speed * CONTROL_PERIOD
        sim.step(q)
        _, _, z, _, x, y, _ = sim.object_pose[0].tolist()
        tilt = np.arccos(np.clip(1 - 2 * (x * x + y * y), -1, 1))
        rows.append((float(q[0, 0] - sim.q[0, 0]), z - EDGE / 2, tilt))
    return sim, np.array(rows)


@pytest.mark.parametrize("sim", WITH_CONTACTS)
@pytest.mark.parametrize(("block_mass", "finger_mass"), [(3.0, 2.0), (6.0, 2.0), (6.0, 4.0)])
def test_finger_deflection_matches_its_stiffness(load, block_mass, finger_mass):
    speed = 0.02
    _, rows = pushed(load, block_mass, speed, 0.06, finger_mass)
    deflection = block_mass * GRAVITY / (GAIN * BANDWIDTH**2 * (finger_mass + 0.2))
    free = 2 * speed / BANDWIDTH
    assert rows[len(rows) // 2 :, 0].mean() == pytest.approx(free + deflection, rel=0.35)


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_pushed_block_stays_on_the_ground(load):
    sim, rows = pushed(load, 0.1, 0.3, 0.25)
    assert sim.object_pose[0, 1] > 0.2
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


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_turntable_on_the_ground_does_not_disturb_the_arm(load):
    """The disc of arm3 rests on the ground and no joint changes its height."""
    block = Block((0.1, 0.1, 0.1), Pose((0.0, -0.7, 0.05)), mass=0.1)
    body, turns = robot(ARM), np.linspace(0.2, 2.0, 16).tolist()
    scenes = [Scene(replace(body, home=(t, *body.home[1:])), object=block) for t in turns]
    paths = []
    for contacts in (Contacts(self_collision=False), NOTHING_TOUCHES):
        sim, path = load(*scenes, contacts=contacts), []
        turned = sim.q.clone()
        for _ in range(15):
            turned[:, 0] += 0.05
            turned[:, 3] -= 0.03
            sim.step(turned)
            path.append(sim.q.clone())
        paths.append(torch.stack(path))
    torch.testing.assert_close(*paths, atol=1e-4, rtol=0)


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_links_on_a_turntable_collide_with_obstacles(load):
    """The horizontally stretched arm is stopped by a post."""
    body = robot("arm=arm3 ee=claw arm.length=0.3")
    body = replace(body, home=(body.home[0], 0.0, 0.0, 0.0, *body.home[4:]))
    post = Block((0.05, 0.05, 0.4), Pose((0.25, 0.35, 0.2)))
    for obstacles in ((), (post,)):
        sim = load(Scene(body, obstacles=obstacles), contacts=Contacts(self_collision=False))
        turned = sim.q.clone()
        for _ in range(39):
            turned[0, 0] = min(float(turned[0, 0]) + 0.05, 3.1)
            sim.step(turned)
        assert (sim.q[0, 0] > 3.0) == (not obstacles)


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_a_simulated_robot_meets_obstacles_where_they_were_moved(load):
    """A cube with edges of 0.11 m on slides moves towards a wall."""
    wall = Block((0.1, 1.0, 1.0), Pose((5.0, 0.0, 0.5)))
    scene = Scene(robot("cubes"), obstacles=(wall,))
    simulation = load(scene, scene)
    zeros, q = torch.zeros(2, 7), torch.zeros(2, 2)
    near, far = (torch.tensor([[[x, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0]]]) for x in (0.4, 5.0))

    def positions():
        for _ in range(60):
            simulation.step(torch.tensor([[0.9, 0.0]] * 2))
        return simulation.q[:, 0].tolist()

    both = [0, 1]
    reset_envs(simulation, both, q, zeros, torch.cat([near, far]))
    assert positions() == pytest.approx([0.295, 0.9], abs=0.01)
    reset_envs(simulation, both, q, zeros)  # obstacles stay
    assert positions() == pytest.approx([0.295, 0.9], abs=0.01)
    reset_envs(simulation, [1], q[1:], zeros[1:], near)
    reset_envs(simulation, [0], q[:1], zeros[:1], far)
    assert positions() == pytest.approx([0.9, 0.295], abs=0.01)
    with pytest.raises(ValueError, match="obstacles"):
        reset_envs(simulation, both, q, zeros, torch.full((2, 1, 7), np.nan))


@pytest.mark.parametrize("sim", WITH_CONTACTS)
def test_a_moved_obstacle_gives_the_bits_of_a_loaded_one(load):
    """A cube on slides pushes a block against a turned wall."""
    pose = Pose.from_xyz_rpy((0.5, 0.25, 0.125), (0.0, 0.0, 0.5))
    walls = [Block((0.125, 0.5, 0.25), each) for each in (pose, Pose((0.5, 4.0, 0.125)))]
    block = Block((0.125, 0.125, 0.125), Pose((0.25, 0.25, 0.0625)), mass=0.1)
    loaded, moved = sims = [
        load(Scene(robot("cubes"), object=block, obstacles=(wall,))) for wall in walls
    ]
    at = torch.tensor([[[*pose.position, *pose.quaternion]]])
    object_pose = torch.tensor([[0.25, 0.25, 0.0625, 1.0, 0.0, 0.0, 0.0]])
    for sim in sims:
        reset_envs(sim, [0], torch.tensor([[0.0, 0.25]]), object_pose, at)
    for step in range(50):
        for sim in sims:
            sim.step(torch.tensor([[0.02 * step, 0.25]]))
    assert torch.equal(loaded.q, moved.q)
    assert torch.equal(loaded.object_pose, moved.object_pose)
    assert loaded.object_pose[0, 0] > 0.3


def test_mimic_joints_root_poses_and_joint_order_are_kept():
    body = replace(arm(), ignore_pairs=adjacent_pairs(arm()))
    at = Pose.from_xyz_rpy((0.3, -0.2, 0.5), (0.1, 0.2, 0.3))
    sim = MujocoSimulation([Scene(body, at)], NOTHING_TOUCHES)
    target = torch.tensor([[0.5, 0.4, 0.02, 0.03]])
    for _ in range(60):
        sim.step(target)
    assert sim.q[0].tolist() == pytest.approx(target[0].tolist(), abs=1e-3)
    model, data = sim._worlds[0].model, sim._data[0]
    assert data.joint("right").qpos[0] == pytest.approx(-0.03, abs=1e-3)
    assert data.body("base").xpos == pytest.approx(at.position)
    assert model.body("base").dofnum == 0


def test_results_are_bit_identical_for_any_thread_count():
    alone, *batches = (MujocoSimulation(mixed_scenes() * 5, threads=k) for k in (1, 2, 10**9))
    for sim in (alone, *batches):
        drive(sim, 30)
    for batch in batches:
        assert torch.equal(state(batch), state(alone))
        batch.close()


def test_divergence_leaves_no_log(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sim = MujocoSimulation(mixed_scenes(), threads=2)
    home = sim.q.clone()
    sim.step(home)
    sim._data[0].qvel[:] = sim._data[2].qvel[:] = 1e6
    assert sim.step(home).tolist() == [True, False, True]
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("memory", [10_750, 14_000], ids=["contacts", "stack"])
def test_contact_overflow_affects_only_its_environment(monkeypatch, memory):
    compiled = mujoco_model._robot_spec

    def cramped(*args):
        body, spec = compiled(*args)
        spec.memory = memory
        return body, spec

    monkeypatch.setattr(mujoco_model, "_robot_spec", cramped)
    sim = held(MujocoSimulation([push_scene(), push_scene()], threads=2), 3)
    q, inside = homes(sim)
    inside[1, :3] = torch.tensor([0.5, 0.2, 0.02])  # in an obstacle and the ground
    reset_envs(sim, [0, 1], q, inside)
    assert sim.step(q).tolist() == [False, True]
    put_home(sim)
    held(sim, 3)
    alone = held(MujocoSimulation([push_scene()]), 3)
    assert torch.equal(state(sim)[1], state(alone)[0])


@pytest.mark.parametrize(("value", "words"), [(0.0, "not a pose of a block"), (math.nan, "reset")])
def test_invalid_block_poses_are_rejected(value, words):
    sim = MujocoSimulation([push_scene()])
    with pytest.raises(ValueError, match=words):
        sim.reset(torch.tensor([True]), torch.zeros(1, 5), torch.full((1, 7), value))


@pytest.mark.parametrize("request_", ["chain beads=7", "arm=widowx ee=widowx_gripper"])
def test_full_speed_back_and_forth_is_stable(request_):
    """Strong motors move light links at their effort limits."""
    body = robot(request_)
    sim = MujocoSimulation([Scene(body, object=Block((0.1,) * 3, Pose((0.4, 0.2, 0.05)), 0.1))])
    rng = np.random.default_rng(3)
    target, limits = np.array(body.home), joint_limits(body)
    for k in range(200):
        if k % 3 == 0:
            sign = rng.choice([-1, 1], size=body.dof)
        speed = [min(body.joints[j].velocity or 10.0, 10.0) for j in body.independent_joints]
        target = np.clip(target + 0.02 * sign * np.array(speed), *limits.T)
        sim.step(torch.from_numpy(target[None]).float())
        assert sim.qd.abs().max() < 40


def scaled_eigenvalues(inertia):
    """Return eigenvalues of a joint-space inertia, scaled to a diagonal of ones."""
    diagonal = np.sqrt(np.diag(inertia))
    return np.linalg.eigvalsh(inertia / np.outer(diagonal, diagonal))


def compiled_inertia(body):
    """Return the joint-space inertia at home of a robot's compiled scene, with all armatures."""
    (world,) = mujoco_model.worlds([Scene(body)], NOTHING_TOUCHES)
    data = mujoco.MjData(world.model)
    data.qpos[world.movable_q_at] = movable_positions(world.robot, world.robot.home)
    mujoco.mj_forward(world.model, data)
    inertia = np.zeros((world.model.nv, world.model.nv))
    mujoco.mj_fullM(world.model, data, inertia)
    return inertia


@pytest.mark.parametrize("index", [23, 139, 304])
def test_joints_with_nearly_one_axis_have_inertia_against_each_other(index):
    library = default_library()
    body = sample_robot(load_grammar(find_grammar("serial")), library, index, seed=0).robot
    of_robot = movable_mass_matrix(body, body.home) + np.diag(armature(body))
    assert scaled_eigenvalues(of_robot)[0] < 0.001
    inertia = compiled_inertia(body)
    assert scaled_eigenvalues(inertia)[0] == pytest.approx(mujoco_model.LEAST_EIGENVALUE, rel=1e-3)
    # Motors have the gains of the robot: what is added is a small share of a joint's inertia.
    assert np.diag(inertia) == pytest.approx(np.diag(of_robot), rel=0.021)


@pytest.mark.parametrize("friction", [0.3, 0.6])
def test_friction_is_that_of_the_block(friction):
    """The slope is 10 % steeper or flatter than the friction limit."""
    travelled = []
    for share in (0.9, 1.1):
        angle = math.atan(friction * share)
        ramp = Pose.from_xyz_rpy((0, 0, 3.0), (angle, 0, 0))
        slope = Block((2, 4, 0.1), ramp, friction=0.9)
        block = Block((0.1,) * 3, ramp @ Pose((0, 0, 0.1)), 0.1, friction)
        sim = held(MujocoSimulation([block_on_arm(block, obstacles=(slope,))]), 50)
        before = sim.object_pose[0, :3].clone()
        held(sim, 25)
        travelled.append((sim.object_pose[0, :3] - before).norm().item())
    slide = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
    assert travelled[0] < 1e-3
    assert travelled[1] == pytest.approx(slide / 2 * (1.5**2 - 1), rel=0.05)


def test_self_contacts_are_optional_and_respect_ignored_pairs():
    body = robot("arm=panda ee=panda_hand")
    q = np.clip(np.array([0, 1.2, 0, -3.0, 0, 0.2, 0.8, 0.0]), *joint_limits(body).T)
    for self_collision in (True, False):
        contacts = Contacts(self_collision=self_collision)
        sim = held(MujocoSimulation([Scene(body, ground=None)], contacts), 1)
        assert sim._data[0].ncon == 0
        reset_envs(sim, [0], torch.from_numpy(q[None]))
        held(sim, 1)
        assert (sim._data[0].ncon > 0) is self_collision


def test_mujoco_errors_become_one_line():
    scene = block_on_arm(Block((0.1, 0.0, 0.1), mass=0.1))
    message = r"environment 1, robot 'prims.*MuJoCo refuses"
    with pytest.raises(SimulationError, match=message) as info:
        MujocoSimulation([reach_scene(), scene])
    assert "\n" not in str(info.value)


@pytest.mark.parametrize("request_", ["arm=ur5 ee=plane", "arm=panda ee=panda_hand", "chain"])
def test_merged_links_move_like_separate_ones(request_):
    body = robot(request_)
    merged = merge_rigid_links(body)
    rng = np.random.default_rng(0)
    for q in rng.normal(size=(3, body.dof)):
        np.testing.assert_allclose(mass_matrix(merged, q), mass_matrix(body, q), atol=1e-9)
    shapes = sum(len(link.collisions) for link in body.links)
    assert sum(len(link.collisions) for link in merged.links) == shapes
    assert len(merged.links) <= len(body.links)
    assert merged.home == body.home


@pytest.mark.parametrize("sim", WITH_CONTACTS)
@pytest.mark.parametrize("mass", [0.0, 5.0])
@pytest.mark.parametrize("shifted", [False, True])
def test_a_massive_link_may_be_welded_to_a_root_named_world(load, mass, shifted):
    body, world = arm(), Link("world", Inertial(mass) if mass else None)
    weld = Joint("weld", "fixed", "world", body.root.name, Pose((0, 0, 0.5 * shifted)))
    body = replace(body, links=(world, *body.links), joints=(weld, *body.joints))
    sim = load(Scene(body))
    assert not sim.step(sim.q.clone()).any()


def test_links_with_different_ignored_pairs_are_not_merged():
    """A fixed finger with other ignored pairs than its palm stays a separate body."""
    body = with_joint(with_joint(arm(), "right", mimic=None), "left", kind="fixed", limits=None)
    body = replace(body, ignore_pairs=(("base", "left"),))
    assert {"left", "slider"} <= {link.name for link in merge_rigid_links(body).links}
    joined = merge_rigid_links(replace(body, ignore_pairs=()))
    assert "left" not in {link.name for link in joined.links}
    assert joined.mass == pytest.approx(body.mass)


def test_adjacent_links_are_ignored_without_ignore_pairs():
    made = load_robot("arm3-stick")
    bare = replace(made, ignore_pairs=())
    assert set(untested_pairs(bare)) <= set(untested_pairs(made)) == set(made.ignore_pairs)
    _, tried = FreeSpace(Scene(bare, ground=-1.0)).sample(20, np.random.default_rng(0))
    assert tried < 200


MAX_ERROR = 0.02


def rod(name, leader, follower, parent, xyz, mass, length, gain=-1.0, axis=(0, 1, 0)):
    """Return a link along x, and its joint, which follows another one if there is a leader."""
    inertia = (mass * length**2 / 100, 0, 0, mass * length**2 / 12, 0, mass * length**2 / 12)
    strength = {"limits": (-1.5, 1.5), "effort": 600.0, "velocity": 2.0}
    joint = Joint(follower, "revolute", parent, name, Pose(xyz), axis, **strength)
    mimic = Mimic(leader, gain, 0.0) if leader else None
    return Link(name, Inertial(mass, (length / 2, 0, 0), inertia)), replace(joint, mimic=mimic)


def chain(*rods):
    links, joints = zip(*rods, strict=True)
    dof = sum(joint.mimic is None for joint in joints)
    return Robot("rods", (Link("base"), *links), joints, home=(0.0,) * dof)


def parallelogram():
    """A palletiser: a light knuckle that stays upright carries the motor of a heavy forearm."""
    return chain(
        rod("turret", None, "waist", "base", (0, 0, 0.3), 35, 0.3, axis=(0, 0, 1)),
        rod("upper", None, "shoulder", "turret", (0, 0, 0.2), 14, 0.6),
        rod("knuckle", "shoulder", "rod1", "upper", (0.6, 0, 0), 2, 0.1),
        rod("fore", None, "elbow", "knuckle", (0, 0, 0), 8, 0.6),
        rod("flange", "elbow", "rod2", "fore", (0.6, 0, 0), 2, 0.1),
        rod("spin", None, "wrist", "flange", (0.05, 0, 0), 0.8, 0.1, axis=(0, 0, 1)),
    )


def heavy_followers():
    """A leader of 20 g, which two jaws of 3 kg follow."""
    return chain(
        rod("arm", None, "shoulder", "base", (0, 0, 0.5), 5, 0.5),
        rod("gear", None, "crank", "arm", (0.5, 0, 0), 0.02, 0.02, axis=(0, 0, 1)),
        rod("left", "crank", "left_jaw", "arm", (0.5, 0.1, 0), 3, 0.3, axis=(0, 0, 1)),
        rod("right", "crank", "right_jaw", "arm", (0.5, -0.1, 0), 3, 0.3, 1.5, axis=(0, 0, 1)),
    )


ROBOTS = {
    "parallelogram": parallelogram,
    "heavy followers": heavy_followers,
    "robotiq_2f85": lambda: robot("arm=ur5 ee=robotiq_2f85"),
    "gen3_lite_2f": lambda: robot("arm=ur5 ee=gen3_lite_2f"),
}


def in_mjcf(body, targets):
    model = to_spec(body).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = targets
    joints = [model.joint(body.joints[k].name).qposadr[0] for k in body.movable_joints]
    for _ in range(round(1 / model.opt.timestep)):
        mujoco.mj_step(model, data)
        yield data.qpos[joints].copy()


def movable_q(simulation):
    """Return the positions of all movable joints, mimic joints included."""
    if isinstance(simulation, MujocoSimulation):
        return simulation._data[0].qpos[simulation._worlds[0].movable_q_at].copy()
    return simulation._law._positions.copy()


def in_environment(simulation, targets):
    for _ in range(SECOND):
        assert not simulation.step(torch.tensor(targets[None], dtype=torch.float32)).any()
        yield movable_q(simulation)
    assert simulation.q[0].numpy() == pytest.approx(targets, abs=MAX_ERROR)


def steps_from_home(body):
    for joint, k in enumerate(body.independent_joints):
        targets, limits = np.array(body.home), body.joints[k].limits
        targets[joint] += 0.2 if limits is None or targets[joint] + 0.2 < limits[1] else -0.2
        yield targets


def assert_followers_stay(body, steps):
    matrix, offset = body.mimic_map
    leaders = [body.movable_joints.index(k) for k in body.independent_joints]
    path = np.array(list(steps))
    assert np.abs(path - path[:, leaders] @ matrix.T - offset).max() < MAX_ERROR


@pytest.mark.parametrize("sim", ["mjcf", *WITH_CONTACTS])
@pytest.mark.parametrize("name", ROBOTS)
def test_followers_stay_with_their_leaders_when_a_joint_steps(load_in, name, sim):
    body = ROBOTS[name]()
    for targets in steps_from_home(body):
        if sim == "mjcf":
            steps = in_mjcf(body, targets)
        else:
            steps = in_environment(load_in(sim, Scene(body), contacts=NOTHING_TOUCHES), targets)
        assert_followers_stay(body, steps)


@needs_pybullet
@pytest.mark.parametrize("arm_name", ["xarm7", "ur3", "iiwa14"])
def test_light_fingers_stay_with_their_leader_when_the_arm_swings_them(load_in, arm_name):
    """Its fingertips are light: what parts them from their leader is mostly centrifugal force."""
    body = robot(f"arm={arm_name} ee=tiago_pro_gripper")
    for targets in steps_from_home(body):
        simulation = load_in("pybullet", Scene(body), contacts=NOTHING_TOUCHES)
        assert_followers_stay(body, in_environment(simulation, targets))

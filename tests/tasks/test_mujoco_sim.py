"""MuJoCo simulation: models, rigid links, divergence, threads, contacts of block and robot."""

import math
import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from helpers.joint_targets import drive, held
from helpers.resets import homes, put_home, reset_envs, state
from helpers.robots import arm
from helpers.scenes import mixed_scenes, push_scene, reach_scene, robot
from morphgen.checks.self_collision import adjacent_pairs, untested_pairs
from morphgen.errors import SimulationError
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.sampling import sample_robot
from morphgen.model.dynamics import armature, mass_matrix, movable_mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import joint_limits, movable_positions
from morphgen.model.robot import Inertial, Joint, Link
from morphgen.tasks.free_space import FreeSpace
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.env_specs import load_robot
from morphgen.tasks.sim import mujoco_model
from morphgen.tasks.sim.base import GRAVITY, Block, Contacts, Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links

NOTHING_TOUCHES = Contacts(scene=False, self_collision=False)


def test_mimic_joints_root_poses_and_joint_order_are_kept():
    body = arm()
    body = replace(body, ignore_pairs=adjacent_pairs(body))
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
    alone, *batches = (MujocoSimulation(mixed_scenes() * 5, threads=k) for k in (1, 2, 3))
    for sim in (alone, *batches):
        drive(sim, 30)
    for batch in batches:
        assert torch.equal(state(batch), state(alone))
        batch.close()


def test_divergence_leaves_no_log_and_names_the_step(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    sim = MujocoSimulation(mixed_scenes(), threads=2)
    home = sim.q.clone()
    sim.step(home)
    sim._data[0].qvel[:] = sim._data[2].qvel[:] = 1e6
    assert sim.step(home).tolist() == [True, False, True]
    name = sim.scenes[0].robot.name
    assert re.match(
        rf"environment 0 \(robot '{name}'\): .* in step 2: .*beyond 10000", sim.faults()[0]
    )
    assert list(Path(tmp_path).iterdir()) == []


@pytest.mark.parametrize(
    ("memory", "words"),
    [(10_750, "its contacts do not fit into MuJoCo's memory"), (14_000, "stack overflow")],
    ids=["contacts", "stack"],
)
def test_contact_overflow_affects_only_its_environment(monkeypatch, memory, words):
    compiled = mujoco_model._robot_spec

    def cramped(*args):
        body, spec = compiled(*args)
        spec.memory = memory
        return body, spec

    monkeypatch.setattr(mujoco_model, "_robot_spec", cramped)
    sim = MujocoSimulation([push_scene(), push_scene()], threads=2)
    q, inside = homes(sim)
    held(sim, 3)
    inside[1, :3] = torch.tensor([0.5, 0.2, 0.02])  # in an obstacle and the ground
    reset_envs(sim, [0, 1], q, inside)
    assert sim.step(q).tolist() == [False, True]
    (fault,) = sim.faults().values()
    assert re.match(rf"environment 1 \(robot 'prims'.*{words}", fault)
    assert "\n" not in fault
    put_home(sim)
    held(sim, 3)
    alone = held(MujocoSimulation([push_scene()]), 3)
    assert torch.equal(state(sim)[1], state(alone)[0])


@pytest.mark.parametrize(("value", "words"), [(0.0, "not a pose of a block"), (math.nan, "reset")])
def test_invalid_block_poses_are_rejected(value, words):
    sim = MujocoSimulation([push_scene()])
    with pytest.raises(ValueError, match=words):
        sim.reset(torch.tensor([True]), torch.zeros(1, 5), torch.full((1, 7), value))


def test_equal_scenes_share_one_model():
    scenes = [push_scene(), push_scene(), push_scene(mass=0.2), reach_scene()]
    moved = replace(scenes[0], object=replace(scenes[0].block, pose=Pose((0.3, 0, 0.1))))
    sim = MujocoSimulation([*scenes, moved])
    models = [id(world.model) for world in sim._worlds]
    assert models[0] == models[1] == models[4]
    assert len(set(models)) == 3


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


def block_scene(block, **rest):
    return Scene(robot("prims"), Pose((5.0, 0.0, 0.0)), object=block, **rest)


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
        before = sim.object_pose[0, :3].clone()
        held(sim, 25)
        travelled.append((sim.object_pose[0, :3] - before).norm().item())
    slide = GRAVITY * (math.sin(angle) - friction * math.cos(angle))
    assert travelled[0] < 1e-3
    assert travelled[1] == pytest.approx(slide / 2 * (1.5**2 - 1), rel=0.05)


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


@pytest.mark.parametrize("simulator", ["pybullet", "mujoco"])
@pytest.mark.parametrize("mass", [0.0, 5.0])
@pytest.mark.parametrize("shifted", [False, True])
def test_a_massive_link_may_be_welded_to_a_root_named_world(simulator, mass, shifted):
    if simulator == "pybullet":
        pytest.importorskip("pybullet", reason="PyBullet is not installed")
    body = arm()
    world = Link("world", Inertial(mass) if mass else None)
    weld = Joint("weld", "fixed", "world", body.root.name, Pose((0, 0, 0.5 * shifted)))
    body = replace(body, links=(world, *body.links), joints=(weld, *body.joints))
    simulation = SIMULATORS[simulator].load([Scene(body)], None, 1, torch.device("cpu"))
    assert not simulation.step(simulation.q.clone()).any()
    simulation.close()


def test_links_with_different_ignored_pairs_are_not_merged():
    """A fixed finger with other ignored pairs than its palm stays a separate body."""
    body = arm()
    fixed = replace(body.joints[3], kind="fixed", limits=None)
    moving = replace(body.joints[4], mimic=None)
    joints = (*body.joints[:3], fixed, moving)
    body = replace(body, joints=joints, ignore_pairs=(("base", "left"),))
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

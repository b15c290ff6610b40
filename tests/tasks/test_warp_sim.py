"""MuJoCo Warp on the CPU: agreement with MuJoCo, structures, resets, divergence."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from helpers.scenes import SECOND, ball, homes, push_scene, put_home, robot, smooth_walk
from morphgen.errors import SimulationError, TaskError
from morphgen.model.geometry import Box, Pose, Shape
from morphgen.model.robot import sorted_pair
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.sim.base import Block, Contacts, Scene
from morphgen.tasks.sim.mujoco_model import worlds
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

pytest.importorskip("mujoco_warp", reason="MuJoCo Warp is not installed: morphgen[gpu]")
import warp as wp

from morphgen.tasks.batch import StepGraph
from morphgen.tasks.sim import warp_sim
from morphgen.tasks.sim.warp_sim import WarpSimulation, structures

if not torch.cuda.is_available():  # kernels of a GPU are tested as users run them
    wp.config.optimization_level = 0  # on an empty cache, compiling takes longer than the tests
IN_FREE_SPACE = Contacts(scene=False, self_collision=False)
DIFFERENT = ("arm=ur5 ee=plane", "arm=arm3 ee=claw", "prims", "chain beads=2")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")


def simulation(scenes, contacts=None):
    return WarpSimulation(scenes, contacts, device="cpu")


def walks(scenes, joints, seed=0):
    """Return targets of all environments, shape (steps, n, joints)."""
    targets = np.zeros((SECOND, len(scenes), joints), np.float32)
    for i, scene in enumerate(scenes):
        targets[:, i, : scene.robot.dof] = smooth_walk(scene.robot, seed + i)
    return torch.from_numpy(targets)


@pytest.fixture(scope="module")
def arms():
    names = (f"arm=arm3 arm.length={length} ee=stick" for length in (0.25, 0.3, 0.35))
    return [Scene(robot(name), ground=None) for name in names]


@pytest.fixture(scope="module")
def shared(arms):
    """One simulation of these robots for all tests: to load it takes seconds."""
    loaded = simulation(arms)
    loaded.home = loaded.q.clone()
    return loaded


@pytest.fixture
def sim(shared):
    shared.reset(torch.ones(3, dtype=torch.bool), shared.home, torch.zeros(3, 7))
    shared.counts.zero_()
    return shared


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=needs_gpu)])
@pytest.mark.slow
def test_joints_are_within_a_milliradian_of_mujoco_after_a_second_without_contact(device):
    scenes = [Scene(robot(words), ground=None) for words in DIFFERENT]
    ours = WarpSimulation(scenes, IN_FREE_SPACE, device=device)
    mujoco = MujocoSimulation(scenes, IN_FREE_SPACE)
    assert torch.equal(ours.q.cpu(), mujoco.q)
    home = ours.q.clone()
    for targets in walks(scenes, ours.q.shape[1]):
        assert not ours.step(targets.to(device)).any()
        mujoco.step(targets)
    assert (ours.q.cpu() - mujoco.q).abs().max() < 1e-3
    assert (ours.q - home).abs().amax(dim=1).min() > 0.05
    assert ours.counts.tolist() == [[0, 0]] * len(DIFFERENT)
    ours.close()
    with pytest.raises(SimulationError, match="closed"):
        ours.step(home)


@pytest.mark.parametrize(
    ("order", "rows"),
    [
        ((0, 1, 2, 0, 1, 2, 0), 3),
        pytest.param((0, 0, 2, 1, 2), 5, marks=pytest.mark.slow),
        pytest.param((1,), 1, marks=pytest.mark.slow),
    ],
)
def test_robots_of_one_structure_share_a_model_and_move_as_if_they_were_alone(
    arms, sim, order, rows
):
    scenes = [arms[i] for i in order]
    (structure,) = structures(scenes, worlds(scenes, Contacts()))
    assert len(structure.worlds) == rows  # few if they repeat in their order, else one each
    assert structure.envs.tolist() == list(range(len(order)))
    names = {"body_pos", "body_mass", "geom_size", "geom_pos"}
    assert names <= structure.batched.keys() or rows == 1
    others = simulation(scenes)
    for row in walks(arms, sim.q.shape[1])[: SECOND // 4]:
        others.step(row[list(order)])
        sim.step(row)
    assert torch.allclose(others.q, sim.q[list(order)], atol=1e-5)


def test_structures_differ_where_the_library_has_one_value_for_all_worlds():
    """Other joints and types of shapes, or none, make another structure."""
    base, *others = (
        robot(f"arm={words}") for words in ("arm3 ee=stick", "arm5 ee=stick", "arm3 ee=plane")
    )
    bare = replace(base, links=tuple(replace(link, collisions=()) for link in base.links))
    scenes = [Scene(each, ground=None) for each in (base, *others, base, bare)]
    groups = structures(scenes, worlds(scenes, Contacts()))
    assert [each.envs.tolist() for each in groups] == [[0, 3], [1], [2], [4]]


@pytest.mark.slow
def test_robots_of_one_structure_test_their_own_pairs():
    base = robot("arm=arm3 ee=stick")
    first, *_, arm_tip, stick = (link.name for link in base.links if link.collisions)
    pairs = (sorted_pair(first, arm_tip), sorted_pair(first, stick))
    other = replace(base, ignore_pairs=(*base.ignore_pairs, *pairs))
    scenes = [Scene(base, ground=None), Scene(other, ground=None)]
    both, *alone = simulation(scenes), *(simulation([scene]) for scene in scenes)
    assert len(both.counts) == 1
    onto_itself = torch.tensor([[2.38, -1.83, 2.46, 2.03, 1.68]])
    for _ in range(2 * SECOND):
        both.step(onto_itself.expand(2, -1))
        for each in alone:
            each.step(onto_itself)
    assert torch.allclose(both.q, torch.cat([each.q for each in alone]), atol=1e-4)
    stopped, passed = both.q[:, 3].tolist()
    assert stopped < 1.7
    assert passed > 1.95


def test_a_reset_changes_only_its_environments_and_forgets_their_past(arms, sim):
    home = sim.q.clone()
    targets = walks(arms, sim.q.shape[1])
    path = []
    for row in targets[:10]:
        sim.step(row)
        path.append(sim.q[1].clone())
    before = sim.q.clone()
    q = home.clone()
    q[[0, 2]] = torch.nan  # rows outside the mask are ignored
    sim.reset(torch.tensor([False, True, False]), q, torch.full((3, 7), torch.nan))
    assert torch.equal(sim.q[1], home[1])
    assert not sim.qd[1].any()
    assert torch.equal(sim.q[[0, 2]], before[[0, 2]])
    for row, q_after in zip(targets[:10], path, strict=True):
        sim.step(row)
        assert torch.allclose(sim.q[1], q_after, atol=1e-6)


def test_invalid_targets_are_reported_and_a_reset_repairs(sim):
    with pytest.raises(ValueError, match="targets have shape"):
        sim.step(torch.zeros(2, 2))
    home = sim.q.clone()
    targets = home.clone()
    targets[1, 0] = torch.nan
    assert sim.step(targets).tolist() == [False, True, False]
    assert sim.counts.tolist() == [[1, 0]]
    sim.reset(torch.tensor([False, True, False]), home, torch.zeros(3, 7))
    assert torch.equal(sim.q[1], home[1])
    for _ in range(5):
        assert not sim.step(home).any()
    assert torch.isfinite(sim.q).all()
    assert (sim.q[1] - home[1]).abs().max() < 1e-3


def test_contacts_that_do_not_fit_are_reported(monkeypatch):
    monkeypatch.setattr(warp_sim, "max_contacts", lambda num_shapes: 0)
    scenes = [push_scene()]
    sim = simulation(scenes)
    put_home(sim)
    assert sim.step(sim.q).tolist() == [True]
    assert sim.counts[0, 1] == 1


@pytest.mark.parametrize("aside", [-0.01, 0.0, 0.01])
def test_a_solver_that_stops_at_its_last_iteration_has_not_diverged(aside):
    scenes = [push_scene()]
    sim = simulation(scenes)
    (group,) = sim._groups
    group.model.opt.iterations = 1
    group.model.opt.tolerance = wp.zeros(1, dtype=float, device="cpu")  # by default on a GPU
    q, poses = homes(sim)
    poses[0, 0] += aside
    sim.reset(torch.tensor([True]), q, poses)
    assert not sim.step(sim.q).any()
    assert group.data.overflow.numpy()[0] & warp_sim.OverflowType.ITERATIONS
    assert sim.counts.tolist() == [[0, 0]]


@pytest.mark.slow
def test_dropped_blocks_spin_and_come_to_rest_as_in_mujoco():
    pose = Pose.from_xyz_rpy((0.3, -0.4, 0.2), (0.2, 0.1, 0.4))
    scenes = [Scene(robot("prims"), Pose((5, 0, 0)), Block((0.15,) * 3, pose, 0.1))]
    ours, mujoco = simulation(scenes), MujocoSimulation(scenes)
    for _ in range(15):
        ours.step(ours.q)
        mujoco.step(mujoco.q)
        assert torch.allclose(ours.object_velocity, mujoco.object_velocity, atol=0.02)
    for _ in range(SECOND):
        ours.step(ours.q)
        mujoco.step(mujoco.q)
    assert torch.allclose(ours.object_pose, mujoco.object_pose, atol=2e-3)
    assert ours.object_velocity.abs().max() < 0.01


def table(height):
    """A robot whose root has a table top at a height, and a ball that slides far from it."""
    body = ball(0.3)
    top = Shape(Box((0.6, 0.6, 0.1)), Pose((0.0, 0.0, height - 0.05)))
    joints = (replace(body.joints[0], T_parent_joint=Pose((5.0, 0.0, 0.3))), *body.joints[1:])
    root = replace(body.root, collisions=(top,))
    return replace(body, links=(root, *body.links[1:]), joints=joints)


def test_static_shapes_are_where_each_robot_of_a_structure_has_them():
    """Blocks come to rest on the tops of tables of different heights."""
    heights = (0.2, 0.6, 0.4)
    blocks = [Block((0.1,) * 3, Pose((0.0, 0.0, height + 0.1)), 0.1) for height in heights]
    scenes = [Scene(table(h), object=block) for h, block in zip(heights, blocks, strict=True)]
    assert len(structures(scenes, worlds(scenes, Contacts()))) == 1
    sim = simulation(scenes)
    for _ in range(SECOND // 2):
        sim.step(sim.q)
    tops = torch.tensor([height + 0.05 for height in heights])
    assert torch.allclose(sim.object_pose[:, 2], tops, atol=1e-3)


def test_a_reset_moves_obstacles_and_blocks():
    sim = simulation([push_scene()])
    assert torch.allclose(sim.object_pose, homes(sim)[1])
    poses = torch.tensor([[[-2.0, 0.0, 0.3, 1, 0, 0, 0], [2.0, 0.2, 0.1, 1, 0, 0, 0]]])
    block = torch.tensor([[2.0, 0.2, 0.4, 0.0, 0, 0, -1.0]])
    sim.reset(torch.tensor([True]), sim.q.clone(), block, poses)
    assert torch.allclose(sim.object_pose, block)
    for _ in range(SECOND // 2):
        sim.step(sim.q)
    assert sim.object_pose[0, 2] == pytest.approx(0.2 + 0.075, abs=0.002)  # on the obstacle


def test_without_a_gpu_the_simulator_is_refused_by_name():
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    with pytest.raises(TaskError, match=r"simulator 'warp' on device 'cpu'; expected device cuda"):
        make_batch("reach", ["arm3"], 1, sim="warp")
    with pytest.raises(TaskError, match="device 'cuda': this machine has no CUDA device"):
        make_batch("reach", ["arm3"], 1, sim="warp", device="cuda")


def test_the_kernels_of_a_step_are_known_before_it_is_launched(shared, monkeypatch):
    before, wanted, load = shared.q.clone(), [], wp.Module.load

    def noted(module, device, block_dim=None):
        wanted.append((module, block_dim))
        return load(module, device, block_dim)

    found = warp_sim.kernels_of(shared._groups, "cpu")
    assert torch.equal(shared.q, before)
    monkeypatch.setattr(wp.Module, "load", noted)
    shared.step(shared.q)
    assert len(set(wanted)) > 20
    assert set(wanted) <= set(found)


@pytest.mark.parametrize("task", [pytest.param("reach", marks=pytest.mark.slow), "push"])
def test_a_batch_has_the_episodes_and_nearly_the_steps_of_mujoco(task):
    """The same seed gives the same starts and goals, and the same actions the same rewards."""
    mujoco = make_batch(task, ["arm=ur5 ee=stick", "arm=xarm7 ee=stick"], 4, sim="mujoco", seed=3)
    index = mujoco.env_robot_index.tolist()
    sim = simulation([mujoco.specs[i].scene for i in index])
    ours = TaskBatch(mujoco.robot_tables, mujoco.specs, index, sim, seed=3)
    first, other = ours.reset(), mujoco.reset()
    assert all(torch.equal(first[name], other[name]) for name in first)
    actions = torch.zeros(4, mujoco.robot_tables.max_links)
    generator = torch.Generator().manual_seed(0)
    for step in range(SECOND // 2):
        if step % 10 == 0:
            actions = 0.3 * torch.randn(actions.shape, generator=generator)
        one, two = ours.step(actions), mujoco.step(actions)
        assert torch.allclose(one.reward, two.reward, atol=0.02)
        assert torch.equal(one.terminated, two.terminated)
    assert (one.q - two.q).abs().max() < 5e-3


@needs_gpu
def test_recorded_steps_on_a_gpu_are_those_of_the_batch():
    """Graphs of a step give what the same calls give without them, also where episodes end."""
    batches = [
        make_batch("reach", ["arm3", "chain beads=2"], 64, sim="warp", device="cuda", seed=1)
        for _ in range(2)
    ]
    recorded = StepGraph(batches[0])
    first, other = (batch.reset(spread=True) for batch in batches)
    assert all(torch.equal(first[name], other[name]) for name in first)
    actions = torch.zeros(64, batches[0].robot_tables.max_links, device="cuda")
    for _ in range(120):
        one, two = recorded(actions), batches[1].step(actions)
        assert torch.equal(one.truncated, two.truncated)
        assert torch.allclose(one.observation["tokens"], two.observation["tokens"], atol=1e-3)
        assert torch.equal(one.observation["goal"], two.observation["goal"])

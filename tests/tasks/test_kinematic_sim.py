"""Kinematic simulation: agreement with MuJoCo, limits, and batches on the CPU and on a GPU."""

import itertools
from contextlib import closing

import numpy as np
import pytest
import torch

from helpers.faulty_robots import with_joint
from helpers.goal_sets import draw_spec
from helpers.robots import arm
from helpers.scenes import (
    PAPER_ROBOTS,
    full_speed,
    put_home,
    random_walk,
    reach_scene,
    reset_envs,
    robot,
    smooth_walk,
)
from morphgen.errors import SimulationError, TaskError
from morphgen.model.kinematics import forward_kinematics, joint_limits
from morphgen.tasks.configs import PushConfig, ReachConfig
from morphgen.tasks.registry import (
    SIMULATORS,
    batch_device,
    evaluation_simulator,
    installed_simulators,
)
from morphgen.tasks.scenes.make import batch_from_specs, make_batch
from morphgen.tasks.sim.base import Contacts, Scene
from morphgen.tasks.sim.kinematic import NO_CONTACTS, KinematicSimulation
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

REVOLUTE, FINGERS = "arm=ur5 ee=plane", "arm=panda ee=panda_hand"
MIMIC, PRISMATIC, MIXED = "arm=arm3 ee=claw", "prims", "chain beads=2"
ROBOTS = (REVOLUTE, FINGERS, MIMIC, PRISMATIC, MIXED)
NEAR = 0.01
"""Largest distance of tools from MuJoCo's [m]."""


def follow(sim, targets):
    """Return the positions after every step from home in simulations of one robot, (T, dof)."""
    put_home(sim)
    path = []
    for target in torch.from_numpy(targets).float():
        sim.step(target[None])
        path.append(sim.q[0].double().numpy().copy())
    sim.close()
    return np.array(path)


def in_free_space(simulation, body, targets):
    return follow(simulation([Scene(body, ground=None)], NO_CONTACTS), targets)


@pytest.mark.parametrize(
    ("words", "path"),
    [
        *itertools.product(ROBOTS, (smooth_walk, full_speed)),
        *(pytest.param(each, random_walk, marks=pytest.mark.slow) for each in PAPER_ROBOTS),
    ],
)
def test_all_links_stay_within_a_centimetre_of_mujoco(words, path):
    body = robot(words)
    for seed in range(3):
        targets = path(body, seed)
        ours, mujoco = (
            forward_kinematics(body, in_free_space(simulation, body, targets))[..., :3, 3]
            for simulation in (KinematicSimulation, MujocoSimulation)
        )
        assert np.linalg.norm(ours - mujoco, axis=-1).max() < NEAR
        assert np.linalg.norm(mujoco - mujoco[0], axis=-1).max() > 3 * NEAR


@pytest.mark.parametrize("words", ROBOTS)
def test_joints_stay_within_their_limits(words):
    body = robot(words)
    lower, upper = joint_limits(body).T
    sim = KinematicSimulation([Scene(body)] * 8)
    rng, path = np.random.default_rng(0), []
    reset_envs(sim, range(8), torch.from_numpy(rng.uniform(lower, upper, (8, body.dof))))
    for step in range(300):
        if step % 15 == 0:  # far beyond the limits
            targets = torch.from_numpy(rng.choice([-10.0, 10.0], (8, body.dof))).float()
        sim.step(targets)
        path.append(sim.q.clone())
    lowest, highest = (torch.stack(path).amin(dim=0), torch.stack(path).amax(dim=0))
    bounded = [not body.joints[k].is_continuous for k in body.independent_joints]
    assert (lowest.numpy() >= lower - 1e-6)[:, bounded].all()
    assert (highest.numpy() <= upper + 1e-6)[:, bounded].all()
    assert (highest - lowest > 0.01).all()


def test_joints_without_limits_turn_on():
    body = with_joint(arm(), "elbow", kind="continuous", limits=None)
    elbow = [body.joints[k].name for k in body.independent_joints].index("elbow")
    sim = KinematicSimulation([Scene(body)])
    targets = torch.tensor([body.home]).float()
    for _ in range(300):
        targets[0, elbow] += 0.03
        sim.step(targets)
    assert sim.q[0, elbow] > 2 * np.pi


def test_contacts_are_refused():
    for contacts in (Contacts(), Contacts(scene=False), Contacts(self_collision=False)):
        with pytest.raises(SimulationError, match="has no contacts"):
            KinematicSimulation([reach_scene()], contacts)
    KinematicSimulation([reach_scene()], NO_CONTACTS)


CONFIG = ReachConfig(num_goals=20)
needs_cuda = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device")


@pytest.fixture(scope="module")
def specs(cache):
    return [draw_spec(robot(words), CONFIG, cache=cache) for words in ("arm3", REVOLUTE, PRISMATIC)]


def make_kinematic(specs, num_envs, **options):
    return batch_from_specs(specs, num_envs, sim="kinematic", **options)


def rollout(batch, steps=40):
    """Return all numbers of steps with random actions of each environment."""
    n, L = batch.action_mask.shape
    with closing(batch):
        batch.reset()
        actions = 2 * torch.rand(steps, L, generator=torch.Generator().manual_seed(0)) - 1
        results = [batch.step(action.expand(n, L).to(batch.device)) for action in actions]
    rows = []
    for step in results:
        seen = [step.observation[key] for key in sorted(step.observation)]
        numbers = (step.reward, step.q, step.distance, *seen)
        rows.append(torch.cat([each.float().reshape(n, -1) for each in numbers], dim=1))
    return torch.stack(rows).cpu().numpy()


def test_kinematic_is_a_registered_simulator_that_mujoco_judges():
    assert "kinematic" in SIMULATORS.builtin
    assert {"mujoco", "kinematic"} <= set(installed_simulators())
    assert evaluation_simulator("kinematic") == "mujoco"
    for name in {"mujoco", "pybullet"}.intersection(installed_simulators()):
        assert evaluation_simulator(name) == name


@pytest.mark.parametrize(
    ("task", "obstacles", "thing"), [("push", False, "an object"), ("reach", True, "obstacles")]
)
def test_batches_with_something_to_touch_are_refused(cache, task, obstacles, thing):
    configs = (PushConfig(num_goals=2), ReachConfig(num_goals=2))
    options = {"obstacles": obstacles, "sim": "kinematic", "configs": configs, "cache": cache}
    with pytest.raises(TaskError, match=f"{task} of .* has {thing}; expected simulator .*mujoco"):
        make_batch(task, [robot("prims")], 1, **options)


def test_invalid_batch_options_are_rejected(specs):
    with pytest.raises(TaskError, match="2 workers; expected 1"):
        make_kinematic(specs, 3, workers=2)
    with pytest.raises(TaskError, match="unknown device 'tpu'"):
        make_kinematic(specs, 3, device="tpu")


def test_devices_of_batches(specs, monkeypatch):
    assert batch_device("kinematic", "cuda:1") == "cuda:1"
    assert batch_device("mujoco", "cuda") == "cpu"
    if not torch.cuda.is_available():
        with pytest.raises(TaskError, match="this machine has no CUDA device"):
            make_kinematic(specs, 3, device="cuda")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    message = "device 'cuda'; expected device cpu, or simulator warp or k"
    with pytest.raises(TaskError, match=message):
        batch_from_specs(specs, 3, sim="mujoco", device="cuda")


@needs_cuda
def test_cuda_batches_follow_those_of_the_cpu(specs):
    cpu, cuda = (rollout(make_kinematic(specs, 12, device=name)) for name in ("cpu", "cuda"))
    np.testing.assert_allclose(cuda, cpu, atol=1e-3)
    again = rollout(make_kinematic(specs, 12, device="cuda"))
    assert again.tobytes() == cuda.tobytes()

"""Damped least-squares inverse kinematics in NumPy and torch."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from helpers.robots import arm
from helpers.scenes import robot
from morphgen.model.kinematics import (
    DAMPING,
    MAX_STEP,
    dls_step,
    driving_joints,
    frame_pose,
    joint_limits,
    random_configurations,
    solve_pose_ik,
    solve_position_ik,
)
from morphgen.model.kinematics_torch import (
    angle_between,
    compile_chain,
    matrix_from_quaternion,
    pose_ik_step,
    quaternion_from_matrix,
    rotvec_from_matrix,
    solve_ik,
)
from morphgen.model.kinematics_torch import dls_step as batched_step
from morphgen.model.kinematics_torch import frame_pose as frame_poses

UR5, PANDA, GANTRY, CHAIN, CLAW = ROBOTS = [
    robot(words)
    for words in (
        "arm=ur5 ee=plane",
        "arm=panda ee=panda_hand",
        "prims",
        "nlink",
        "arm=arm3 ee=claw",
    )
]
QUARTER_TURN = torch.tensor([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])


class Batch:
    """Rows of ``ROBOTS`` in one batch, in single precision unless said otherwise."""

    def __init__(self, *rows, dtype=torch.float32):
        self.chain, self.robot_index = compile_chain(ROBOTS, dtype=dtype), torch.tensor(rows)
        joints = max(robot.dof for robot in ROBOTS)
        self.home, *self.limits = torch.zeros(3, len(rows), joints, dtype=dtype)
        for row, *tensors in zip(rows, self.home, *self.limits, strict=True):
            arrays = (np.array(ROBOTS[row].home), *joint_limits(ROBOTS[row]).T)
            for tensor, values in zip(tensors, arrays, strict=True):
                tensor[: len(values)] = torch.from_numpy(values)

    def poses(self, q):
        T = frame_poses(self.chain, self.robot_index, q)
        return T[:, :3, 3], T[:, :3, :3]

    def solve(self, q, positions, rotations=None, **options):
        arguments = (q[None], positions, rotations, self.limits)
        q, error = solve_ik(self.chain, self.robot_index, *arguments, **options)
        return q[0], error[0]

    def step(self, q, positions, rotations, **options):
        arguments = (q, positions, rotations, self.limits)
        return pose_ik_step(self.chain, self.robot_index, *arguments, **options)


def test_a_step_solves_the_damped_normal_equations():
    rng = np.random.default_rng(0)
    J, error = rng.normal(size=(5, 6, 7)), rng.normal(size=(5, 6))
    J_T = J.swapaxes(1, 2)
    expected = np.linalg.solve(J_T @ J + 0.09 * np.eye(7), J_T @ error[..., None])[..., 0]
    np.testing.assert_allclose(dls_step(J, error, 0.3), expected, atol=1e-9)
    step = batched_step(torch.from_numpy(J), torch.from_numpy(error), 0.3)
    np.testing.assert_allclose(step.numpy(), expected, atol=1e-9)


@pytest.mark.parametrize("index", range(len(ROBOTS)))
def test_position_ik_reaches_goals_within_the_limits(index):
    body, rng = ROBOTS[index], np.random.default_rng(index)
    low, high = joint_limits(body).T
    q = 0.5 * (low + high) + 0.25 * rng.uniform(-1, 1, (6, body.dof)) * (high - low)
    goals = frame_pose(body, np.clip(q + rng.uniform(-0.2, 0.2, q.shape), low, high))[:, :3, 3]
    found, error = solve_position_ik(body, q, goals)
    assert ((low <= found) & (found <= high)).all()
    left = goals - frame_pose(body, found)[:, :3, 3]
    np.testing.assert_allclose(error, left, atol=1e-9)
    assert np.median(np.linalg.norm(left, axis=1)) < 1e-3
    idle = np.setdiff1d(
        range(body.dof), driving_joints(body, body.joint_chain(body.frame("tool").link))
    )
    np.testing.assert_allclose(found[:, idle], q[:, idle], atol=1e-9)
    batch = Batch(*[index] * 6, dtype=torch.float64)
    padded = torch.ones_like(batch.home)
    padded[:, : body.dof] = torch.from_numpy(q)
    same, rest = batch.solve(padded, torch.from_numpy(goals), damping=DAMPING, max_step=MAX_STEP)
    np.testing.assert_allclose(same[:, : body.dof], found, atol=1e-7)
    np.testing.assert_allclose(rest, error, atol=1e-7)


def test_position_ik_reports_the_error_of_unreachable_goals():
    goals = np.array([[0.5, 0.2, 0.3], [9.0, 0.0, 0.0]])
    q, error = solve_position_ik(UR5, np.tile(UR5.home, (2, 1)), goals)
    assert np.abs(error[0]).max() < 1e-4
    assert goals - error == pytest.approx(frame_pose(UR5, q)[:, :3, 3], abs=1e-5)
    assert np.linalg.norm(error[1]) > 7


def test_position_ik_leaves_rows_that_have_arrived():
    q = random_configurations(PANDA, 20, np.random.default_rng(0))
    goals = frame_pose(PANDA, q)[:, :3, 3] + np.linspace(0, 0.1, 20)[:, None]
    loose, error = solve_position_ik(PANDA, q, goals, tolerance=0.01)
    tight, _ = solve_position_ik(PANDA, q, goals)
    near = np.linalg.norm(goals - frame_pose(PANDA, q)[:, :3, 3], axis=1) <= 0.01
    np.testing.assert_array_equal(loose[near], q[near])
    assert 0 < near.sum() < len(q)
    assert np.median(np.linalg.norm(error, axis=1)) <= 0.01
    assert not np.allclose(loose, tight, atol=1e-6)


@pytest.mark.parametrize("seed", range(5))
def test_a_near_pose_is_reached(seed):
    q = np.array(UR5.home)
    goal = frame_pose(UR5, q + np.random.default_rng(seed).uniform(-0.4, 0.4, UR5.dof))
    assert frame_pose(UR5, solve_pose_ik(UR5, goal, q)) == pytest.approx(goal, abs=2e-3)


def test_a_pose_out_of_reach_is_approached_within_the_limits():
    goal = np.eye(4)
    goal[:3, 3] = (0.0, 0.0, 5.0)
    solution = solve_pose_ik(arm(), goal, arm().home, rotation_weight=0.0)
    low, high = joint_limits(arm()).T
    assert ((low <= solution) & (solution <= high)).all()
    assert frame_pose(arm(), solution)[2, 3] > frame_pose(arm(), arm().home)[2, 3]


def test_poses_are_reached_from_random_starts_within_the_limits():
    """Also by robots with fewer than 6 joints: the goals are poses of configurations."""
    goals, starts = 8, 16
    solver = Batch(*np.repeat(range(len(ROBOTS)), goals * starts))
    low, high = solver.limits
    random = torch.rand(2, *low.shape, generator=torch.Generator().manual_seed(0))
    goal_q = (low + (high - low) * random[0])[::starts].repeat_interleave(starts, 0)
    positions, rotations = solver.poses(goal_q)
    q, error = solver.solve(
        low + (high - low) * random[1], positions, rotations, rotation_weight=0.2, iterations=60
    )
    assert ((low <= q) & (q <= high)).all()
    reached, turned = solver.poses(q)
    assert torch.allclose(error[:, :3], positions - reached, atol=1e-5)
    angle = 0.2 * angle_between(turned, rotations)
    assert torch.allclose(error[:, 3:].norm(dim=1), angle, atol=2e-3)
    solved = (error.norm(dim=1) < 3e-3).view(len(ROBOTS), goals, starts).any(dim=2)
    assert (solved.sum(dim=1) >= goals - 1).all()


def test_rotation_uses_the_null_space_of_the_position_task():
    batch = Batch(1, 2, 3)
    q = batch.home + 0.2 * (batch.limits[1] - batch.home).clamp(max=1.0)
    positions, rotations = batch.poses(q)
    goals = positions + torch.tensor([[0.0, 0.05, 0.02], [0.0, 0.05, -0.02], [-0.05, 0.05, 0.0]])
    for _ in range(30):
        q = batch.step(q, goals, rotations)
    found, turned = batch.poses(q)
    assert (found - goals).abs().max() < 5e-3
    off = (turned - rotations).abs().amax(dim=(1, 2))
    assert off[:2].max() < 0.02
    assert off[2] > 0.1, "two hinges have nothing left"


def test_joints_at_their_limits_are_excluded_from_the_step():
    batch = Batch(0)
    q, (low, high) = batch.home, batch.limits
    positions, rotations = batch.poses(q)
    for _ in range(100):
        q = batch.step(q, positions + 9.0, rotations)
        assert ((low <= q) & (q <= high)).all()


def test_no_joint_exceeds_its_rotation_budget():
    batch = Batch(1)
    q, budget = batch.home, torch.full_like(batch.home, 0.05)
    positions, rotations = batch.poses(q)
    goals, turned = positions + torch.tensor([[0.0, 0.004, 0.0]]), QUARTER_TURN @ rotations
    free = batch.step(q, goals, turned) - q
    within = batch.step(q, goals, turned, rotation_budget=budget) - q
    assert (free.abs() > budget).any()
    assert (within.abs() <= budget).all()
    assert batch.poses(q + within)[0].numpy() == pytest.approx(goals.numpy(), abs=5e-4)
    both = [batch.step(q, goals, rotations, rotation_budget=each) for each in (None, budget)]
    assert torch.equal(*both), "where all joints stay within it nothing is given up"


def test_solutions_are_differentiable_in_their_goals():
    batch = Batch(0, 1)
    goals = (batch.poses(batch.home)[0] - 0.05).requires_grad_()
    found, _ = batch.solve(batch.home, goals, damping=DAMPING, max_step=MAX_STEP)
    tools = batch.poses(found)[0]
    (gradient,) = torch.autograd.grad(tools.sum(), goals)
    torch.testing.assert_close(gradient, torch.ones_like(goals), atol=0.02, rtol=0)


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.5, 1.5, 2.9, 3.0, 3.1415, math.pi])
def test_rotation_vectors_are_the_logarithms_of_rotations(angle):
    axes = np.random.default_rng(0).normal(size=(200, 3))
    axes[:3] = np.eye(3)
    wanted = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = torch.from_numpy(Rotation.from_rotvec(wanted).as_matrix()).float()
    rotation_vectors = rotvec_from_matrix(R).double().numpy()
    if angle > 3.1415:  # there are two, and which it is depends on the last bit
        rotation_vectors *= np.sign((rotation_vectors * wanted).sum(axis=1, keepdims=True))
    assert np.abs(rotation_vectors - wanted).max() < 3e-6 * max(angle, 1e-3)


def test_quaternions_agree_with_scipy_in_both_directions():
    turns = Rotation.random(200, rng=np.random.default_rng(0))
    half_turns = torch.stack(
        [torch.eye(3), *(2 * torch.diag(e) - torch.eye(3) for e in torch.eye(3))]
    )
    assert torch.allclose(quaternion_from_matrix(half_turns).abs(), torch.eye(4))
    R = torch.from_numpy(turns.as_matrix())
    expected = turns.as_quat(canonical=True, scalar_first=True)
    quaternions = quaternion_from_matrix(R)
    np.testing.assert_allclose(quaternions.numpy(), expected, atol=1e-12)
    torch.testing.assert_close(matrix_from_quaternion(quaternions), R, atol=1e-12, rtol=0)

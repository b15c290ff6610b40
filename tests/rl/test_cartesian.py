"""Tools go where they are to, as straight as joints let them."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from morphgen.rl.cartesian import OneTool, rotation_vectors, towards
from morphgen.tasks.bodies import bodies_of
from morphgen.tasks.kinematics import tool_frames
from scenes import robot

UR5, PANDA, PLANE = "arm=ur5 ee=plane", "arm=panda ee=panda_hand", "prims"


def test_tools_are_moved_first_and_turned_with_what_is_left():
    bodies = bodies_of([robot(PANDA), robot(PLANE), robot("nlink")])
    body = torch.arange(3)
    q = bodies.home + 0.2 * (bodies.upper - bodies.home).clamp(max=1.0)
    T = tool_frames(bodies.chain, body, q)[:, -1]
    goal = T[:, :3, 3] + torch.tensor([[0.0, 0.05, 0.02], [0.0, 0.05, -0.02], [-0.05, 0.05, 0.0]])
    turned = T[:, :3, :3]
    for _ in range(30):
        q = towards(bodies, body, q, goal, turned)
    found = tool_frames(bodies.chain, body, q)[:, -1]
    assert (found[:, :3, 3] - goal).abs().max() < 5e-3
    off = (found[:, :3, :3] - turned).abs().amax(dim=(1, 2))
    assert off[:2].max() < 0.02
    assert off[2] > 0.1, "two hinges have nothing left"


def test_joints_at_their_limits_leave_it_to_the_others():
    bodies = bodies_of([robot(UR5)])
    body, q = torch.tensor([0]), bodies.home.clone()
    T = tool_frames(bodies.chain, body, q)[:, -1]
    for _ in range(100):
        q = towards(bodies, body, q, T[:, :3, 3] + 9.0, T[:, :3, :3])
        assert (q >= bodies.lower).all()
        assert (q <= bodies.upper).all()


def test_who_is_in_haste_turns_no_farther_than_joints_get_in_a_step():
    bodies = bodies_of([robot(PANDA)])
    body, q = torch.tensor([0]), bodies.home.clone()
    T = tool_frames(bodies.chain, body, q)[:, -1]
    goal = T[:, :3, 3] + torch.tensor([[0.0, 0.004, 0.0]])
    quarter = torch.tensor([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])
    turned = quarter @ T[:, :3, :3]
    slow = towards(bodies, body, q, goal, turned) - q
    fast = towards(bodies, body, q, goal, turned, hasty=True) - q
    assert (slow.abs() > bodies.step).any()
    assert (fast.abs() <= bodies.step).all()
    moved = tool_frames(bodies.chain, body, q + fast)[0, -1, :3, 3]
    assert moved.numpy() == pytest.approx(goal[0].numpy(), abs=5e-4)
    near = T[:, :3, :3]
    both = [towards(bodies, body, q, goal, near, hasty=hasty) for hasty in (False, True)]
    assert torch.equal(*both), "where all joints are fast enough nothing is given up"


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.5, 1.5, 2.9, 3.0, 3.1415, math.pi])
def test_rotation_vectors_are_the_logarithms_of_rotations(angle):
    axes = np.random.default_rng(0).normal(size=(200, 3))
    axes[:3] = np.eye(3)
    wanted = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = torch.from_numpy(Rotation.from_rotvec(wanted).as_matrix()).float()
    found = rotation_vectors(R).double().numpy()
    if angle > 3.1415:  # there are two, and which it is depends on the last bit
        found *= np.sign((found * wanted).sum(axis=1, keepdims=True))
    assert np.abs(found - wanted).max() < 3e-6 * max(angle, 1e-3)


def test_a_tool_that_is_the_wrong_way_round_turns():
    bodies = bodies_of([robot(PANDA)])
    tool, q = OneTool(bodies, 0), np.array([bodies.robots[0].home])
    position, rotation = tool.poses(q)
    turned = rotation @ np.diag([-1.0, -1.0, 1.0])
    q = tool.brought(q, position, turned, 60)
    reached = tool.poses(q)
    assert np.abs(reached[0] - position).max() < 5e-3
    assert np.abs(reached[1] - turned).max() < 0.02

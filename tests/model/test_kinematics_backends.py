"""NumPy and torch kinematics agree with MuJoCo for robots of every structure."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

import morphgen
from helpers.kinematic_backends import BACKENDS, TorchBackend, backend
from helpers.robots import arm
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.model import kinematics_torch
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    FramePosition,
    frame_pose,
    frame_positions,
    random_configurations,
)
from morphgen.model.kinematics_torch import (
    compile_chain,
    compile_tree,
    forward_kinematics,
    frame_jacobian,
)
from morphgen.model.robot import Frame, Joint, Link, Mimic, Robot

WORDS = (
    "arm=ur5 ee=plane",
    "arm=panda ee=panda_hand",
    "base=gantry arm=ur5 ee=stick",
    "arm=lwr ee=claw",
    "chain beads=2",
    "arm3",
)


def tool_on_a_mimic_finger():
    """Return the arm with its tool on a mimic finger whose leader is in another branch."""
    *joints, last = arm().joints
    joints.append(replace(last, mimic=Mimic("left", -0.5, 0.1)))
    frame = Frame("tool", "right", Pose.from_xyz_rpy((0.01, 0.02, 0.03), (0.3, 0.2, 0.1)))
    return replace(arm(), name="mimic", joints=tuple(joints), frames=(frame,))


def two_leaders():
    """Return the arm whose slide mimics its shoulder: one leader moves two joints of the tool."""
    shoulder, elbow, slide, *fingers = arm().joints
    slide = replace(slide, mimic=Mimic("shoulder", 0.02, 0.03))
    home = (arm().home[0], arm().home[1], arm().home[3])
    return replace(arm(), name="led", joints=(shoulder, elbow, slide, *fingers), home=home)


ROBOTS = [
    *(morphgen.compose(words, geometry="primitive") for words in WORDS),
    arm(),
    tool_on_a_mimic_finger(),
    two_leaders(),
]


@pytest.fixture(scope="module", params=BACKENDS)
def kinematics(request):
    return backend(request.param, ROBOTS)


@pytest.fixture(params=range(len(ROBOTS)), ids=[robot.name for robot in ROBOTS])
def index(request):
    return request.param


def drawn(index, n=8):
    return random_configurations(ROBOTS[index], n, np.random.default_rng(index))


def test_link_poses_agree_with_mujoco(kinematics, index):
    robot, q = ROBOTS[index], drawn(index)
    frames = tuple(Frame(f"at_{link.name}", link.name) for link in robot.links)
    expected = MujocoKinematics(replace(robot, frames=frames))
    T_root_link = kinematics.link_poses(index, q)
    assert T_root_link.shape == (len(q), len(robot.links), 4, 4)
    for i, frame in enumerate(frames):
        np.testing.assert_allclose(
            T_root_link[:, i], expected.frame_pose(q, frame.name), atol=kinematics.tolerance
        )


def test_joint_axes_agree_with_mujoco(kinematics, index):
    robot, q = ROBOTS[index], drawn(index, 1)
    expected = MujocoKinematics(robot)
    expected.frame_pose(q)
    anchors, axes = (each[0] for each in kinematics.joint_axes(index, q))
    for k, joint in enumerate(robot.joints):
        if not joint.is_movable:
            assert not axes[k + 1].any()
            assert not anchors[k + 1].any()
            continue
        view = expected.data.joint(joint.name)
        np.testing.assert_allclose(axes[k + 1], view.xaxis, atol=kinematics.tolerance)
        apart = anchors[k + 1] - view.xanchor
        if joint.kind == "prismatic":  # MuJoCo's anchor stays behind when the joint slides
            apart = np.cross(apart, view.xaxis)
        np.testing.assert_allclose(apart, 0, atol=kinematics.tolerance)
    assert not axes[0].any()


def test_tool_jacobians_agree_with_mujoco(kinematics, index):
    robot, q = ROBOTS[index], drawn(index)
    expected = MujocoKinematics(robot)
    model, data = expected.model, expected.data
    dofs = [model.joint(robot.joints[k].name).dofadr[0] for k in robot.movable_joints]
    T, J = kinematics.frame_jacobian(index, q)
    np.testing.assert_allclose(T, expected.frame_pose(q), atol=kinematics.tolerance)
    np.testing.assert_allclose(kinematics.frame_pose(index, q), T, atol=1e-12)
    np.testing.assert_allclose(
        kinematics.frame_positions(index, q), T[:, :3, 3], atol=kinematics.tolerance
    )
    for row, J_root_tool in zip(q, J, strict=True):
        expected.frame_pose(row[None])
        mujoco.mj_comPos(model, data)
        both = np.zeros((2, 3, model.nv))
        mujoco.mj_jacSite(model, data, *both, model.site("tool").id)
        folded = both.reshape(6, -1)[:, dofs] @ robot.mimic_map[0]
        np.testing.assert_allclose(J_root_tool, folded, atol=kinematics.tolerance)


def test_rows_of_different_robots_are_independent():
    kinematics = TorchBackend(ROBOTS, torch.float64)
    rows = [kinematics.rows(index, drawn(index)) for index in range(len(ROBOTS))]
    robot_index, q = (torch.cat(each) for each in zip(*rows, strict=True))
    order = torch.randperm(len(q), generator=torch.Generator().manual_seed(0))
    T_root_link = forward_kinematics(kinematics.tree, robot_index[order], q[order])
    T_root_tool, J_root_tool = frame_jacobian(kinematics.chain, robot_index[order], q[order])
    for index in range(len(ROBOTS)):
        own = order[robot_index[order] == index] - 8 * index
        T, J = kinematics.frame_jacobian(index, drawn(index))
        here = robot_index[order] == index
        alone = kinematics.link_poses(index, drawn(index))[own]
        together = T_root_link[here][:, kinematics.tree.is_link[index]].numpy()
        np.testing.assert_allclose(together, alone, atol=1e-14)
        np.testing.assert_allclose(T_root_tool[here].numpy(), T[own], atol=1e-14)
        dof = ROBOTS[index].dof
        np.testing.assert_allclose(J_root_tool[here][..., :dof].numpy(), J[own], atol=1e-14)


def test_a_tree_can_be_padded_to_more_links():
    tree = compile_tree([arm()], max_links=9)
    assert tree.is_link.tolist() == [[True] * 6 + [False] * 3]
    T = forward_kinematics(tree, torch.tensor([0]), torch.tensor([arm().home]))
    assert T.shape == (1, 9, 4, 4)
    assert (T[:, 6:] == torch.eye(4)).all()
    with pytest.raises(ValueError, match="max_links is 3; expected at least 6"):
        compile_tree([arm()], max_links=3)


def test_an_immobile_tool_has_a_zero_jacobian():
    fixed = replace(arm(), name="fixed", frames=(Frame("tool", "base", Pose((1.0, 2.0, 3.0))),))
    chain = compile_chain([fixed], dtype=torch.float64)
    T, J = frame_jacobian(chain, torch.tensor([0]), torch.tensor([fixed.home]).double())
    np.testing.assert_array_equal(T[0].numpy(), frame_pose(fixed, fixed.home))
    assert not J.any()


def test_a_robot_with_one_link():
    robot = Robot("stone", (Link("a"),))
    T = forward_kinematics(compile_tree([robot]), torch.tensor([0, 0]), torch.zeros(2, 0))
    assert (torch.eye(4) == T).all()
    assert T.shape == (2, 1, 4, 4)


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "continuous"])
def test_a_tool_whose_only_movable_joint_mimics_a_fixed_one(kind):
    follower = Joint("g", kind, "b", "c", axis=(0, 0.6, 0.8), mimic=Mimic("f", -2.0, 0.3))
    if kind != "continuous":
        follower = replace(follower, limits=(-1.0, 1.0))
    robot = Robot(
        "still",
        (Link("a"), Link("b"), Link("c")),
        (Joint("f", "fixed", "a", "b", Pose((0.1, 0, 0))), follower),
        (Frame("tool", "c", Pose((0.1, 0.2, 0.3))),),
    )
    expected = frame_pose(robot, np.zeros((4, 0)))[:, :3, 3]
    assert abs(expected - (0.2, 0.2, 0.3)).max() > 0.01
    np.testing.assert_allclose(frame_positions(robot, np.zeros((0, 4))).T, expected, atol=1e-12)
    np.testing.assert_allclose(FramePosition(robot)([]), expected[0], atol=1e-12)
    chain = compile_chain([robot], dtype=torch.float64)
    index, q = torch.zeros(4, dtype=torch.long), torch.zeros((4, 0), dtype=torch.float64)
    positions = kinematics_torch.frame_positions(chain, index, q)
    np.testing.assert_allclose(positions, expected, atol=1e-12)

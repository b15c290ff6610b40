"""Kinematics of one robot agree with MuJoCo, those of a batch with those of one robot."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

import morphgen
from helpers.robots import arm
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.model import kinematics_torch as batched
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    FramePosition,
    arm_reach,
    forward_kinematics,
    frame_jacobian,
    frame_pose,
    frame_positions,
    joint_axes,
    joint_limits,
    periodic_joints,
    random_configurations,
    reach,
    unwrap_joints,
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
    replace(arm(), name="immobile", frames=(Frame("tool", "base", Pose((1.0, 2.0, 3.0))),)),
]
N = 8  # configurations of each robot


def drawn(index):
    return random_configurations(ROBOTS[index], N, np.random.default_rng(index))


@pytest.mark.parametrize("index", range(len(ROBOTS)), ids=[robot.name for robot in ROBOTS])
def test_one_robot_agrees_with_mujoco(index):
    robot, q = ROBOTS[index], drawn(index)
    at_links = tuple(Frame(f"at_{link.name}", link.name) for link in robot.links)
    expected = MujocoKinematics(replace(robot, frames=(*at_links, *robot.frames)))
    model, data = expected.model, expected.data
    T_root_link, (T, J) = forward_kinematics(robot, q), frame_jacobian(robot, q)
    for i, frame in enumerate(at_links):
        np.testing.assert_allclose(T_root_link[:, i], expected.frame_pose(q, frame.name), atol=1e-9)
    np.testing.assert_allclose(T, expected.frame_pose(q), atol=1e-9)
    np.testing.assert_allclose(frame_pose(robot, q), T, atol=1e-12)
    np.testing.assert_allclose(frame_positions(robot, q.T).T, T[:, :3, 3], atol=1e-12)
    np.testing.assert_allclose(FramePosition(robot)(q[0].tolist()), T[0, :3, 3], atol=1e-12)
    dofs = [model.joint(robot.joints[k].name).dofadr[0] for k in robot.movable_joints]
    anchors, axes = joint_axes(robot, T_root_link)
    for row in range(N):
        expected.frame_pose(q[row : row + 1])
        mujoco.mj_comPos(model, data)
        both = np.zeros((2, 3, model.nv))
        mujoco.mj_jacSite(model, data, *both, model.site("tool").id)
        folded = both.reshape(6, -1)[:, dofs] @ robot.mimic_map[0]
        np.testing.assert_allclose(J[row], folded, atol=1e-9)
        for k in robot.movable_joints:
            joint = data.joint(robot.joints[k].name)
            np.testing.assert_allclose(axes[row, k + 1], joint.xaxis, atol=1e-9)
            apart = anchors[row, k + 1] - joint.xanchor
            if robot.joints[k].kind == "prismatic":  # MuJoCo's anchor stays behind when it slides
                apart = np.cross(apart, joint.xaxis)
            np.testing.assert_allclose(apart, 0, atol=1e-9)
    still = [0, *(k + 1 for k, joint in enumerate(robot.joints) if not joint.is_movable)]
    assert not axes[:, still].any()
    assert not anchors[:, still].any()


@pytest.mark.parametrize(("dtype", "atol"), [(torch.float64, 1e-9), (torch.float32, 2e-5)])
def test_a_batch_agrees_with_its_robots(dtype, atol):
    tree, chain = (
        batched.compile_tree(ROBOTS, dtype=dtype),
        batched.compile_chain(ROBOTS, dtype=dtype),
    )
    index = torch.arange(len(ROBOTS)).repeat_interleave(N)
    q = torch.ones(len(index), max(robot.dof for robot in ROBOTS), dtype=dtype)
    for i, robot in enumerate(ROBOTS):
        q[index == i, : robot.dof] = torch.from_numpy(drawn(i)).to(dtype)
    order = torch.randperm(len(q), generator=torch.Generator().manual_seed(0))
    T_root_link = batched.forward_kinematics(tree, index[order], q[order])
    results = (
        T_root_link,
        *batched.joint_axes(tree, index[order], T_root_link),
        *batched.frame_jacobian(chain, index[order], q[order]),
        batched.frame_pose(chain, index[order], q[order]),
        batched.frame_positions(chain, index[order], q[order]),
    )
    assert {result.dtype for result in results} == {dtype}
    T_link, anchors, axes, T_tool, J, T_again, positions = (
        result[order.argsort()].numpy().astype(np.float64) for result in results
    )
    for i, robot in enumerate(ROBOTS):
        rows, links = (index == i).numpy(), len(robot.links)
        alone = (
            batched.forward_kinematics(tree, index[rows], q[rows]),
            *batched.frame_jacobian(chain, index[rows], q[rows]),
        )
        for together, result in zip((T_link, T_tool, J), alone, strict=True):
            within = 1e-14 if dtype == torch.float64 else atol
            np.testing.assert_allclose(together[rows], result.numpy(), atol=within)
        T = forward_kinematics(robot, drawn(i))
        expected_T, expected_J = frame_jacobian(robot, drawn(i))
        assert tree.is_link[i].tolist() == [k < links for k in range(len(tree.is_link[i]))]
        assert (T_link[rows, links:] == np.eye(4)).all()
        assert not J[rows][..., robot.dof :].any()
        for result, expected in (
            (T_link[rows, :links], T),
            *zip((anchors[rows, :links], axes[rows, :links]), joint_axes(robot, T), strict=True),
            (T_tool[rows], expected_T),
            (J[rows][..., : robot.dof], expected_J),
            (T_again[rows], expected_T),
            (positions[rows], expected_T[:, :3, 3]),
        ):
            np.testing.assert_allclose(result, expected, atol=atol)


def test_a_tree_can_be_padded_to_more_links():
    tree = batched.compile_tree([arm()], max_links=9)
    assert tree.is_link.tolist() == [[True] * 6 + [False] * 3]
    T = batched.forward_kinematics(tree, torch.tensor([0]), torch.tensor([arm().home]))
    assert T.shape == (1, 9, 4, 4)
    assert (T[:, 6:] == torch.eye(4)).all()
    with pytest.raises(ValueError, match="max_links is 3; expected at least 6"):
        batched.compile_tree([arm()], max_links=3)


def test_a_robot_with_one_link():
    tree = batched.compile_tree([Robot("stone", (Link("a"),))])
    T = batched.forward_kinematics(tree, torch.tensor([0, 0]), torch.zeros(2, 0))
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
    chain = batched.compile_chain([robot], dtype=torch.float64)
    index, q = torch.zeros(4, dtype=torch.long), torch.zeros((4, 0), dtype=torch.float64)
    positions = batched.frame_positions(chain, index, q)
    np.testing.assert_allclose(positions, expected, atol=1e-12)


def test_batch_is_the_stack_of_its_rows():
    robot = arm()
    q = random_configurations(robot, 12, np.random.default_rng(3)).reshape(3, 4, robot.dof)
    batch = forward_kinematics(robot, q)
    assert batch.shape == (3, 4, len(robot.links), 4, 4)
    np.testing.assert_array_equal(batch[2, 1], forward_kinematics(robot, q[2, 1]))
    with pytest.raises(ValueError, match=r"\(3,\).*\(\.\.\., 4\)"):
        forward_kinematics(robot, np.zeros(3))


@pytest.mark.parametrize(
    "mount",
    [
        Pose((0, 0, 1.5)),
        Pose.from_xyz_rpy((0.3, 0.2, 2.0), (np.pi, 0, 0)),
        Pose.from_xyz_rpy((1.0, 0, 0.4), (0, np.pi / 2, 0.3)),
    ],
    ids=["pedestal", "ceiling", "wall"],
)
def test_reach_of_an_arm_does_not_depend_on_its_mount(mount):
    lengths = (0.0, 0.5, 0.3, 0.2)
    links = tuple(Link(f"link{i}") for i in range(4))
    joints = tuple(
        Joint(f"j{i}", "revolute", f"link{i}", f"link{i + 1}", Pose((lengths[i], 0, 0)), (0, 0, 1))
        for i in range(3)
    )
    tool = Frame("tool", "link3", Pose((lengths[3], 0, 0)))
    robot = Robot("planar", links, joints, (tool,), home=(0.0,) * 3)
    stand = Joint("stand", "fixed", "floor", robot.root.name, mount)
    mounted = replace(robot, links=(Link("floor"), *robot.links), joints=(stand, *robot.joints))
    assert reach(robot) == pytest.approx(1.0, rel=1e-4)
    assert arm_reach(mounted) == pytest.approx(1.0, rel=1e-4)
    assert reach(mounted) > 1.1


def test_unwrapped_configurations_are_nearest_to_the_reference():
    robot, rng = ROBOTS[0], np.random.default_rng(0)
    start, ends = rng.uniform(-6, 6, 6), random_configurations(robot, 200, rng)
    unwrapped = unwrap_joints(robot, start, ends)
    assert forward_kinematics(robot, unwrapped) == pytest.approx(forward_kinematics(robot, ends))
    lower, upper = joint_limits(robot).T
    assert (lower <= unwrapped).all()
    assert (unwrapped <= upper).all()
    apart = np.abs(unwrapped - start)
    assert (apart <= np.abs(ends - start) + 1e-9).all()
    others = [unwrapped + turn for turn in (-2 * np.pi, 2 * np.pi)]
    nearer = [
        (np.abs(each - start) < apart - 1e-9) & (lower <= each) & (each <= upper) for each in others
    ]
    assert not np.any(nearer)
    assert (apart < np.abs(ends - start) - 6).any()


def test_joints_beyond_their_limits_do_not_jump():
    arm3 = morphgen.compose("arm=arm3 ee=stick")
    lower, upper = joint_limits(arm3).T
    assert unwrap_joints(arm3, lower, upper + 1e-9) == pytest.approx(
        np.where(upper - lower >= 2 * np.pi, lower + 1e-9, upper + 1e-9)
    )
    gantry = morphgen.compose("base=gantry ee=plane")
    slides = [gantry.joints[k].kind == "prismatic" for k in gantry.independent_joints]
    lower, upper = joint_limits(gantry).T
    assert unwrap_joints(gantry, lower, upper + 1e-9)[slides] == pytest.approx(upper[slides])


def test_a_joint_with_followers_is_not_unwrapped():
    assert periodic_joints(ROBOTS[1]).tolist() == [True] * 7 + [False]

"""Forward and inverse kinematics."""

import math
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

import morphgen
from helpers.robots import arm, chain
from helpers.scenes import robot
from morphgen.formats.mjcf.write import MujocoKinematics
from morphgen.model import kinematics_torch as batched
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    DAMPING,
    MAX_STEP,
    FramePosition,
    dls_step,
    driving_joints,
    forward_kinematics,
    frame_jacobian,
    frame_pose,
    frame_positions,
    joint_axes,
    joint_limits,
    periodic_joints,
    random_configurations,
    reach,
    reach_from_root,
    solve_pose_ik,
    solve_position_ik,
    unwrap_joints,
)
from morphgen.model.robot import Frame, Joint, Link, Mimic, Robot
from morphgen.tasks.rows import angles_between

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
    tree = batched.compile_tree(ROBOTS, dtype=dtype)
    chain = batched.compile_chain(ROBOTS, dtype=dtype)
    index = torch.arange(len(ROBOTS)).repeat_interleave(N)
    q = torch.ones(len(index), max(robot.dof for robot in ROBOTS), dtype=dtype)
    for i, each in enumerate(ROBOTS):
        q[index == i, : each.dof] = torch.from_numpy(drawn(i)).to(dtype)
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
    for i, each in enumerate(ROBOTS):
        rows, links = (index == i).numpy(), len(each.links)
        alone = (
            batched.forward_kinematics(tree, index[rows], q[rows]),
            *batched.frame_jacobian(chain, index[rows], q[rows]),
        )
        for together, result in zip((T_link, T_tool, J), alone, strict=True):
            within = 1e-14 if dtype == torch.float64 else atol
            np.testing.assert_allclose(together[rows], result.numpy(), atol=within)
        T = forward_kinematics(each, drawn(i))
        expected_T, expected_J = frame_jacobian(each, drawn(i))
        assert (T_link[rows, links:] == np.eye(4)).all()
        assert not J[rows][..., each.dof :].any()
        for result, expected in (
            (T_link[rows, :links], T),
            *zip((anchors[rows, :links], axes[rows, :links]), joint_axes(each, T), strict=True),
            (T_tool[rows], expected_T),
            (J[rows][..., : each.dof], expected_J),
            (T_again[rows], expected_T),
            (positions[rows], expected_T[:, :3, 3]),
        ):
            np.testing.assert_allclose(result, expected, atol=atol)


def test_a_robot_with_one_link():
    tree = batched.compile_tree([Robot("stone", (Link("a"),))])
    T = batched.forward_kinematics(tree, torch.tensor([0, 0]), torch.zeros(2, 0))
    assert (torch.eye(4) == T).all()
    assert T.shape == (2, 1, 4, 4)


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
    links = [Link(f"link{i}") for i in range(4)]
    planar = chain(*links, step=(0.25, 0.0, 0.0), axis=(0.0, 0.0, 1.0))
    robot = replace(planar, frames=(Frame("tool", "link3", Pose((0.25, 0.0, 0.0))),))
    stand = Joint("stand", "fixed", "floor", robot.root.name, mount)
    mounted = replace(robot, links=(Link("floor"), *robot.links), joints=(stand, *robot.joints))
    assert reach_from_root(robot) == pytest.approx(1.0, rel=1e-4)
    assert reach(mounted) == pytest.approx(0.75, rel=1e-4)
    assert reach_from_root(mounted) > 1.1


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
    nearer = [(abs(q - start) < apart - 1e-9) & (lower <= q) & (q <= upper) for q in others]
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


REACHING = [robot(words) for words in (*WORDS[:2], "prims", "nlink", "arm=arm3 ee=claw")]
UR5, PANDA = REACHING[:2]
QUARTER_TURN = torch.tensor([[[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]])


class Batch:
    """Rows of ``ROBOTS`` in one batch, in single precision unless said otherwise."""

    def __init__(self, *rows, dtype=torch.float32):
        self.chain = batched.compile_chain(REACHING, dtype=dtype)
        self.robot_index = torch.tensor(rows)
        joints = max(robot.dof for robot in REACHING)
        self.home, *self.limits = torch.zeros(3, len(rows), joints, dtype=dtype)
        for i, body in enumerate(REACHING[row] for row in rows):
            arrays = (np.array(body.home), *joint_limits(body).T)
            for tensor, values in zip((self.home, *self.limits), arrays, strict=True):
                tensor[i, : body.dof] = torch.from_numpy(values)

    def poses(self, q):
        T = batched.frame_pose(self.chain, self.robot_index, q)
        return T[:, :3, 3], T[:, :3, :3]

    def solve(self, q, positions, rotations=None, **options):
        arguments = (q[None], positions, rotations, self.limits)
        q, error = batched.solve_ik(self.chain, self.robot_index, *arguments, **options)
        return q[0], error[0]

    def step(self, q, positions, rotations, **options):
        arguments = (q, positions, rotations, self.limits)
        return batched.pose_ik_step(self.chain, self.robot_index, *arguments, **options)


def test_a_step_solves_the_damped_normal_equations():
    rng = np.random.default_rng(0)
    J, error = rng.normal(size=(5, 6, 7)), rng.normal(size=(5, 6))
    J_T = J.swapaxes(1, 2)
    expected = np.linalg.solve(J_T @ J + 0.09 * np.eye(7), J_T @ error[..., None])[..., 0]
    np.testing.assert_allclose(dls_step(J, error, 0.3), expected, atol=1e-9)
    step = batched.dls_step(torch.from_numpy(J), torch.from_numpy(error), 0.3)
    np.testing.assert_allclose(step.numpy(), expected, atol=1e-9)


@pytest.mark.parametrize("index", range(len(REACHING)))
def test_position_ik_reaches_goals_within_the_limits(index):
    body, rng = REACHING[index], np.random.default_rng(index)
    low, high = joint_limits(body).T
    q = 0.5 * (low + high) + 0.25 * rng.uniform(-1, 1, (6, body.dof)) * (high - low)
    goals = frame_pose(body, np.clip(q + rng.uniform(-0.2, 0.2, q.shape), low, high))[:, :3, 3]
    found, error = solve_position_ik(body, q, goals)
    assert ((low <= found) & (found <= high)).all()
    left = goals - frame_pose(body, found)[:, :3, 3]
    np.testing.assert_allclose(error, left, atol=1e-9)
    assert np.median(np.linalg.norm(left, axis=1)) < 1e-3
    driven = driving_joints(body, body.joint_chain(body.frame("tool").link))
    idle = np.setdiff1d(range(body.dof), driven)
    np.testing.assert_allclose(found[:, idle], q[:, idle], atol=1e-9)
    batch = Batch(*[index] * 6, dtype=torch.float64)
    padded = torch.ones_like(batch.home)
    padded[:, : body.dof] = torch.from_numpy(q)
    same, rest = batch.solve(padded, torch.from_numpy(goals), damping=DAMPING, max_step=MAX_STEP)
    np.testing.assert_allclose(same[:, : body.dof], found, atol=1e-7)
    np.testing.assert_allclose(rest, error, atol=1e-7)


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
    solver = Batch(*np.repeat(range(len(REACHING)), goals * starts))
    low, high = solver.limits
    random = torch.rand(2, *low.shape, generator=torch.Generator().manual_seed(0))
    goal_q = (low + (high - low) * random[0])[::starts].repeat_interleave(starts, 0)
    positions, rotations = solver.poses(goal_q)
    q = low + (high - low) * random[1]
    q, error = solver.solve(q, positions, rotations, rotation_weight=0.2, iterations=60)
    assert ((low <= q) & (q <= high)).all()
    reached, turned = solver.poses(q)
    assert torch.allclose(error[:, :3], positions - reached, atol=1e-5)
    angle = 0.2 * angles_between(turned, rotations)
    assert torch.allclose(error[:, 3:].norm(dim=1), angle, atol=2e-3)
    solved = (error.norm(dim=1) < 3e-3).view(len(REACHING), goals, starts).any(dim=2)
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


@pytest.mark.parametrize("angle", [0.0, 1e-6, 1e-3, 0.5, 1.5, 2.9, 3.0, 3.1415, math.pi])
def test_rotation_vectors_are_the_logarithms_of_rotations(angle):
    axes = np.random.default_rng(0).normal(size=(200, 3))
    axes[:3] = np.eye(3)
    wanted = angle * axes / np.linalg.norm(axes, axis=1, keepdims=True)
    R = torch.from_numpy(Rotation.from_rotvec(wanted).as_matrix()).float()
    rotation_vectors = batched.rotvec_from_matrix(R).double().numpy()
    if angle > 3.1415:  # there are two, and which it is depends on the last bit
        rotation_vectors *= np.sign((rotation_vectors * wanted).sum(axis=1, keepdims=True))
    assert np.abs(rotation_vectors - wanted).max() < 3e-6 * max(angle, 1e-3)


def test_quaternions_agree_with_scipy_in_both_directions():
    turns = Rotation.random(200, rng=np.random.default_rng(0))
    turns_about_axes = (2 * torch.diag(e) - torch.eye(3) for e in torch.eye(3))
    half_turns = torch.stack([torch.eye(3), *turns_about_axes])
    assert torch.allclose(batched.quaternion_from_matrix(half_turns).abs(), torch.eye(4))
    R = torch.from_numpy(turns.as_matrix())
    expected = turns.as_quat(canonical=True, scalar_first=True)
    quaternions = batched.quaternion_from_matrix(R)
    np.testing.assert_allclose(quaternions.numpy(), expected, atol=1e-12)
    torch.testing.assert_close(batched.matrix_from_quaternion(quaternions), R, atol=1e-12, rtol=0)

"""The tree of links, rotations, inertia and dynamics."""

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from helpers.robots import arm
from morphgen.api.robots import compose
from morphgen.errors import RobotError
from morphgen.formats.mjcf.write import to_spec
from morphgen.model import rotation
from morphgen.model.dynamics import (
    BANDWIDTH,
    MIN_RELATIVE_INERTIA,
    MIN_ROTATIONAL_INERTIA,
    MIN_SLIDING_MASS,
    actuation,
    gravity_load,
    mass_matrix,
)
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box, inertial_from_density, solid_mesh
from morphgen.model.kinematics import forward_kinematics, frame_pose, movable_positions
from morphgen.model.kinematics_torch import rotation_from_z
from morphgen.model.robot import Frame, Inertial, Joint, Link, Mimic, Robot
from morphgen.model.tree import rename, scale_links, subtree

STRAIGHT = np.zeros(4)


def test_joints_and_frames_on_a_scaled_link_move_and_its_own_joint_does_not():
    larger = scale_links(arm(), {"upper": 2.0})
    before, after = forward_kinematics(arm(), STRAIGHT), forward_kinematics(larger, STRAIGHT)
    upper, lower, slider = (arm().link_index[name] for name in ("upper", "lower", "slider"))
    assert after[upper] == pytest.approx(before[upper])
    assert after[lower, 2, 3] == pytest.approx(before[lower, 2, 3] + 0.3)
    assert after[slider, 2, 3] == pytest.approx(before[slider, 2, 3] + 0.3)
    tool = scale_links(arm(), {"slider": 0.5})
    gap = frame_pose(arm(), STRAIGHT) - frame_pose(tool, STRAIGHT)
    assert gap[2, 3] == pytest.approx(0.14)
    assert gap[:3, :3] == pytest.approx(np.zeros((3, 3)))


def test_a_robot_scaled_in_every_link_is_the_same_robot_larger():
    q = np.array([0.4, -0.7, 0.0, 0.0])
    larger = scale_links(arm(), {link.name: 1.5 for link in arm().links})
    before, after = forward_kinematics(arm(), q), forward_kinematics(larger, q)
    assert after[:, :3, :3] == pytest.approx(before[:, :3, :3])
    assert after[:, :3, 3] == pytest.approx(1.5 * before[:, :3, 3])
    assert larger.mass == pytest.approx(1.5**3 * arm().mass)
    for a, b in zip(larger.joints, arm().joints, strict=True):
        assert (a.name, a.axis, a.limits, a.mimic) == (b.name, b.axis, b.limits, b.mimic)


def test_all_kinds_of_shapes_scale_uniformly():
    kinds = (Box((1, 2, 3)), Sphere(1.0), Cylinder(1.0, 2.0), Capsule(1.0, 2.0))
    kinds = (*kinds, Mesh(Path("a.stl"), (0.001, 0.001, -0.001), 2))
    twice = (Box((2, 4, 6)), Sphere(2.0), Cylinder(2.0, 4.0), Capsule(2.0, 4.0))
    twice = (*twice, Mesh(Path("a.stl"), (0.002, 0.002, -0.002), 2))
    shapes = tuple(Shape(kind, Pose((1.0, 0.0, 2.0))) for kind in kinds)
    robot = replace(arm(), links=(Link("base", visuals=shapes), *arm().links[1:]))
    grown = scale_links(robot, {"base": 2.0}).link("base").visuals
    assert grown == tuple(Shape(kind, Pose((2.0, 0.0, 4.0))) for kind in twice)


def test_other_links_are_unchanged():
    larger = scale_links(arm(), {"upper": 2.0})
    assert [a == b for a, b in zip(larger.links, arm().links, strict=True)].count(False) == 1
    for same in (scale_links(arm(), {}), scale_links(arm(), {"upper": 1.0})):
        assert (same.links, same.joints, same.frames) == (arm().links, arm().joints, arm().frames)


def test_an_unknown_link_is_an_error():
    for arguments in (({"uper": 2.0},), ({}, {"uper": (0.0, 0.0, 0.0)})):
        with pytest.raises(RobotError, match="uper"):
            scale_links(arm(), *arguments)


AB, FIXED = (Link("a"), Link("b")), Joint("j", "fixed", "a", "b")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Robot("r", ()), "robot 'r' has no links"),
        (lambda: Robot("r", (AB[0],) * 2, (FIXED,)), "two links are named 'a'"),
        (lambda: Robot("r", AB), "2 links need 1 joints, not 0"),
        (lambda: Robot("r", AB, (Joint("j", "fixed", "b", "a"),)), "topological order"),
        (lambda: replace(arm(), home=(0.0,)), "home has 1 values for 4 joints"),
        (lambda: replace(arm(), frames=(Frame("tool", "uper"),)), "did you mean 'upper'"),
        (lambda: arm().link("uper"), "no link 'uper'; did you mean 'upper'"),
        (lambda: arm().frame("tol"), "no frame 'tol'; did you mean 'tool'"),
        (lambda: Robot("r", AB, (replace(FIXED, mimic=Mimic("no")),)), "mimics 'no', an unknown"),
        (lambda: Robot("r", AB, (replace(FIXED, mimic=Mimic("j")),)), "j -> j"),
        (lambda: subtree(arm(), "lower", without=["left"]), "mimics 'left', which is not in"),
    ],
)
def test_contradictions_are_errors(make, message):
    with pytest.raises(RobotError, match=message):
        make()


def test_subtree_keeps_home_frames_and_mimics():
    part = subtree(arm(), "lower")
    assert [link.name for link in part.links] == ["lower", "slider", "left", "right"]
    assert part.home == (0.01, 0.02)
    assert part.frame("tool").link == "slider"


def test_renaming_updates_every_reference():
    robot = rename(arm(), {"slider": "s"}, {"left": "l"})
    assert robot.frame("tool").link == "s"
    assert robot.joints[-1].mimic == Mimic("l", -1.0, 0.0)
    assert robot.joints[-1].parent == "s"


ANGLES = st.floats(-math.pi, math.pi, allow_nan=False)
RPY = st.tuples(ANGLES, st.floats(-math.pi / 2, math.pi / 2), ANGLES)


@given(RPY)
def test_rpy_follows_the_fixed_axis_convention_of_urdf(rpy):
    ours = np.array(rotation.to_matrix(rotation.from_rpy(rpy)))
    np.testing.assert_allclose(ours, Rotation.from_euler("xyz", rpy).as_matrix(), atol=1e-12)


@given(RPY)
def test_rpy_round_trips_through_quaternions_even_near_gimbal_lock(rpy):
    q = rotation.from_rpy(rpy)
    back = rotation.from_rpy(rotation.to_rpy(q))
    np.testing.assert_allclose(rotation.to_matrix(back), rotation.to_matrix(q), atol=1e-8)


@given(RPY, RPY)
def test_product_is_the_product_of_matrices(a, b):
    qa, qb = rotation.from_rpy(a), rotation.from_rpy(b)
    product = np.array(rotation.to_matrix(rotation.multiply(qa, qb)))
    expected = np.array(rotation.to_matrix(qa)) @ np.array(rotation.to_matrix(qb))
    np.testing.assert_allclose(product, expected, atol=1e-12)


@given(RPY)
def test_quaternions_round_trip_through_matrices(rpy):
    q = rotation.from_rpy(rpy)
    assert q[0] >= 0
    back = rotation.from_matrix(rotation.to_matrix(q))
    assert min(np.abs(np.subtract(back, q)).max(), np.abs(np.add(back, q)).max()) < 1e-7


def test_a_zero_quaternion_is_an_error():
    with pytest.raises(ValueError, match="invalid rotation quaternion"):
        rotation.normalize((0.0, 0.0, 0.0, 0.0))


def test_the_smallest_rotation_from_z_maps_z_to_any_axis():
    axes = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    axes = torch.cat([axes / axes.norm(dim=1, keepdim=True), torch.eye(3), -torch.eye(3)])
    R = rotation_from_z(axes)
    torch.testing.assert_close(R[..., 2], axes, atol=1e-5, rtol=0)
    torch.testing.assert_close(R @ R.transpose(1, 2), torch.eye(3).expand_as(R), atol=1e-5, rtol=0)
    torch.testing.assert_close(torch.linalg.det(R), torch.ones(len(R)), atol=1e-5, rtol=0)
    # It is the smallest: its angle is that between z and the axis.
    cosine = (R.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    torch.testing.assert_close(cosine, axes[:, 2], atol=1e-5, rtol=0)


DENSITY = 700.0


def test_cylinder_and_sphere_have_the_textbook_inertia():
    r, length = 0.05, 0.4
    cylinder = inertial_from_density([Shape(Cylinder(r, length))], DENSITY)
    mass = DENSITY * math.pi * r * r * length
    assert cylinder.inertia[0] == pytest.approx(mass * (3 * r * r + length**2) / 12)
    assert cylinder.inertia[5] == pytest.approx(mass * r * r / 2)
    sphere = inertial_from_density([Shape(Sphere(r))], DENSITY)
    assert sphere.inertia[0] == pytest.approx(0.4 * sphere.mass * r * r)
    assert inertial_from_density([], DENSITY).mass == 0.0


@pytest.mark.parametrize(
    "shape", [Capsule(0.05, 0.3), Cylinder(0.05, 0.3), Sphere(0.1), Box((0.1, 0.2, 0.3))]
)
def test_closed_form_agrees_with_the_tessellation(shape):
    mesh = solid_mesh(shape)
    body = inertial_from_density([Shape(shape)], 1.0)
    assert body.mass == pytest.approx(mesh.volume, rel=0.02)
    np.testing.assert_allclose(np.diag(body.matrix), np.diag(mesh.moment_inertia), rtol=0.03)


def test_a_transformed_shape_has_the_transformed_inertia():
    T = Pose.from_xyz_rpy((0.3, -0.1, 0.2), (0.4, 1.0, -0.7))
    still = inertial_from_density([Shape(Box((0.1, 0.2, 0.3)))], DENSITY)
    moved = inertial_from_density([Shape(Box((0.1, 0.2, 0.3)), T)], DENSITY)
    np.testing.assert_allclose(moved.com, T.position, atol=1e-12)
    R = T.matrix[:3, :3]
    np.testing.assert_allclose(moved.matrix, R @ still.matrix @ R.T, atol=1e-12)


def test_overlap_is_counted_once():
    half = Pose((0.05, 0.0, 0.0))
    box = Shape(Box((0.1, 0.1, 0.1)))
    body = inertial_from_density([box, replace(box, T_link_shape=half)], DENSITY)
    whole = inertial_from_density([Shape(Box((0.15, 0.1, 0.1)), Pose((0.025, 0.0, 0.0)))], DENSITY)
    assert body.mass == pytest.approx(whole.mass)
    np.testing.assert_allclose(body.com, whole.com, atol=1e-12)
    np.testing.assert_allclose(body.matrix, whole.matrix, atol=1e-12)


def test_separate_shapes_use_the_closed_forms():
    far = Pose((1.0, 0.0, 0.0))
    body = inertial_from_density([Shape(Sphere(0.1)), Shape(Sphere(0.1), far)], DENSITY)
    one = inertial_from_density([Shape(Sphere(0.1))], DENSITY)
    assert body.mass == pytest.approx(2 * one.mass, rel=1e-14)
    assert body.inertia[3] == pytest.approx(2 * (one.inertia[3] + one.mass * 0.25))


def test_bounding_box_contains_a_rotated_box():
    T = Pose.from_xyz_rpy((0, 0, 0), (0, 0, math.pi / 4))
    low, high = bounding_box([Shape(Box((1.0, 1.0, 0.2)), T)])
    np.testing.assert_allclose(high, [math.sqrt(0.5), math.sqrt(0.5), 0.1], atol=1e-12)
    np.testing.assert_allclose(low, -high, atol=1e-12)


def random_robot(rng):
    """Return a random tree of revolute, prismatic, fixed and mimic joints."""
    links = [Link("l0", random_inertial(rng))]
    joints = []
    for i in range(1, 9):
        kind = rng.choice(["revolute", "prismatic", "continuous", "fixed"], p=[0.4, 0.3, 0.1, 0.2])
        leaders = [j.name for j in joints if j.is_independent]
        follows = kind != "fixed" and bool(leaders) and rng.random() < 0.3
        mimic = Mimic(rng.choice(leaders), rng.normal(), rng.normal()) if follows else None
        T = Pose.from_xyz_rpy(tuple(rng.normal(size=3)), tuple(rng.normal(size=3)))
        links.append(Link(f"l{i}", random_inertial(rng)))
        parent = f"l{rng.integers(i)}"
        axis = tuple(rng.normal(size=3))
        joints.append(Joint(f"j{i}", str(kind), parent, f"l{i}", T, axis, mimic=mimic))
    dof = sum(joint.is_independent for joint in joints)
    return Robot("random", tuple(links), tuple(joints), home=(0.0,) * dof)


def random_inertial(rng):
    points = rng.normal(size=(10, 3))
    second = points.T @ points
    inertia = np.trace(second) * np.eye(3) - second
    x, y, z = rng.normal(size=3)
    return Inertial.from_matrix(rng.uniform(0.1, 3), (x, y, z), inertia * rng.uniform(1e-4, 1))


@pytest.mark.parametrize("seed", range(12))
def test_inertia_and_gravity_equal_those_of_mujoco(seed):
    rng = np.random.default_rng(seed)
    robot = random_robot(rng)
    q = rng.normal(size=robot.dof)
    model = to_spec(robot).compile()
    data = mujoco.MjData(model)
    joints = [model.joint(robot.joints[k].name) for k in robot.movable_joints]
    for joint, value in zip(joints, movable_positions(robot, q), strict=True):
        data.qpos[joint.qposadr[0]] = value
    mujoco.mj_forward(model, data)  # at rest, the bias force is gravity's alone
    dofs = [joint.dofadr[0] for joint in joints]
    assert gravity_load(robot, q) == pytest.approx(data.qfrc_bias[dofs], abs=1e-9)
    full = np.empty((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    full -= np.diag(model.dof_armature)
    matrix, _ = robot.mimic_map
    expected = matrix.T @ full[np.ix_(dofs, dofs)] @ matrix
    assert mass_matrix(robot, q) == pytest.approx(expected, abs=1e-9 * np.abs(expected).max())


def test_armature_raises_light_joints_to_a_fraction_of_the_largest_inertia():
    robot = arm()
    turning, sliding = [], []
    for k, gain in zip(robot.independent_joints, actuation(robot), strict=True):
        kind = sliding if robot.joints[k].kind == "prismatic" else turning
        kind.append(gain.stiffness / BANDWIDTH**2)
    for totals, least in ((turning, MIN_ROTATIONAL_INERTIA), (sliding, MIN_SLIDING_MASS)):
        assert min(totals) >= max(MIN_RELATIVE_INERTIA * max(totals), least) * (1 - 1e-9)
    robot = compose("arm=ur5 ee=plane")
    gains = actuation(robot)
    inertia = np.diag(mass_matrix(robot, robot.home))
    assert gains[0].armature == 0
    assert gains[-1].armature == pytest.approx(MIN_RELATIVE_INERTIA * inertia.max() - inertia[-1])


@pytest.mark.parametrize(
    ("kind", "limits", "least"),
    [
        ("revolute", (-1.0, 1.0), MIN_ROTATIONAL_INERTIA),
        ("continuous", None, MIN_ROTATIONAL_INERTIA),
        ("prismatic", (-1.0, 1.0), MIN_SLIDING_MASS),
    ],
)
def test_gains_use_a_minimum_inertia(kind, limits, least):
    joint = Joint("moves", kind, "root", "leaf", limits=limits)
    (gain,) = actuation(Robot("light", (Link("root"), Link("leaf")), (joint,), home=(0.0,)))
    assert gain.armature == pytest.approx(least)
    assert gain.stiffness == pytest.approx(BANDWIDTH**2 * least)


def test_a_single_joint_settles_without_overshoot():
    inertial = Inertial(2.0, (0.0, 0.0, 0.3), (0.02, 0.0, 0.0, 0.02, 0.0, 0.01))
    joint = Joint("swing", "revolute", "root", "bar", axis=(0, 1, 0), limits=(-2.0, 2.0))
    robot = Robot("pendulum", (Link("root"), Link("bar", inertial)), (joint,), home=(0.0,))
    model = to_spec(robot).compile()
    model.opt.gravity[:] = 0
    data = mujoco.MjData(model)
    data.ctrl[0] = 1.0
    trace = []
    for _ in range(200):
        mujoco.mj_step(model, data)
        trace.append(data.qpos[0])
    assert max(trace) <= 1.0 + 1e-3
    assert trace[-1] == pytest.approx(1.0, abs=1e-3)

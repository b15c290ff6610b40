"""Joint-space inertia agrees with MuJoCo, and gains settle without overshoot."""

import mujoco
import numpy as np
import pytest

from helpers.robots import arm
from morphgen.api.robots import compose
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.dynamics import (
    BANDWIDTH,
    MIN_RELATIVE_INERTIA,
    MIN_ROTATIONAL_INERTIA,
    MIN_SLIDING_MASS,
    actuation,
    armature,
    gravity_load,
    mass_matrix,
)
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Inertial, Joint, Link, Mimic, Robot


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


def test_mass_matrix_of_a_robot_without_joints_is_empty():
    assert mass_matrix(Robot("block", (Link("block", Inertial(1.0)),)), ()).shape == (0, 0)


def test_gains_are_critically_damped():
    robot = arm()
    inertia, (matrix, _) = np.diag(mass_matrix(robot, robot.home)), robot.mimic_map
    gains = actuation(robot)
    assert [gain.joint for gain in gains] == ["shoulder", "elbow", "extend", "left"]
    for gain, total in zip(gains, inertia + armature(robot) @ matrix**2, strict=True):
        assert gain.stiffness == pytest.approx(BANDWIDTH**2 * total)
        ratio = gain.damping / (2 * np.sqrt(gain.stiffness * total))
        assert ratio == pytest.approx(1.0)


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
    ("kind", "least"),
    [
        ("revolute", MIN_ROTATIONAL_INERTIA),
        ("continuous", MIN_ROTATIONAL_INERTIA),
        ("prismatic", MIN_SLIDING_MASS),
    ],
)
def test_gains_use_a_minimum_inertia(kind, least):
    limits = None if kind == "continuous" else (-1.0, 1.0)
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

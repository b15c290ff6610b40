"""Joints hold their positions, and mimic joints follow their leaders, in every simulator."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
import torch

from helpers.robots import arm
from helpers.simulators import PYBULLET, needs_pybullet
from morphgen.api.robots import compose
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.robot import Inertial, Joint, Link, Mimic, Robot
from morphgen.model.tree import subtree
from morphgen.tasks.hold_home import hold_in_environment
from morphgen.tasks.sim.base import CONTROL_PERIOD, Contacts, Scene
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation

STEP, SECONDS = 0.2, 1.0
MAX_ERROR = 0.02


def rod(name, leader, follower, parent, xyz, mass, length, gain=-1.0, axis=(0, 1, 0)):
    """Return a link along x, and its joint, which follows another one if there is a leader."""
    inertia = (mass * length**2 / 100, 0, 0, mass * length**2 / 12, 0, mass * length**2 / 12)
    link = Link(name, Inertial(mass, (length / 2, 0, 0), inertia))
    mimic = Mimic(leader, gain, 0.0) if leader else None
    joint = Joint(
        follower,
        "revolute",
        parent,
        name,
        Pose(xyz),
        axis,
        (-1.5, 1.5),
        effort=600.0,
        velocity=2.0,
        mimic=mimic,
    )
    return link, joint


def chain(*rods):
    links, joints = zip(*rods, strict=True)
    dof = sum(joint.mimic is None for joint in joints)
    return Robot("rods", (Link("base"), *links), joints, home=(0.0,) * dof)


def parallelogram():
    """A palletiser: a light knuckle that stays upright carries the motor of a heavy forearm."""
    return chain(
        rod("turret", None, "waist", "base", (0, 0, 0.3), 35, 0.3, axis=(0, 0, 1)),
        rod("upper", None, "shoulder", "turret", (0, 0, 0.2), 14, 0.6),
        rod("knuckle", "shoulder", "rod1", "upper", (0.6, 0, 0), 2, 0.1),
        rod("fore", None, "elbow", "knuckle", (0, 0, 0), 8, 0.6),
        rod("flange", "elbow", "rod2", "fore", (0.6, 0, 0), 2, 0.1),
        rod("spin", None, "wrist", "flange", (0.05, 0, 0), 0.8, 0.1, axis=(0, 0, 1)),
    )


def heavy_followers():
    """A leader of 20 g, which two jaws of 3 kg follow."""
    return chain(
        rod("arm", None, "shoulder", "base", (0, 0, 0.5), 5, 0.5),
        rod("gear", None, "crank", "arm", (0.5, 0, 0), 0.02, 0.02, axis=(0, 0, 1)),
        rod("left", "crank", "left_jaw", "arm", (0.5, 0.1, 0), 3, 0.3, axis=(0, 0, 1)),
        rod("right", "crank", "right_jaw", "arm", (0.5, -0.1, 0), 3, 0.3, 1.5, axis=(0, 0, 1)),
    )


def folding():
    """Three links that fold together, each twice as far as the one before."""
    return chain(
        rod("a", None, "first", "base", (0, 0, 1), 4, 0.4),
        rod("b", "first", "second", "a", (0.4, 0, 0), 0.2, 0.4, gain=-2.0),
        rod("c", "first", "third", "b", (0.4, 0, 0), 6, 0.4, gain=2.0),
        rod("d", None, "hand", "c", (0.4, 0, 0), 1, 0.2),
    )


ROBOTS = {
    "parallelogram": parallelogram,
    "heavy followers": heavy_followers,
    "folding": folding,
    "robotiq_2f85": lambda: compose("arm=ur5 ee=robotiq_2f85", geometry="primitive"),
    "gen3_lite_2f": lambda: compose("arm=ur5 ee=gen3_lite_2f", geometry="primitive"),
}


def in_mjcf(robot, targets):
    model = to_spec(robot).compile()
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, 0)
    data.ctrl[:] = targets
    joints = [model.joint(robot.joints[k].name).qposadr[0] for k in robot.movable_joints]
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
        yield data.qpos[joints]


def in_environment(simulation, positions, robot, targets):
    rows = torch.tensor(targets[None], dtype=torch.float32)
    for _ in range(round(SECONDS / CONTROL_PERIOD)):
        assert not simulation.step(rows).any()
        yield positions()
    assert simulation.q[0].numpy() == pytest.approx(targets, abs=MAX_ERROR)
    simulation.close()


def in_mujoco(robot, targets):
    simulation = MujocoSimulation([Scene(robot)], Contacts(False, False))
    return in_environment(simulation, lambda: simulation.movable_q(0), robot, targets)


def in_bullet(robot, targets):
    pytest.importorskip("pybullet", reason="PyBullet is not installed")
    from morphgen.tasks.sim.bullet import BulletSimulation

    simulation = BulletSimulation([Scene(robot)], Contacts(False, False))
    return in_environment(simulation, lambda: simulation.movable_q(0), robot, targets)


@pytest.mark.parametrize("simulate", [in_mjcf, in_mujoco, in_bullet])
@pytest.mark.parametrize("name", ROBOTS)
def test_followers_stay_with_their_leaders_when_a_joint_steps(name, simulate):
    robot = ROBOTS[name]()
    matrix, offset = robot.mimic_map
    leaders = [robot.movable_joints.index(k) for k in robot.independent_joints]
    for joint in range(robot.dof):
        targets, limits = np.array(robot.home), robot.joints[robot.independent_joints[joint]].limits
        targets[joint] += STEP if limits is None or targets[joint] + STEP < limits[1] else -STEP
        path = np.array(list(simulate(robot, targets)))
        assert np.abs(path - path[:, leaders] @ matrix.T - offset).max() < MAX_ERROR


@pytest.mark.parametrize("simulator", ["mujoco", PYBULLET])
def test_an_arm_holds_home_and_steps(simulator):
    robot = subtree(arm(), "base", without=["left", "right"])
    row = hold_in_environment(robot, simulator)
    assert (row.simulator, row.passed, row.message) == (f"{simulator} (environment)", True, "")
    assert row.drift < 1e-5
    assert row.step_error < 1e-3
    assert 0.1 < row.settling_time < 0.5


def test_mimic_joints_are_read_from_the_simulation(monkeypatch):
    """The environment's own positions are those of the leaders only."""
    real = MujocoSimulation.movable_q
    monkeypatch.setattr(
        MujocoSimulation, "movable_q", lambda *args: np.add(real(*args), [0, 0, 0, 0, 0.01])
    )
    row = hold_in_environment(arm(), "mujoco")
    assert (row.joint, row.drift) == ("right", pytest.approx(0.01, rel=1e-3))


@pytest.mark.parametrize("simulator", ["mujoco", PYBULLET])
def test_links_that_penetrate_at_home_move_the_arm(simulator):
    robot = arm()
    ball = Shape(Sphere(0.1), Pose((0.0, 0.0, 0.05)))  # reaches into the base
    slider = replace(robot.link("slider"), collisions=(Shape(Sphere(0.7)), ball))
    row = hold_in_environment(robot.with_links([slider]), simulator)
    assert row.passed is False
    assert row.drift is None or row.drift > 0.02


@needs_pybullet
def test_links_that_touch_at_home_are_named():
    """The fingers of this robot stand on the flange of the wrist, without penetrating it."""
    robot = compose("jaco2_6dof-hand")
    assert hold_in_environment(robot, "mujoco").passed
    row = hold_in_environment(robot, "pybullet")
    assert row.passed is False
    margin = "come within PyBullet's collision margin, to 0.0034 mm"
    assert f"arm_j2n6s300_link_5, ee_f0_proximal {margin}" in row.causes


@needs_pybullet
@pytest.mark.parametrize("arm_name", ["xarm7", "ur3", "iiwa14"])
def test_light_fingers_stay_with_their_leader_when_the_arm_swings_them(arm_name):
    """Its fingertips are light: what parts them from their leader is mostly centrifugal force."""
    row = hold_in_environment(compose(f"arm={arm_name} ee=tiago_pro_gripper"), "pybullet")
    assert row.follower_error < 0.02

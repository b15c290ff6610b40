"""Robots hold their home configuration in environments; links that penetrate push them away."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm
from helpers.simulators import PYBULLET, needs_pybullet
from morphgen.api.robots import compose
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.tree import subtree
from morphgen.tasks.hold_home import hold_in_environment
from morphgen.tasks.sim.mujoco_sim import MujocoSimulation


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

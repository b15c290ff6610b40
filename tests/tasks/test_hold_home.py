"""Robots hold their home configuration in environments; links that penetrate push them away."""

from dataclasses import replace

import pytest

from helpers.robots import arm
from helpers.simulators import PYBULLET, needs_pybullet
from morphgen.api.robots import compose
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.tasks.hold_home import hold_in_environment


@pytest.mark.parametrize("simulator", ["mujoco", PYBULLET])
def test_an_arm_holds_home(simulator):
    row = hold_in_environment(arm(), simulator)
    assert (row.simulator, row.passed, row.message) == (f"{simulator} (environment)", True, "")
    assert row.drift < 1e-5


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
    touching = "arm_j2n6s300_link_5, ee_f0_proximal are 0.0034 mm apart at home"
    assert touching in row.message

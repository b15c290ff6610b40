"""Force limits of the joint motors."""

import numpy as np
import pytest

from helpers.robots import finger
from helpers.scenes import robot
from morphgen.model.dynamics import BANDWIDTH, actuation, mass_matrix
from morphgen.model.geometry import Pose
from morphgen.model.robot import Inertial, Joint, Link, Mimic, Robot
from morphgen.tasks.sim.motor_law import (
    GAIN,
    LAG,
    SLACK,
    MotorForces,
)

PLENTY = 1e9


def limits(body, error, velocity=0.0, effort=PLENTY):
    rows = len(body.movable_joints)
    errors, velocities = (np.broadcast_to(each, rows).astype(float) for each in (error, velocity))
    motors = MotorForces([body], [effort] * rows)
    return motors.limits((errors, errors), (velocities, velocities))


def test_joint_forces_of_an_arm_are_coupled():
    body = robot("arm=ur5 ee=plane")
    error = np.linspace(0.01, -0.02, body.dof)
    inertia = np.abs(mass_matrix(body, body.home))
    inertia += np.diag([each.armature for each in actuation(body)])
    wanted = (1 + SLACK) * GAIN * inertia @ (BANDWIDTH**2 * np.abs(error))
    np.testing.assert_allclose(limits(body, error), wanted, rtol=1e-12)


def test_force_is_zero_at_rest_and_never_exceeds_the_effort():
    assert (limits(finger(), 0.0) == 0).all()
    assert (limits(finger(), 0.05, effort=3.0) == 3).all()


def test_position_error_is_limited_by_the_speed_limit():
    fast = 2.0
    assert (limits(finger(), 50.0) == limits(finger(), LAG * fast)).all()


@pytest.mark.parametrize("mass", [0.1, 1.0, 5.0])
def test_fingers_that_move_apart_carry_their_own_inertia(mass):
    bar = Link("arm", Inertial(2.0, (0.25, 0, 0), (0.01, 0, 0, 0.05, 0, 0.05)))
    tip = Inertial(mass, (0, 0, 0), (1e-4, 0, 0, 1e-4, 0, 1e-4))
    links = (Link("base"), bar, Link("left", tip), Link("right", tip))
    strength = {"limits": (-0.5, 0.5), "effort": 50.0, "velocity": 1.0}
    joints = (
        Joint("turn", "revolute", "base", "arm", axis=(0, 0, 1), **strength),
        *(
            Joint(name, "prismatic", "arm", name, Pose((0.5, 0, 0)), axis, mimic=mimic, **strength)
            for name, axis, mimic in (
                ("left", (0, 1, 0), None),
                ("right", (0, -1, 0), Mimic("left", 1.0, 0.0)),
            )
        ),
    )
    body = Robot("gripper", links, joints, home=(0.0, 0.0))
    forces = limits(body, [0.01, 0.0, 0.0])
    # A finger is 0.5 m from the arm's axis; the forces on both cancel in the joint that moves them.
    wanted = (1 + SLACK) * GAIN * 0.5 * mass * BANDWIDTH**2 * 0.01
    assert forces[1:] == pytest.approx([wanted, wanted])

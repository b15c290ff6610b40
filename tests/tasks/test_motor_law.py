"""How hard motors may pull."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm, finger
from helpers.scenes import robot
from morphgen.model.dynamics import BANDWIDTH, actuation, mass_matrix
from morphgen.tasks.sim.motor_law import (
    FASTEST_SLIDE,
    FASTEST_TURN,
    GAIN,
    LAG,
    SLACK,
    MotorForces,
    speed_limit,
)

PLENTY = 1e9


def limits(body, error, velocity=0.0, effort=PLENTY):
    rows = len(body.movable_joints)
    errors, velocities = (np.broadcast_to(each, rows).astype(float) for each in (error, velocity))
    motors = MotorForces([body], [effort] * rows)
    return motors.limits((errors, errors), (velocities, velocities))


def test_a_held_slide_pulls_as_its_stiffness_says():
    (along, up) = limits(finger(2.0), 0.01)
    spring = (1 + SLACK) * GAIN * BANDWIDTH**2 * 0.01
    assert along == pytest.approx(spring * 2.2)
    assert up == pytest.approx(spring * 2.0)


def test_joints_of_an_arm_pull_each_other():
    body = robot("arm=ur5 ee=plane")
    error = np.linspace(0.01, -0.02, body.dof)
    inertia = np.abs(mass_matrix(body, body.home))
    inertia += np.diag([each.armature for each in actuation(body)])
    wanted = (1 + SLACK) * GAIN * inertia @ (BANDWIDTH**2 * np.abs(error))
    np.testing.assert_allclose(limits(body, error), wanted, rtol=1e-12)


def test_a_finger_follows_its_leader():
    body = arm()
    error = np.zeros(5)
    error[body.movable_joints.index(body.joint_index["left"])] = 0.01
    left, right = limits(body, error)[-2:]
    assert left == right > 0


def test_at_rest_nothing_pulls_and_no_more_than_the_effort_ever():
    assert (limits(finger(), 0.0) == 0).all()
    assert (limits(finger(), 0.05, effort=3.0) == 3).all()


def test_a_motor_that_lags_as_much_as_its_speed_says_has_slack_alone():
    speed = 0.3
    (along, _) = limits(finger(2.0), 2 * speed / BANDWIDTH, speed)
    assert along == pytest.approx(SLACK * GAIN * 2.2 * 4 * BANDWIDTH * speed)


def test_what_is_far_behind_pulls_no_harder_than_its_speed_limit_needs():
    fast = 2.0
    assert (limits(finger(), 50.0) == limits(finger(), LAG * fast)).all()


def test_a_robot_has_the_same_bits_alone_and_among_others():
    bodies = [finger(), robot("arm=ur5 ee=plane"), arm()]
    rows = [len(body.movable_joints) for body in bodies]
    error = np.random.default_rng(0).normal(size=sum(rows))
    every = MotorForces(bodies, [PLENTY] * sum(rows)).limits((error, error), (error, error))
    ends = np.cumsum(rows)
    for body, n, end in zip(bodies, rows, ends, strict=True):
        own = error[end - n : end]
        alone = MotorForces([body], [PLENTY] * n).limits((own, own), (own, own))
        assert (alone == every[end - n : end]).all()


def test_joints_without_a_speed_limit_have_the_benchmarks():
    body = arm()
    joints = {joint.name: joint for joint in body.joints}
    assert speed_limit(joints["elbow"]) == 2.0
    assert speed_limit(replace(joints["elbow"], velocity=None)) == FASTEST_TURN
    assert speed_limit(replace(joints["left"], velocity=None)) == FASTEST_SLIDE

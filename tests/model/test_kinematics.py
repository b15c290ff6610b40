"""Forward kinematics: closed forms, batches, mimic joints and reach."""

import math
from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm
from morphgen.api.robots import compose
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    arm_reach,
    forward_kinematics,
    joint_limits,
    periodic_joints,
    random_configurations,
    reach,
    unwrap_joints,
)
from morphgen.model.robot import Frame, Joint, Link, Robot


def planar(lengths=(0.5, 0.3)):
    links = tuple(Link(f"link{i}") for i in range(len(lengths) + 1))
    joints = tuple(
        Joint(
            f"joint{i}",
            "revolute",
            f"link{i}",
            f"link{i + 1}",
            Pose((lengths[i - 1] if i else 0.0, 0.0, 0.0)),
            (0.0, 0.0, 1.0),
            (-math.pi, math.pi),
        )
        for i in range(len(lengths))
    )
    tool = Frame("tool", links[-1].name, Pose((lengths[-1], 0.0, 0.0)))
    return Robot("planar", links, joints, (tool,), home=(0.0,) * len(lengths))


def test_batch_is_the_stack_of_its_rows():
    robot = arm()
    q = random_configurations(robot, 12, np.random.default_rng(3)).reshape(3, 4, robot.dof)
    batch = forward_kinematics(robot, q)
    assert batch.shape == (3, 4, len(robot.links), 4, 4)
    np.testing.assert_array_equal(batch[2, 1], forward_kinematics(robot, q[2, 1]))


def test_q_of_wrong_length_is_refused_with_both_shapes():
    with pytest.raises(ValueError, match=r"\(3,\).*\(\.\.\., 2\)"):
        forward_kinematics(planar(), np.zeros(3))


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
    robot = planar((0.5, 0.3, 0.2))
    stand = Joint("stand", "fixed", "floor", robot.root.name, mount)
    mounted = replace(robot, links=(Link("floor"), *robot.links), joints=(stand, *robot.joints))
    assert reach(robot) == pytest.approx(1.0, rel=1e-4)
    assert arm_reach(mounted) == pytest.approx(1.0, rel=1e-4)
    assert reach(mounted) > 1.1


def test_unwrapped_configurations_are_nearest_to_the_reference():
    body = compose("arm=ur5 ee=plane")
    rng = np.random.default_rng(0)
    start, ends = rng.uniform(-6, 6, 6), random_configurations(body, 200, rng)
    unwrapped = unwrap_joints(body, start, ends)
    assert forward_kinematics(body, unwrapped) == pytest.approx(forward_kinematics(body, ends))
    lower, upper = joint_limits(body).T
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
    arm3 = compose("arm=arm3 ee=stick")
    lower, upper = joint_limits(arm3).T
    assert unwrap_joints(arm3, lower, upper + 1e-9) == pytest.approx(
        np.where(upper - lower >= 2 * np.pi, lower + 1e-9, upper + 1e-9)
    )
    gantry = compose("base=gantry ee=plane")
    slides = [gantry.joints[k].kind == "prismatic" for k in gantry.independent_joints]
    lower, upper = joint_limits(gantry).T
    assert unwrap_joints(gantry, lower, upper + 1e-9)[slides] == pytest.approx(upper[slides])


def test_a_joint_with_followers_is_not_unwrapped():
    turns = periodic_joints(compose("arm=panda ee=panda_hand"))
    assert turns.tolist() == [True] * 7 + [False]

"""Workspaces relative to the shoulder and in units of reach."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

import morphgen
from helpers.robots import arm
from morphgen.benchmark.similarity import density_overlap, shoulder, workspace
from morphgen.errors import BenchmarkError
from morphgen.model.geometry import Pose
from morphgen.model.kinematics import (
    reach,
)
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.model.tree import scale_links

LWR = "arm=lwr ee=plane"


def chain(*joints, tool=(0.0, 0.0, 0.5)):
    """A chain of joints (kind, origin, axis) with a tool."""
    made = [
        Joint(f"j{k}", kind, f"l{k}", f"l{k + 1}", Pose(origin), axis, limits=(-1.0, 1.0))
        for k, (kind, origin, axis) in enumerate(joints)
    ]
    links = tuple(Link(f"l{k}") for k in range(len(made) + 1))
    home = (0.0,) * sum(joint.is_movable for joint in made)
    return Robot("chain", links, tuple(made), (Frame("tool", links[-1].name, Pose(tool)),), home)


def test_the_density_is_normalized_and_reproducible():
    found, again = workspace(arm()), workspace(arm())
    assert found.density.shape == (21, 21, 21)
    assert found.density.sum() == pytest.approx(1)
    assert (found.density >= 0).all()
    np.testing.assert_array_equal(found.density, again.density)
    assert density_overlap(found, again) == pytest.approx(1, abs=1e-12)


def test_the_overlap_is_symmetric_and_in_the_unit_interval():
    a, b = (workspace(morphgen.compose(words)) for words in (LWR, "arm3"))
    assert density_overlap(a, b) == density_overlap(b, a)
    assert 0.3 < density_overlap(a, b) < 0.9


def test_disjoint_workspaces_have_no_overlap():
    up = workspace(chain(("revolute", (0, 0, 0), (1, 0, 0))))
    flat = workspace(chain(("revolute", (0, 0, 0), (0, 0, 1)), tool=(0.5, 0.0, 0.0)))
    assert density_overlap(up, flat) == 0.0


def test_the_workspace_of_a_revolute_joint_is_a_circle():
    result = workspace(chain(("revolute", (0, 0, 1), (0, 0, 1)), tool=(0.5, 0.0, 0.2)))
    assert result.shoulder == pytest.approx((0, 0, 1.2))
    assert result.reach == pytest.approx(0.5)
    nodes = (np.argwhere(result.density > 0) - 10) / 10
    assert (np.abs(np.linalg.norm(nodes, axis=1) - 1) < 0.15).all()
    assert set(nodes[:, 2]) == {0.0}
    assert nodes[:, 0].min() > 0.4  # limits of one radian


@pytest.mark.parametrize("factor", [0.01, 3.0])
def test_the_scale_of_a_robot_does_not_matter(factor):
    robot = morphgen.compose(LWR)
    large = scale_links(robot, {link.name: factor for link in robot.links})
    assert workspace(large).reach == pytest.approx(factor * workspace(robot).reach)
    assert density_overlap(workspace(robot), workspace(large)) == pytest.approx(1, abs=1e-9)


def test_the_pedestal_does_not_matter():
    robot = workspace(morphgen.compose(LWR))
    raised = workspace(morphgen.compose(f"base=pedestal {LWR}"))
    assert raised.shoulder[2] > robot.shoulder[2] + 0.1
    assert density_overlap(robot, raised) == pytest.approx(1, abs=1e-9)


def test_the_origin_of_a_joint_on_its_axis_does_not_matter():
    robot = morphgen.compose(LWR)
    first = next(k for k in robot.independent_joints)
    child = robot.joints[first].child
    down = Pose(tuple(-0.1 * value for value in robot.joints[first].unit_axis))
    up = down.inverse()
    joints = [
        replace(joint, T_parent_joint=up @ joint.T_parent_joint) if joint.parent == child else joint
        for joint in robot.joints
    ]
    joints[first] = replace(joints[first], T_parent_joint=joints[first].T_parent_joint @ down)
    moved = replace(robot, joints=tuple(joints))
    assert reach(moved) == pytest.approx(reach(robot))
    assert shoulder(moved) == pytest.approx(shoulder(robot))
    assert density_overlap(workspace(moved), workspace(robot)) == pytest.approx(1, abs=1e-9)


def test_the_shoulder_is_the_intersection_of_the_first_two_axes():
    turn = ("revolute", (0.3, 0, 0.1), (0, 0, 1))
    lift = ("revolute", (0.1, 0, 0.4), (0, 1, 0))
    assert shoulder(chain(turn, lift)) == pytest.approx((0.3, 0, 0.5))
    again = ("revolute", (0.2, 0, 0.2), (0, 0, 1))
    assert shoulder(chain(turn, again, lift)) == pytest.approx((0.3, 0, 0.7))


def test_the_shoulder_is_found_where_axes_cross_at_an_angle():
    turn = ("revolute", (0, 0, 0.1), (0, 0, 1))
    oblique = ("revolute", (0.1, 0.8, 0.9), (0, 0.8, 0.6))
    assert shoulder(chain(turn, oblique)) == pytest.approx((0, 0, 0.4))


def test_the_shoulder_of_a_planar_arm_is_in_its_plane():
    turn = ("revolute", (0.3, 0, 0.1), (0, 0, 1))
    assert shoulder(chain(turn, turn, tool=(0.5, 0, 0.4))) == pytest.approx((0.3, 0, 0.6))


def test_the_shoulder_of_prismatic_robots_is_the_middle_of_their_travel():
    slide = ("prismatic", (0.3, 0, 0), (1, 0, 0))
    far = replace(chain(slide, tool=(0, 0, 0)).joints[0], limits=(0.0, 3.0))
    robot = replace(chain(slide, tool=(0, 0, 0)), joints=(far,))
    result = workspace(robot)
    assert result.shoulder == pytest.approx((1.8, 0, 0))
    assert result.reach == pytest.approx(1.5, rel=1e-3)


def test_the_samples_of_an_arm_do_not_depend_on_its_gripper():
    robot = arm()
    other = replace(
        robot,
        links=(robot.root, Link("flap"), *robot.links[1:]),
        joints=(
            Joint("flap", "revolute", "base", "flap", limits=(-1.0, 1.0)),
            *robot.joints,
        ),
        home=(0.0, *robot.home),
    )
    assert density_overlap(workspace(robot), workspace(other)) == pytest.approx(1, abs=1e-5)


def test_densities_depend_less_on_the_number_of_samples_than_occupied_cells():
    requests = (LWR, "arm3", "arm5", "chain beads=3", "prims", "planar_arm")
    robots = [morphgen.compose(request) for request in requests]
    few, many = ([workspace(robot, n) for robot in robots] for n in (32_768, 131_072))

    def mean_change(measured):
        pairs = itertools.combinations(range(len(robots)), 2)
        return np.mean(
            [abs(measured(few[i], few[j]) - measured(many[i], many[j])) for i, j in pairs]
        )

    assert mean_change(density_overlap) < 0.005
    assert mean_change(density_overlap) < 0.3 * mean_change(shared_cells)


def shared_cells(a, b):
    """Return the intersection over union of the occupied cells."""
    mine, yours = a.density > 0, b.density > 0
    return (mine & yours).sum() / (mine | yours).sum()


def test_a_missing_tool_is_an_error_that_names_the_remedy():
    with pytest.raises(BenchmarkError, match=r"'arm' has no frame 'tool'.*import FILE --tool LINK"):
        workspace(replace(arm(), frames=()))


def test_an_immobile_tool_is_an_error():
    with pytest.raises(BenchmarkError, match="no joint moves its tool, which is on link 'base'"):
        workspace(replace(arm(), frames=(Frame("tool", "base"),)))


def test_a_tool_on_its_only_axis_is_an_error():
    with pytest.raises(BenchmarkError, match="only turns about its own origin"):
        workspace(chain(("revolute", (0, 0, 1), (0, 0, 1))))


@pytest.mark.parametrize("limits", [(0.0, np.inf), (1.0, -1.0), (np.nan, 1.0)])
def test_limits_without_a_range_are_an_error(limits):
    robot = arm()
    joint = replace(robot.joints[1], limits=limits)
    wrong = replace(robot, joints=(robot.joints[0], joint, *robot.joints[2:]))
    with pytest.raises(BenchmarkError, match=r"joint 'elbow': limits .* morphgen check"):
        workspace(wrong)

"""Validation of ``Robot``, and edits of its tree: cut, renamed and scaled."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.robots import arm
from morphgen.errors import RobotError
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.kinematics import forward_kinematics, frame_pose
from morphgen.model.robot import Frame, Joint, Link, Mimic, Robot
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
    mesh = Mesh(Path("a.stl"), (0.001, 0.001, -0.001), 2)
    kinds = (Box((1, 2, 3)), Sphere(1.0), Cylinder(1.0, 2.0), Capsule(1.0, 2.0), mesh)
    shapes = tuple(Shape(kind, Pose((1.0, 0.0, 2.0))) for kind in kinds)
    robot = replace(arm(), links=(Link("base", visuals=shapes), *arm().links[1:]))
    grown = scale_links(robot, {"base": 2.0}).link("base").visuals
    assert [shape.geometry for shape in grown] == [
        Box((2, 4, 6)),
        Sphere(2.0),
        Cylinder(2.0, 4.0),
        Capsule(2.0, 4.0),
        Mesh(Path("a.stl"), (0.002, 0.002, -0.002), 2),
    ]
    assert {shape.T_link_shape.position for shape in grown} == {(2.0, 0.0, 4.0)}


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

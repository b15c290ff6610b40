"""Texts, tables and joint configurations of the robot page."""

from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm
from morphgen.model.robot import Inertial
from morphgen.viewer.pages.robot_show import format_joints, free_configuration, parse_joints
from morphgen.viewer.robot_tables import (
    joint_groups,
    joint_hint,
    link_details,
    link_table,
    slider_step,
    summary,
)
from morphgen.viewer.scene.stage import inertia_box


def test_joints_are_grouped_by_their_part():
    robot = arm()
    assert [(chain.title, chain.rows) for chain in joint_groups(robot)] == [
        ("joints", (0, 1, 2, 3))
    ]
    renamed = tuple(
        replace(joint, name=f"{'ee' if i > 2 else 'arm'}_{joint.name}", mimic=None, limits=(-1, 1))
        for i, joint in enumerate(robot.joints)
    )
    parts = [{"label": "arm", "part": "x"}, {"label": "ee", "part": "y"}]
    named = replace(robot, joints=renamed, home=(0,) * 5, provenance={"parts": parts})
    assert [(c.title, c.rows) for c in joint_groups(named)] == [
        ("arm (x)", (0, 1, 2)),
        ("ee (y)", (3, 4)),
    ]


def test_slider_hint_names_joint_type_and_limits():
    assert joint_hint(arm().joints[0]) == (
        "shoulder: revolute, -2 to 2 rad, at most 50 N m, 2 rad/s"
    )
    assert joint_hint(arm().joints[2]).startswith("extend: prismatic, 0 to 0.04 m, at most 20 N")


@pytest.mark.parametrize(
    ("low", "high", "step"), [(-3.14, 3.14, 0.01), (0, 0.04, 0.0001), (0, 0, 0.001), (-1, 1, 0.01)]
)
def test_slider_steps_are_round_and_small(low, high, step):
    assert slider_step(low, high) == pytest.approx(step)


def test_tables_name_every_link_and_escape_it():
    robot = arm()
    table = link_table(robot)
    assert all(link.name in table for link in robot.links)
    assert "prismatic (mimic)" in table
    odd = replace(
        robot,
        links=(replace(robot.links[0], name="<b>"), *robot.links[1:]),
        joints=(replace(robot.joints[0], parent="<b>"), *robot.joints[1:]),
    )
    assert "&lt;b&gt;" in link_table(odd)
    assert "<b><b></b>" not in link_details(odd, "<b>")
    assert "mimics" in link_details(robot, "right")
    assert summary(robot, 0.9).startswith("6 links · 4 DoF · 1 mimic joint · ")


def test_configurations_are_restored_from_urls():
    robot = arm()
    q = np.array([0.1234, -1.5, 0.02, 0.04])
    assert parse_joints(format_joints(q), robot) == pytest.approx(q)
    assert parse_joints("9,9,9,9", robot) == pytest.approx([2, 2, 0.04, 0.04])
    for bad in ("", "1,2", "a,b,c,d", "nan,0,0,0"):
        assert parse_joints(bad, robot) is None


def test_the_box_has_the_inertia_of_the_link():
    a, b, c, m = 0.1, 0.2, 0.3, 2.0
    moments = np.array([b * b + c * c, a * a + c * c, a * a + b * b]) * m / 12
    box = inertia_box(Inertial.from_matrix(m, (0, 0, 0), np.diag(moments)))
    assert box is not None
    sizes, axes = box
    rebuilt = axes @ np.diag(m / 12 * (np.sum(sizes**2) - sizes**2)) @ axes.T
    assert rebuilt == pytest.approx(np.diag(moments))
    assert np.linalg.det(axes) == pytest.approx(1)
    assert inertia_box(Inertial(0.0)) is None
    assert inertia_box(Inertial.from_matrix(1.0, (0, 0, 0), np.diag([1.0, 0.1, 0.1]))) is None


def test_random_free_configuration_is_collision_free():
    from morphgen.checks.self_collision import SelfCollisionChecker

    robot = arm()
    checker = SelfCollisionChecker(robot)
    q = free_configuration(checker, robot, np.random.default_rng(0))
    assert q is not None
    assert list(checker.penetrations([q])) == [{}]

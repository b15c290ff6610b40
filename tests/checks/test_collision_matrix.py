"""Reasons of the collision matrix against brute force, and the SRDF that is made of it."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from helpers.composed import composed
from helpers.robots import arm
from morphgen.checks.robot_srdf import collision_matrix, robot_srdf_text
from morphgen.checks.self_collision import ALWAYS_SHARE, PENETRATION
from morphgen.errors import FormatError
from morphgen.formats.srdf import LinkSpheres, parse_srdf, read_srdf, with_disabled_pairs
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.kinematics import forward_kinematics, random_configurations
from morphgen.model.robot import Frame, Joint, Link, Robot

SAMPLES = 400


def ball(name, radius):
    return Link(name, collisions=(Shape(Sphere(radius)),))


def at(x, z):
    return Pose((x, 0.0, z))


def balls():
    """A robot of one ball per link, so that its collisions are distances between centres."""
    links = (
        ball("base", 0.1),
        ball("turn", 0.05),
        Link("bare"),
        ball("knob", 0.05),
        ball("slide", 0.05),
        ball("post", 0.1),
        ball("top", 0.1),
        ball("carrier", 0.05),
        ball("big", 0.87),
    )
    joints = (
        Joint("turn", "revolute", "base", "turn", at(0.3, 0.0), (0, 0, 1), (-3.0, 3.0)),
        Joint("bare", "fixed", "turn", "bare", at(0.0, 0.1)),
        Joint("knob", "fixed", "bare", "knob", at(0.0, 0.1)),
        Joint("slide", "prismatic", "knob", "slide", at(0.0, 0.0), (0, 0, 1), (-0.5, 0.5)),
        Joint("post", "fixed", "base", "post", at(0.0, 0.25)),
        Joint("top", "fixed", "post", "top", at(0.0, -0.1)),
        Joint("carrier", "prismatic", "base", "carrier", at(0.0, 3.0), (1, 0, 0), (0.0, 1.0)),
        Joint("big", "fixed", "carrier", "big", at(0.0, -2.75)),
    )
    home = (0.0, 0.3, 1.0)
    return Robot("balls", links, joints, (Frame("tool", "slide"),), home, (("bare", "turn"),))


def colliding_pairs(robot, q):
    """Sets of pairs of colliding balls at configurations, by the distances of their centres."""
    centres = forward_kinematics(robot, q)[..., :3, 3]
    result = [set() for _ in q]
    bodies = [(i, link) for i, link in enumerate(robot.links) if link.collisions]
    for (i, a), (j, b) in combinations(bodies, 2):
        reach = sum(link.collisions[0].geometry.radius for link in (a, b)) - PENETRATION
        distances = np.linalg.norm(centres[:, i] - centres[:, j], axis=-1)
        for k in np.flatnonzero(distances < reach):
            result[k].add(tuple(sorted((a.name, b.name))))
    return result


def test_reasons_and_counts_agree_with_brute_force():
    robot = balls()
    matrix = collision_matrix(robot, samples=SAMPLES, seed=5)
    q = random_configurations(robot, SAMPLES, np.random.default_rng(5))
    colliding = colliding_pairs(robot, q)
    counts = {
        pair: sum(pair in pairs for pairs in colliding) for pair in sorted(set().union(*colliding))
    }
    assert matrix.collisions == counts
    linked = {
        ("base", "turn"),
        ("knob", "turn"),
        ("knob", "slide"),
        ("base", "post"),
        ("post", "top"),
        ("base", "carrier"),
        ("big", "carrier"),
    }
    (at_home,) = colliding_pairs(robot, np.array([robot.home]))
    names = sorted(link.name for link in robot.links if link.collisions)
    expected = {("bare", "turn"): "User"}
    for pair in combinations(names, 2):
        count = counts.get(pair, 0)
        if pair in linked:
            expected[pair] = "Adjacent"
        elif pair in at_home:
            expected[pair] = "Default"
        elif count >= ALWAYS_SHARE * SAMPLES:
            expected[pair] = "Always"
        elif count == 0:
            expected[pair] = "Never"
    assert matrix.reasons == dict(sorted(expected.items()))
    assert set(matrix.reasons.values()) == {"Adjacent", "Default", "Always", "Never", "User"}
    assert matrix.reasons["base", "top"] == "Default"  # fixed to each other
    assert matrix.reasons["big", "post"] == "Always"
    assert ("slide", "turn") not in matrix.reasons  # collides at times
    assert matrix.num_pairs == 28


def test_srdf_holds_the_matrix_with_its_evidence():
    robot = balls()
    text = robot_srdf_text(robot, samples=50, seed=1)
    matrix = collision_matrix(robot, samples=50, seed=1)
    srdf = parse_srdf(text.encode(), "balls")
    disabled = srdf.findall("disable_collisions")
    assert {(p.get("link1"), p.get("link2")): p.get("reason") for p in disabled} == matrix.reasons
    assert "28 pairs of links with collision shapes, 50 configurations sampled with seed 1" in text
    defaults = [*matrix.reasons.values()].count("Default")
    assert f"7 Adjacent, {defaults} Default" in text
    assert text == robot_srdf_text(robot, samples=50, seed=1)
    assert set(with_disabled_pairs(robot, srdf).ignore_pairs) == set(matrix.reasons)


TEXT = """\
<robot name="arm &amp; &quot;hand&quot;">
  <group name="arm">
    <chain base_link="base" tip_link="tool"/>
  </group>
  <group name="ee">
    <link name="left"/>
    <link name="right"/>
  </group>
  <group_state name="home" group="arm">
    <joint name="shoulder" value="0.30000000000000004"/>
    <joint name="elbow" value="-1e-17"/>
    <joint name="extend" value="0.01"/>
  </group_state>
  <group_state name="home" group="ee">
    <joint name="left" value="0.02"/>
  </group_state>
  <end_effector name="ee" parent_link="slider" group="ee" parent_group="arm"/>
  <link_sphere_approximation link="upper">
    <sphere center="0.1 -0.2 0.14285714285714285" radius="0.05"/>
  </link_sphere_approximation>
  <!-- """


def test_gripper_of_an_imported_arm_is_an_end_effector(tmp_path):
    robot = replace(arm(), name='arm & "hand"', home=(0.1 + 0.2, -1e-17, 0.01, 0.02))
    spheres = (LinkSpheres("upper", (((0.1, -0.2, 1 / 7), 0.05),)),)
    text = robot_srdf_text(robot, samples=10, spheres=spheres)
    assert text.startswith(TEXT)
    (tmp_path / "arm.srdf").write_text(text)
    assert read_srdf(tmp_path / "arm.srdf").get("name") == robot.name


def groups(robot):
    root = parse_srdf(robot_srdf_text(robot, samples=10).encode(), "x")
    return root, {group.get("name"): group for group in root.findall("group")}


def test_arm_without_end_effector_has_one_group():
    assert [*groups(balls())[1]] == ["arm"]


def test_parts_of_composed_robots_are_end_effectors():
    robot = composed("base=planar ee=cube")
    root, found = groups(robot)
    assert [*found] == ["arm", "ee"]
    assert all(link.get("name").startswith("ee_") for link in found["ee"])
    assert root.find("end_effector").get("parent_link") in robot.link_index


def test_robot_without_tool_is_refused():
    with pytest.raises(FormatError, match=r"'balls' has no frame 'tool'.*import FILE --tool LINK"):
        robot_srdf_text(replace(balls(), frames=()))

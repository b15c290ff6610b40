"""Reasons of the collision matrix against brute force, and the SRDF that is made of it."""

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from helpers.composed import composed
from helpers.robots import arm
from morphgen.checks.robot_srdf import collision_matrix, robot_srdf, robot_srdf_text
from morphgen.checks.self_collision import ALWAYS_SHARE, PENETRATION
from morphgen.errors import FormatError
from morphgen.formats.srdf import EndEffector, Group, GroupState, parse_srdf, with_disabled_pairs
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


def test_gripper_of_an_imported_arm_is_an_end_effector():
    robot = arm()
    srdf = robot_srdf(robot, collision_matrix(robot, samples=10))
    assert srdf.groups[0].chains[0].tip_link == "tool"
    assert srdf.groups[1] == Group("ee", ("left", "right"))
    assert srdf.end_effectors == (EndEffector("ee", "slider", "ee", "arm"),)
    assert srdf.group_states == (
        GroupState("home", "arm", (("shoulder", 0.4), ("elbow", 0.5), ("extend", 0.01))),
        GroupState("home", "ee", (("left", 0.02),)),
    )


def test_arm_without_end_effector_has_one_group():
    robot = balls()
    assert [g.name for g in robot_srdf(robot, collision_matrix(robot, samples=1)).groups] == ["arm"]


def test_parts_of_composed_robots_are_end_effectors():
    robot = composed("base=planar ee=cube")
    srdf = robot_srdf(robot, collision_matrix(robot, samples=10))
    assert [group.name for group in srdf.groups] == ["arm", "ee"]
    assert all(name.startswith("ee_") for name in srdf.groups[1].links)
    assert srdf.end_effectors[0].parent_link in robot.link_index


def test_robot_without_tool_is_refused():
    with pytest.raises(FormatError, match=r"'balls' has no frame 'tool'.*import FILE --tool LINK"):
        robot_srdf_text(replace(balls(), frames=()))

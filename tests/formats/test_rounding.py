"""Rounding makes a composed robot equal to the same robot read from its file."""

import math
from dataclasses import replace

import numpy as np
import pytest

from helpers.robots import arm
from morphgen.formats.bundle import read_bundle, write_bundle
from morphgen.formats.rounding import as_written, format_number, rounded_pose
from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape
from morphgen.model.robot import Frame, Inertial, Joint, Link, Robot
from morphgen.model.rotation import to_matrix

RNG = np.random.default_rng(0)
NEAR_GIMBAL = [
    (a, s * (math.pi / 2 - off), b)
    for a in (0.0, 1.1)
    for b in (-2.3, 0.4)
    for s in (1, -1)
    for off in (0.0, 1e-13, 1e-10, 1e-8, 3.7e-6, 1e-4, 1e-2)
]
HALF_TURNS = [(math.pi, 0.0, 0.3), (0.7, math.pi, 0.0), (math.pi, 0.2, math.pi)]
TINY = [(1e-5, 3e-9, -2e-11), (4e-12, 1.0, 7e-13)]
RANDOM = RNG.uniform(-math.pi, math.pi, (200, 3)).tolist()


def from_file(pose):
    """Return the pose after writing it to a URDF and reading it."""
    xyz, rpy = (
        [float(format_number(value)) for value in triple] for triple in (pose.position, pose.rpy)
    )
    return Pose.from_xyz_rpy(xyz, rpy)


@pytest.mark.parametrize("rpy", [*NEAR_GIMBAL, *HALF_TURNS, *TINY, *RANDOM])
def test_rounded_poses_round_trip_through_a_file(rpy):
    pose = Pose.from_xyz_rpy(tuple(RNG.normal(size=3)), rpy)
    rounded = rounded_pose(pose)
    assert rounded_pose(rounded) == rounded
    assert rounded_pose(from_file(rounded)) == rounded
    turned = np.array(to_matrix(rounded.quaternion)) - to_matrix(pose.quaternion)
    assert np.abs(turned).max() < 1e-9


def tilted(rng):
    return Pose.from_xyz_rpy(tuple(rng.normal(size=3)), tuple(rng.uniform(-3, 3, 3)))


def odd_robot(seed):
    """Return a tree with everything that a file changes: joint defaults, capsules, long numbers."""
    rng = np.random.default_rng(seed)
    limits = tuple(sorted(rng.normal(size=2)))
    can = Shape(Capsule(0.1 / 3, 0.7 / 3), tilted(rng))
    body = Inertial(1 / 3, tuple(rng.normal(size=3)), (1e-5 / 3, 1e-9 / 3, 0.0, 2e-5 / 3, 0, 2e-5))
    links = (
        Link("root"),
        Link("a", body, collisions=(can, Shape(Box((0.1 / 3, 0.1, 0.1)), tilted(rng)))),
        Link("b", Inertial(0.0), collisions=(Shape(Cylinder(1 / 7, 1 / 9), tilted(rng)),)),
        Link("c"),
    )
    axis = tuple(rng.normal(size=3))
    joints = (
        Joint("j0", "revolute", "root", "a", tilted(rng), axis, velocity=2 / 3),
        Joint("j1", "prismatic", "root", "b", tilted(rng), axis, limits, effort=10 / 3),
        Joint("j2", "fixed", "a", "c", tilted(rng), limits=(0.0, 1.0), damping=1.0),
    )
    tool = Frame("tool", "c", tilted(rng))
    return Robot("odd", links, joints, (tool,), home=(1 / 3, 2 / 3))


@pytest.mark.parametrize("robot", [arm(), *map(odd_robot, range(10))])
def test_rounded_robots_round_trip_through_a_file(tmp_path, robot):
    rounded = as_written(robot)
    there = as_written(read_bundle(write_bundle(robot, tmp_path / "r", picture=False)))
    assert as_written(rounded).joints == rounded.joints
    for name in ("joints", "frames", "home"):
        assert getattr(there, name) == getattr(rounded, name)
    for link, other in zip(rounded.links, there.links, strict=True):
        bare = replace(other, visuals=link.visuals)
        assert bare == replace(link, collisions=bare.collisions)
        shapes = [[replace(s, rgba=None) for s in each.collisions] for each in (link, other)]
        assert shapes[0] == shapes[1]

"""Configurations of cuRobo: read by PyYAML and checked against the keys that cuRobo documents."""

from dataclasses import replace

import pytest
import yaml

from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.fitting.collision_geometry import link_spheres
from morphgen.formats.curobo import curobo_text
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.robot import Frame

KINEMATICS = {
    "format_version": float,
    "urdf_path": str,
    "asset_root_path": str,
    "base_link": str,
    "tool_frames": list,
    "collision_link_names": list,
    "collision_spheres": dict,
    "collision_sphere_buffer": float,
    "self_collision_ignore": dict,
    "self_collision_buffer": dict,
    "mesh_link_names": list,
    "cspace": dict,
}
"""Fields of cuRobo's ``KinematicsLoaderCfg`` that are written, with their types."""
CSPACE = {
    "joint_names",
    "default_joint_position",
    "null_space_weight",
    "cspace_distance_weight",
}
"""Fields of its ``CSpaceParams`` that are written."""


def with_balls(robot):
    """Return the robot with two spheres on every link but the last, which has no shapes."""
    balls = (
        Shape(Sphere(0.05), Pose((1e-5, -0.02, 0.123456789))),
        Shape(Sphere(0.025), Pose((0.0, 0.0, 0.2))),
    )
    links = [replace(link, collisions=balls) for link in robot.links[:-1]]
    return robot.with_links([*links, replace(robot.links[-1], collisions=())])


def read(robot, ignored=()):
    text = curobo_text(robot, link_spheres(robot), ignored, "robot.urdf", "where it comes from")
    data = yaml.safe_load(text)
    assert text.startswith("# where it comes from\n")
    assert list(data) == ["robot_cfg"]
    assert list(data["robot_cfg"]) == ["kinematics"]
    return data["robot_cfg"]["kinematics"]


def test_all_keys_are_those_of_curobo_with_their_types():
    kinematics = read(with_balls(arm()))
    assert {name: type(value) for name, value in kinematics.items()} == KINEMATICS
    assert kinematics["format_version"] == 2.0
    assert set(kinematics["cspace"]) == CSPACE


def test_spheres_joints_and_pairs_are_those_of_the_robot():
    robot = with_balls(arm())
    ignored = [("base", "upper"), ("base", "lower"), ("left", "right")]
    kinematics = read(robot, ignored)
    names = ["base", "upper", "lower", "slider", "left"]
    assert kinematics["collision_link_names"] == names
    assert list(kinematics["self_collision_buffer"]) == names
    assert kinematics["collision_spheres"] == {
        name: [
            {"center": [1e-5, -0.02, 0.123456789], "radius": 0.05},
            {"center": [0.0, 0.0, 0.2], "radius": 0.025},
        ]
        for name in names
    }
    # A link without spheres needs no pair.
    assert kinematics["self_collision_ignore"] == {"base": ["lower", "upper"]}
    assert kinematics["base_link"] == "base"
    assert kinematics["tool_frames"] == ["tool"]
    cspace = kinematics["cspace"]
    assert cspace["joint_names"] == ["shoulder", "elbow", "extend", "left"]
    assert cspace["default_joint_position"] == [0.4, 0.5, 0.01, 0.02]
    assert {len(values) for values in cspace.values()} == {4}


def test_every_tool_of_several_limbs_is_a_tool_frame():
    frames = (Frame("left_tool", "left"), Frame("right_tool", "right"), Frame("tool", "right"))
    robot = with_balls(replace(arm(), frames=frames))
    assert read(robot)["tool_frames"] == ["left_tool", "right_tool"]


def test_robots_without_tool_or_spheres_are_refused():
    with pytest.raises(FormatError, match="no frame 'tool', where its arm ends"):
        read(with_balls(replace(arm(), frames=())))
    with pytest.raises(FormatError, match="no link with spheres"):
        read(arm())

"""SRDF and cuRobo: refusals, the pairs that an SRDF disables, and what cuRobo gets."""

import re
from dataclasses import replace

import pytest
import yaml

from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.fitting.replace_collision import link_spheres
from morphgen.formats.srdf import (
    curobo_text,
    disabled_link_pairs,
    parse_srdf,
    with_disabled_pairs,
)
from morphgen.model.geometry import Pose, Shape, Sphere
from morphgen.model.robot import Frame

FOREIGN = """
<virtual_joint name="fixed_base" type="fixed" parent_frame="world" child_link="base"/>
<group name="arm"><link name="upper"/><joint name="shoulder"/></group>
<group name="all"><group name="arm"/></group>
<group_state name="away" group="all"><joint name="floating" value="1 2 0.5 0 0 0 1"/></group_state>
<end_effector name="other" parent_link="slider" group="arm"/>
<passive_joint name="right"/>
<joint_property joint_name="floating" property_name="motion_model" value="diff_drive"/>
<disable_default_collisions link="c"/>
<enable_collisions link1="a" link2="c"/>
<disable_collisions link1="b" link2="a"/>
"""
"""Elements that morphgen does not write."""


def document(content):
    return f'<robot name="arm">\n{content}\n</robot>'.encode()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("<grup/>", "x:2: <grup> is unknown in <robot>; did you mean 'group'? valid:"),
        (
            '<enable_collisions link1="a" link2="b" raeson="c"/>',
            "x:2: <enable_collisions>: unknown attribute 'raeson'; did you mean 'reason'?",
        ),
        ('<disable_collisions link1="a"/>', "x:2: <disable_collisions>: missing attribute 'link2'"),
    ],
)
def test_invalid_content_is_refused(content, message):
    with pytest.raises(FormatError, match=re.escape(message)):
        parse_srdf(document(content), "x")


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"<sdf/>", "x: root element <sdf>; expected <robot>"),
        (b'<!DOCTYPE r [<!ENTITY e "a">]><robot name="r"/>', "x: has a DOCTYPE"),
    ],
)
def test_other_documents_are_refused(data, message):
    with pytest.raises(FormatError, match=re.escape(message)):
        parse_srdf(data, "x")


def test_disabled_pairs_become_ignored_ones():
    robot = replace(arm(), ignore_pairs=(("left", "right"),))
    pairs = '<disable_collisions link1="{}" link2="base" reason="Adjacent"/>'.format
    disabled = parse_srdf(document(pairs("upper") + pairs("tool")), "x")
    result = with_disabled_pairs(robot, disabled)
    assert result.ignore_pairs == (("base", "upper"), ("left", "right"))
    message = "a.srdf: robot 'arm' has no link 'uper'; did you mean 'upper'? valid: base, left,"
    with pytest.raises(FormatError, match=re.escape(message)):
        with_disabled_pairs(robot, parse_srdf(document(pairs("uper")), "x"), "a.srdf")


def test_unchecked_links_collide_only_in_enabled_pairs():
    root = parse_srdf(document(FOREIGN), "x")
    assert disabled_link_pairs(root, ("a", "b", "c", "d")) == (("a", "b"), ("b", "c"), ("c", "d"))


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

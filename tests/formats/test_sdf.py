"""SDFormat: poses, masses, limits and names against the robot, by a parser of its own."""

import re
import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from helpers.faulty_robots import valid_robot_with_mesh
from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.sdf import model_config_text, sdf_text
from morphgen.model.geometry import Capsule, Pose, Shape
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Frame, Joint, Link, Robot


def parse(robot):
    root = ET.fromstring(sdf_text(robot, lambda mesh: f"meshes/{mesh.path.name}"))
    return root, root.find("model")


def pose(element):
    """The (4, 4) matrix of an element's pose: fixed-axis roll, pitch and yaw."""
    values = [float(word) for word in element.findtext("pose", "0 0 0 0 0 0").split()]
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", values[3:]).as_matrix()
    matrix[:3, 3] = values[:3]
    return matrix


def numbers(element, path):
    return [float(word) for word in element.findtext(path).split()]


def test_poses_masses_and_shapes_are_the_robots():
    robot = arm()
    _, model = parse(robot)
    links = {link.get("name"): link for link in model.findall("link")}
    assert list(links) == [link.name for link in robot.links]
    T_root_link = forward_kinematics(robot, np.zeros(robot.dof))
    for link, T in zip(robot.links, T_root_link, strict=True):
        element = links[link.name]
        np.testing.assert_allclose(pose(element), T, atol=1e-11)
        inertial = element.find("inertial")
        assert float(inertial.findtext("mass")) == pytest.approx(link.inertial.mass, rel=1e-11)
        np.testing.assert_allclose(pose(inertial)[:3, 3], link.inertial.com, atol=1e-12)
        tags = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        inertia = [float(inertial.findtext(f"inertia/{tag}")) for tag in tags]
        np.testing.assert_allclose(inertia, link.inertial.inertia, rtol=1e-11, atol=1e-15)
        assert len(element.findall("visual")) == len(link.visuals)
        assert len(element.findall("collision")) == len(link.collisions)
    upper = links["upper"].find("visual")
    assert numbers(upper, "geometry/cylinder/radius") == [0.02]
    assert numbers(upper, "geometry/cylinder/length") == [0.34]
    assert numbers(upper, "material/diffuse") == [0.8, 0.4, 0.1, 1.0]
    assert numbers(links["base"].find("collision"), "geometry/box/size") == [0.1, 0.1, 0.04]


def test_joints_have_limits_mimics_and_free_names():
    robot = arm()
    root, model = parse(robot)
    assert root.get("version") == "1.11"  # the first with mimics
    joints = {joint.get("name"): joint for joint in model.findall("joint")}
    # A joint must not be named like a link.
    assert list(joints) == [
        "world_joint", "shoulder", "elbow", "extend", "left_joint", "right_joint"
    ]  # fmt: skip
    anchor = joints["world_joint"]
    assert [anchor.get("type"), anchor.findtext("parent"), anchor.findtext("child")] == [
        "fixed", "world", "base"
    ]  # fmt: skip
    shoulder = joints["shoulder"]
    assert (shoulder.findtext("parent"), shoulder.findtext("child")) == ("base", "upper")
    assert shoulder.find("pose") is None
    assert numbers(shoulder, "axis/xyz") == [0, 1, 0]
    limits = {e.tag: float(e.text) for e in shoulder.find("axis/limit")}
    assert limits == {"lower": -2.0, "upper": 2.0, "effort": 50.0, "velocity": 2.0}
    mimic = joints["right_joint"].find("axis/mimic")
    assert mimic.attrib == {"joint": "left_joint", "axis": "axis"}
    assert [float(e.text) for e in mimic] == [-1.0, 0.0, 0.0]
    (frame,) = model.findall("frame")
    assert frame.attrib == {"name": "tool", "attached_to": "slider"}
    np.testing.assert_allclose(pose(frame), robot.frames[0].T_link_frame.matrix, atol=1e-11)


def test_robot_without_mimics_is_of_version_1_10():
    capsule = Shape(Capsule(0.1, 0.4))
    joint = Joint("j", "revolute", "a", "b", Pose((0, 0, 1)), (0, 0, 2), damping=0.5, friction=0.1)
    robot = Robot("r", (Link("a"), Link("b", collisions=(capsule,))), (joint,), home=(0.0,))
    root, model = parse(robot)
    assert root.get("version") == "1.10"
    assert model.find("joint[@name='j']").get("type") == "continuous"
    assert len(model.find("joint[@name='j']/axis/limit")) == 0
    assert numbers(model, "joint[@name='j']/axis/xyz") == [0, 0, 1]
    assert numbers(model, "joint[@name='j']/axis/dynamics/damping") == [0.5]
    assert numbers(model, "link[@name='b']/collision/geometry/capsule/length") == [0.4]
    assert numbers(model, "link[@name='a']/inertial/mass") == [1e-12]  # SDFormat refuses zero
    config = ET.fromstring(model_config_text(robot))
    assert (config.findtext("name"), config.findtext("sdf")) == ("r", "model.sdf")
    assert config.find("sdf").get("version") == "1.10"


def test_meshes_are_files(tmp_path):
    _, model = parse(valid_robot_with_mesh(tmp_path))
    uris = [element.text for element in model.iter("uri")]
    assert uris
    assert all(uri.startswith("meshes/") for uri in uris)


def test_empty_root_named_world_is_the_world():
    joint = Joint("j", "fixed", "world", "a")
    robot = Robot("r", (Link("world"), Link("a")), (joint,), (Frame("f", "world"),))
    _, model = parse(robot)
    assert [link.get("name") for link in model.findall("link")] == ["a"]
    assert [j.findtext("parent") for j in model.findall("joint")] == ["world"]
    assert model.find("frame").attrib == {"name": "f"}


@pytest.mark.parametrize("name", ["world", "a::b", "__model__"])
def test_reserved_names_are_refused(name):
    robot = arm()
    links = (*robot.links[:5], replace(robot.links[5], name=name))
    joints = (*robot.joints[:4], replace(robot.joints[4], child=name))
    message = f"robot 'arm': the name {name!r} is reserved in SDFormat"
    with pytest.raises(FormatError, match=re.escape(message)):
        sdf_text(replace(robot, links=links, joints=joints), str)

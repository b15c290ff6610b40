"""SDF, SRDF, cuRobo, glTF and packages for ROS 2."""

import io
import json
import re
import struct
import xml.etree.ElementTree as ET
from dataclasses import replace
from shutil import which
from subprocess import run

import numpy as np
import pytest
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from helpers.faulty_robots import valid_robot_with_mesh
from helpers.robots import arm
from morphgen.checks.srdf import (
    collision_matrix,
    curobo_text,
    disabled_link_pairs,
    parse_srdf,
    with_disabled_pairs,
)
from morphgen.errors import FormatError
from morphgen.formats.exchange import (
    T_GLTF_ROOT,
    glb_bytes,
    model_config_text,
    ros_package_name,
    sdf_text,
    write_ros_package,
)
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf.read import read_urdf
from morphgen.model.geometry import Box, Capsule, Pose, Shape, Sphere
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Frame, Joint, Link, Robot
from morphgen.model.tree import rename


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
    expected = ["world_joint", "shoulder", "elbow", "extend", "left_joint", "right_joint"]
    assert list(joints) == expected
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
    message = f"robot 'arm': the name {name!r} is reserved in SDFormat"
    with pytest.raises(FormatError, match=re.escape(message)):
        sdf_text(rename(arm(), {"right": name}), str)


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


ENABLED = '<enable_collisions link1="a" link2="b" raeson="c"/>'
DISABLED = '<disable_collisions link1="a"/>'


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (document("<grup/>"), ":2: <grup> is unknown in <robot>; did you mean 'group'? valid:"),
        (document(ENABLED), ":2: <enable_collisions>: unknown attribute 'raeson'; did you mean"),
        (document(DISABLED), ":2: <disable_collisions>: missing attribute 'link2'"),
        (b"<sdf/>", ": root element <sdf>; expected <robot>"),
        (b'<!DOCTYPE r [<!ENTITY e "a">]><robot name="r"/>', ": has a DOCTYPE"),
    ],
)
def test_invalid_documents_are_refused(data, message):
    with pytest.raises(FormatError, match=re.escape(f"x{message}")):
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
    **dict.fromkeys(("format_version", "collision_sphere_buffer"), float),
    **dict.fromkeys(("urdf_path", "asset_root_path", "base_link"), str),
    **dict.fromkeys(("tool_frames", "collision_link_names", "mesh_link_names"), list),
    **dict.fromkeys(("collision_spheres", "self_collision_ignore"), dict),
    **dict.fromkeys(("self_collision_buffer", "cspace"), dict),
}
"""Fields of cuRobo's ``KinematicsLoaderCfg`` that are written, with their types."""
CSPACE = {"joint_names", "default_joint_position", "null_space_weight", "cspace_distance_weight"}
"""Fields of its ``CSpaceParams`` that are written."""


def with_balls(robot):
    """Return the robot with two spheres on every link but the last, which has no shapes."""
    balls = (
        Shape(Sphere(0.05), Pose((1e-5, -0.02, 0.123456789))),
        Shape(Sphere(0.025), Pose((0.0, 0.0, 0.2))),
    )
    links = [replace(link, collisions=balls) for link in robot.links[:-1]]
    return robot.with_links([*links, replace(robot.links[-1], collisions=())])


def curobo(robot):
    data = yaml.safe_load(curobo_text(robot, "robot.urdf", samples=10))
    assert {key: list(value) for key, value in data.items()} == {"robot_cfg": ["kinematics"]}
    return data["robot_cfg"]["kinematics"]


def test_all_keys_are_those_of_curobo_with_their_types():
    kinematics = curobo(with_balls(arm()))
    assert {name: type(value) for name, value in kinematics.items()} == KINEMATICS
    assert kinematics["format_version"] == 2.0
    assert set(kinematics["cspace"]) == CSPACE


def test_spheres_joints_and_pairs_of_curobo_are_those_of_the_robot():
    # The last link has no spheres and needs no pair.
    robot = replace(with_balls(arm()), ignore_pairs=(("base", "left"), ("left", "right")))
    kinematics = curobo(robot)
    names = ["base", "upper", "lower", "slider", "left"]
    assert kinematics["collision_link_names"] == names
    assert list(kinematics["self_collision_buffer"]) == names
    spheres = [
        {"center": [1e-5, -0.02, 0.123456789], "radius": 0.05},
        {"center": [0.0, 0.0, 0.2], "radius": 0.025},
    ]
    assert kinematics["collision_spheres"] == dict.fromkeys(names, spheres)
    pairs = {(a, b) for a, others in kinematics["self_collision_ignore"].items() for b in others}
    assert pairs == set(collision_matrix(robot, samples=10)) - {("left", "right")}
    assert pairs > {("base", "left"), ("base", "upper")}
    assert kinematics["base_link"] == "base"
    assert kinematics["tool_frames"] == ["tool"]
    cspace = kinematics["cspace"]
    assert cspace["joint_names"] == ["shoulder", "elbow", "extend", "left"]
    assert cspace["default_joint_position"] == [0.4, 0.5, 0.01, 0.02]
    assert {len(values) for values in cspace.values()} == {4}


def test_every_tool_of_several_limbs_is_a_tool_frame_of_curobo():
    frames = (Frame("left_tool", "left"), Frame("right_tool", "right"), Frame("tool", "right"))
    assert curobo(with_balls(replace(arm(), frames=frames)))["tool_frames"] == [
        "left_tool",
        "right_tool",
    ]


def test_robots_without_tool_or_with_other_shapes_than_spheres_are_no_robots_of_curobo():
    robot = with_balls(arm())
    with pytest.raises(FormatError, match="no frame 'tool', where its arm ends"):
        curobo(replace(robot, frames=()))
    mixed = (*robot.links[0].collisions, Shape(Box((0.1, 0.1, 0.1))))
    bare = [replace(link, collisions=()) for link in robot.links]
    for links in (bare, [replace(robot.links[0], collisions=mixed), *robot.links[1:]]):
        with pytest.raises(FormatError, match=r"fit ROBOT --spheres N --out DIR"):
            curobo(robot.with_links(links))


def loaded(robot):
    return trimesh.load(io.BytesIO(glb_bytes(robot)), file_type="glb")


def test_bounds_are_those_of_the_robot_at_home():
    robot, points = arm(), []
    for link, T in zip(robot.links, forward_kinematics(robot, robot.home), strict=True):
        for shape in link.visuals:
            T_scene_shape = T_GLTF_ROOT @ T @ shape.T_link_shape.matrix
            vertices = solid_mesh(shape.geometry).vertices
            points.extend(trimesh.transform_points(vertices, T_scene_shape))
    bounds = [np.min(points, axis=0), np.max(points, axis=0)]
    np.testing.assert_allclose(loaded(robot).bounds, bounds, atol=1e-6)


def test_links_and_frames_are_nodes_below_their_parents():
    robot = arm()
    data = glb_bytes(robot)
    assert data == glb_bytes(robot)
    (length,) = struct.unpack("<I", data[12:16])
    document = json.loads(data[20 : 20 + length])
    nodes = document["nodes"]
    children = {n["name"]: {nodes[i]["name"] for i in n.get("children", ())} for n in nodes}
    assert children["slider"] == {"left", "right", "tool", "slider_visual_0", "slider_visual_1"}
    assert children["upper"] == {"lower", "upper_visual_0"}
    scene = loaded(robot)
    T_root_link = forward_kinematics(robot, robot.home)
    for link, T in zip(robot.links, T_root_link, strict=True):
        np.testing.assert_allclose(scene.graph[link.name][0], T_GLTF_ROOT @ T, atol=1e-7)


def test_colours_are_kept():
    see_through = Shape(Box((0.1, 0.1, 0.1)), rgba=(0.2, 0.4, 0.6, 0.6))
    robot = arm()
    base = replace(robot.links[0], visuals=(see_through, Shape(Box((0.2, 0.1, 0.1)))))
    scene = loaded(replace(robot, links=(base, *robot.links[1:])))
    materials = {name: mesh.visual.material for name, mesh in scene.geometry.items()}
    assert materials["base_visual_0"].baseColorFactor.tolist() == [51, 102, 153, 153]
    assert materials["base_visual_0"].alphaMode == "BLEND"
    assert materials["base_visual_1"].baseColorFactor[3] == 255
    assert materials["upper_visual_0"].baseColorFactor.tolist() == [204, 102, 26, 255]


def test_frame_named_like_a_link_gets_a_free_name():
    robot = replace(arm(), frames=(Frame("upper", "slider"),))
    graph = loaded(robot).graph
    assert {"upper", "upper_2"} <= set(graph.nodes)


def test_robot_without_visuals_is_refused():
    robot = arm()
    bare = replace(robot, links=tuple(replace(link, visuals=()) for link in robot.links))
    with pytest.raises(FormatError, match="'arm' has no visual shape, so a GLB would be empty"):
        glb_bytes(bare)


def written(robot, tmp_path):
    folder = tmp_path / ros_package_name(robot.name)
    folder.mkdir()
    write_ros_package(robot, folder, "<robot name='r'/>")
    return folder


def test_package_names_are_those_of_ros():
    names = {
        "ur5-plane": "ur5_plane_description",
        "My Arm__2": "my_arm_2_description",
        "7dof": "robot_7dof_description",
        "-": "robot_description",
    }
    assert {robot: ros_package_name(robot) for robot in names} == names


def test_package_describes_itself(tmp_path):
    parts = [{"label": "arm", "licence": "BSD-3-Clause"}, {"label": "ee", "licence": "MIT\x00"}]
    folder = written(replace(arm(), provenance={"parts": parts}), tmp_path)
    package = ET.parse(folder / "package.xml").getroot()
    assert package.get("format") == "3"
    assert package.findtext("name") == folder.name == "arm_description"
    assert [e.text for e in package.findall("license")] == ["BSD-3-Clause", "MIT\\x00"]
    depends = {element.text for element in package.findall("exec_depend")}
    assert {"robot_state_publisher", "joint_state_publisher_gui", "rviz2"} <= depends
    assert package.findtext("export/build_type") == "ament_cmake"
    cmake = (folder / "CMakeLists.txt").read_text()
    assert "project(arm_description)" in cmake
    assert "install(DIRECTORY config launch urdf DESTINATION share/${PROJECT_NAME})" in cmake
    launch = (folder / "launch" / "display.launch.py").read_text()
    compile(launch, "display.launch.py", "exec")
    assert "get_package_share_directory('arm_description')" in launch
    assert "\"urdf\" / 'arm.urdf'" in launch
    rviz = yaml.safe_load((folder / "config" / "display.rviz").read_text())
    assert rviz["Visualization Manager"]["Global Options"]["Fixed Frame"] == "base"
    assert (folder / "config" / "arm.srdf").read_text() == "<robot name='r'/>"
    assert not (folder / "meshes").exists()


def test_meshes_are_found_by_their_package(tmp_path):
    robot = valid_robot_with_mesh(tmp_path)
    folder = written(robot, tmp_path)
    urdf = folder / "urdf" / f"{robot.name}.urdf"
    uris = {element.get("filename") for element in ET.parse(urdf).getroot().iter("mesh")}
    prefix = f"package://{folder.name}/"
    assert uris
    for uri in uris:
        assert uri.startswith(f"{prefix}meshes/")
        assert (folder / uri.removeprefix(prefix)).is_file()
    assert "DIRECTORY config launch meshes urdf" in (folder / "CMakeLists.txt").read_text()
    back = read_urdf(urdf, finder=default_finder(), written_frames=True)
    assert [link.name for link in back.links] == [link.name for link in robot.links]
    if which("check_urdf"):
        assert run(["check_urdf", urdf], capture_output=True, check=False).returncode == 0


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        (replace(arm(), name="../arm"), "name '../arm': use letters"),
        (rename(arm(), {"base": "a: b"}), "root link 'a: b' is no name of a ROS frame"),
    ],
)
def test_invalid_names_are_refused(robot, message, tmp_path):
    with pytest.raises(FormatError, match=message):
        write_ros_package(robot, tmp_path, "")

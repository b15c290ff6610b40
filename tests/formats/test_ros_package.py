"""ROS 2 packages: manifest, launch file, URDF with resolvable meshes, and SRDF."""

import xml.etree.ElementTree as ET
from dataclasses import replace
from shutil import which
from subprocess import run

import pytest
import yaml

from helpers.faulty_robots import valid_robot_with_mesh
from helpers.robots import arm
from morphgen.errors import FormatError
from morphgen.formats.resolve import default_finder
from morphgen.formats.ros_package import ros_package_name, write_ros_package
from morphgen.formats.urdf.read import read_urdf


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
    ("changes", "message"),
    [
        ({"name": "../arm"}, "name '../arm': use letters"),
        ({"links": "a: b"}, "root link 'a: b' is no name of a ROS frame"),
    ],
)
def test_invalid_names_are_refused(changes, message, tmp_path):
    robot = arm()
    if "links" in changes:
        root = replace(robot.links[0], name=changes["links"])
        first = replace(robot.joints[0], parent=changes["links"])
        changes = {"links": (root, *robot.links[1:]), "joints": (first, *robot.joints[1:])}
    with pytest.raises(FormatError, match=message):
        write_ros_package(replace(robot, **changes), tmp_path, "")

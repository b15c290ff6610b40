"""Write a robot as a ROS 2 description package."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path

from lxml import etree

from morphgen.errors import FormatError, one_line
from morphgen.formats.bundle import MESHES, bundle_folder, split_colours, write_meshes
from morphgen.formats.urdf.write import urdf_text
from morphgen.model.robot import Robot

_FOLDERS = ("config", "launch", "urdf")
_DEPENDENCIES = (
    "ament_index_python",
    "joint_state_publisher_gui",
    "launch",
    "launch_ros",
    "robot_state_publisher",
    "rviz2",
)
_UNKNOWN_LICENCE = "unknown"
_LAUNCH = '''"""Publish the robot's description and show it in RViz, with sliders for its joints."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """Return the nodes that publish and show the robot."""
    share = Path(get_package_share_directory({package!r}))
    description = (share / "urdf" / {urdf!r}).read_text(encoding="utf-8")
    return LaunchDescription(
        [
            Node(
                package="robot_state_publisher",
                executable="robot_state_publisher",
                parameters=[{{"robot_description": description}}],
            ),
            Node(package="joint_state_publisher_gui", executable="joint_state_publisher_gui"),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(share / "config" / "display.rviz")],
            ),
        ]
    )
'''
_RVIZ = """Visualization Manager:
  Class: ""
  Displays:
    - Class: rviz_default_plugins/Grid
      Name: Grid
      Value: true
    - Class: rviz_default_plugins/RobotModel
      Name: RobotModel
      Description Source: Topic
      Description Topic:
        Value: /robot_description
      Value: true
  Global Options:
    Fixed Frame: "{root}"
"""


def ros_package_name(robot_name: str) -> str:
    """Return the name of a robot's description package, such as ``ur5_plane_description``.

    ROS allows lower-case letters, digits and single underscores, with a letter first.
    """
    words = "_".join(re.findall(r"[a-z0-9]+", robot_name.lower()))
    return f"{words if words[:1].isalpha() else f'robot_{words}'.rstrip('_')}_description"


def write_ros_package(robot: Robot, folder: Path, srdf: str) -> None:
    """Write the files of a description package into an empty folder."""
    robot = split_colours(robot)
    package, stem = ros_package_name(robot.name), bundle_folder(folder, robot.name).name
    files = write_meshes(robot, folder / MESHES)
    root = robot.root.name
    if not re.fullmatch(r"[A-Za-z_][\w./-]*", root, re.ASCII):
        raise FormatError(
            f"robot {robot.name!r}: root link {root!r} is no name of a ROS frame; use letters, "
            "digits and '_', '-', '.', '/', with a letter or '_' first"
        )
    folders = (*_FOLDERS, MESHES) if files else _FOLDERS
    texts = {
        "package.xml": _package_xml(robot, package),
        "CMakeLists.txt": _cmake(package, folders),
        f"urdf/{stem}.urdf": urdf_text(robot, lambda mesh: f"package://{package}/{files[mesh]}"),
        f"config/{stem}.srdf": srdf,
        "config/display.rviz": _RVIZ.format(root=root),
        "launch/display.launch.py": _LAUNCH.format(package=package, urdf=f"{stem}.urdf"),
    }
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")


def _package_xml(robot: Robot, package: str) -> str:
    root = etree.Element("package", format="3")

    def add(tag: str, text: str, **attributes: str) -> None:
        etree.SubElement(root, tag, attributes).text = text

    add("name", package)
    add("version", "0.1.0")
    add("description", f"Description of the robot {robot.name}, written by morphgen.")
    add("maintainer", "unknown", email="unknown@example.com")
    for licence in _licences(robot):
        add("license", licence)
    add("buildtool_depend", "ament_cmake")
    for dependency in _DEPENDENCIES:
        add("exec_depend", dependency)
    export = etree.SubElement(root, "export")
    etree.SubElement(export, "build_type").text = "ament_cmake"
    etree.indent(root)
    return '<?xml version="1.0"?>\n' + etree.tostring(root, encoding="unicode") + "\n"


def _licences(robot: Robot) -> tuple[str, ...]:
    """Return the licences of the robot's parts in their order; unknown for other robots."""
    parts = robot.provenance.get("parts")
    rows = parts if isinstance(parts, list) else []
    names = [
        one_line(str(part["licence"]))
        for part in rows
        if isinstance(part, Mapping) and "licence" in part
    ]
    return tuple(dict.fromkeys(names)) or (_UNKNOWN_LICENCE,)


def _cmake(package: str, folders: Iterable[str]) -> str:
    return (
        "cmake_minimum_required(VERSION 3.8)\n"
        f"project({package})\n\n"
        "find_package(ament_cmake REQUIRED)\n\n"
        f"install(DIRECTORY {' '.join(sorted(folders))} DESTINATION share/${{PROJECT_NAME}})\n\n"
        "ament_package()\n"
    )

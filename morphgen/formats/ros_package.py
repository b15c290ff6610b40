"""Write a robot as a ROS 2 description package."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from string import Template
from xml.sax.saxutils import escape

from morphgen.errors import FormatError, one_line
from morphgen.formats.bundle import MESHES, bundle_folder, split_colours, write_meshes
from morphgen.formats.urdf.write import urdf_text
from morphgen.model.robot import Robot

_FOLDERS = {"display.launch.py": "launch", "display.rviz": "config"}
"""Folders of the files that are made of templates; the others are in the package's own."""
_UNKNOWN_LICENCE = "unknown"


def ros_package_name(robot_name: str) -> str:
    """Return the name of a description package that ROS allows: ``ur5_plane_description``."""
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
    folders = ["config", "launch", *([MESHES] if files else []), "urdf"]
    values = {
        "package": package,
        "stem": stem,
        "root": root,
        "robot": escape(robot.name),
        "folders": " ".join(folders),
        "licences": "\n".join(
            f"  <license>{escape(each)}</license>"
            for each in part_licences(robot.provenance) or (_UNKNOWN_LICENCE,)
        ),
    }
    texts = {
        f"urdf/{stem}.urdf": urdf_text(robot, lambda mesh: f"package://{package}/{files[mesh]}"),
        f"config/{stem}.srdf": srdf,
    }
    for path in Path(__file__).with_name("ros").glob("*.template"):
        text = Template(path.read_text(encoding="utf-8")).substitute(values)
        texts[f"{_FOLDERS.get(path.stem, '.')}/{path.stem}"] = text
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        path.write_text(text, encoding="utf-8")


def part_licences(card: Mapping[str, object]) -> tuple[str, ...]:
    """Return the licences of a robot's parts by its provenance or card; none without parts."""
    parts = card.get("parts")
    rows = parts if isinstance(parts, list) else []
    names = [
        one_line(str(part["licence"]))
        for part in rows
        if isinstance(part, Mapping) and "licence" in part
    ]
    return tuple(dict.fromkeys(names))

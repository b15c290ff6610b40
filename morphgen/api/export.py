"""Robots as files and folders of other tools, web pages and videos.

A format is one function, a row of ``FILES`` or ``FOLDERS``, and a few words in ``commands.txt``.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping
from functools import partial
from os import PathLike
from pathlib import Path
from tempfile import TemporaryDirectory

from morphgen.api.checks import bundle_of
from morphgen.checks.srdf import curobo_text, robot_srdf_text
from morphgen.errors import (
    FormatError,
    explain_missing_extras,
    nearest,
    path_argument,
    text_argument,
)
from morphgen.files import write_atomic
from morphgen.formats.bundle import (
    MESHES,
    MJCF,
    URDF,
    bundle_folder,
    split_colours,
    write_fits,
    write_meshes,
)
from morphgen.formats.exchange import (
    MODEL_CONFIG,
    MODEL_SDF,
    convert_urdf,
    glb_bytes,
    model_config_text,
    ros_package_name,
    sdf_text,
    write_ros_package,
)
from morphgen.formats.files import writing_export
from morphgen.formats.mjcf.write import mjcf_text
from morphgen.formats.urdf.write import MeshUri, urdf_text
from morphgen.grammar.library import LibraryFolders, default_library
from morphgen.grammar.robot_source import RobotLike, RobotReference, find_robot, read_source
from morphgen.model.robot import Robot


@explain_missing_extras()
def export(
    robot: RobotLike,
    format: str = "html",
    out: str | PathLike[str] | None = None,
    *,
    library: LibraryFolders = (),
) -> Path:
    """Write a robot for other tools, as a web page, or as a video in which it turns.

    Examples:
        >>> print(morphgen.export("ur5-plane", "glb"))
        ur5-plane.glb

    Args:
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        format: A file: ``html``, ``mp4``, ``gif``, ``glb`` or ``srdf``; or a folder: ``urdf``,
            ``mjcf``, ``sdf``, ``curobo``, ``usd`` or ``ros2``.
        out: Output folder; by default the robot's bundle for a file, its parent for a folder, and
            the current folder for other robots.
        library: Folders of your own parts.

    Returns:
        The file or folder. An existing folder is replaced only if all its files are of an export.

    Raises:
        FormatError: If the format is unknown.
        MissingDependencyError: If the extra that the format needs is not installed.
        MorphgenError: If the robot cannot be read or written.
    """
    out = None if out is None else path_argument("out", out, FormatError)
    if text_argument("format", format, FormatError) not in (valid := (*FILES, *FOLDERS)):
        raise FormatError(f"unknown format {format!r}{nearest(format, valid)}")
    parts, source = default_library(library), None
    if not isinstance(robot, Robot):
        source = find_robot(robot)
        robot = read_source(source, parts)
    return write_export(source, robot, format, out)


def write_export(
    source: RobotReference | None,
    robot: Robot,
    format: str,
    out: Path | None,
    taken: Collection[Path] = (),
) -> Path:
    """Write the file or folder of a robot, and return its path, which others may have taken."""
    path = _target(source, robot, format, out)
    if source is not None and path in taken:
        raise FormatError(f"{source.label}: {path} is of another robot of this command already")
    if format in FILES:
        content = FILES[format](robot)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, content)
    else:
        with writing_export(path, format, robot.name) as folder:
            FOLDERS[format](robot, folder)
    return path


def _target(source: RobotReference | None, robot: Robot, format: str, out: Path | None) -> Path:
    bundle = bundle_of(source) if out is None and source is not None else None
    if bundle is not None and format in FILES:
        return bundle / f"robot.{format}"
    beside = Path() if bundle is None else Path(os.path.normpath(bundle / ".."))
    path = bundle_folder(out or beside, robot.name)
    if format == "ros2":
        return path.with_name(ros_package_name(robot.name))
    if format in FOLDERS:
        return path.with_name(f"{robot.name}-{format}")
    return path.with_name(f"{path.name}.{format}")


def _html(robot: Robot) -> bytes:
    from morphgen.viewer.robot_files import robot_page  # of an extra, and seconds to import

    return robot_page(robot)


def _video(suffix: str, robot: Robot) -> bytes:
    from morphgen.viewer.robot_files import turntable  # of an extra, and seconds to import

    return turntable(robot, suffix)


def _with_meshes(texts: str, robot: Robot, folder: Path) -> None:
    """Write meshes and the texts of a format, which name them by relative paths."""
    robot = split_colours(robot)
    files = write_meshes(robot, folder / MESHES)
    for name, text in TEXTS[texts](robot, files.__getitem__).items():
        (folder / name).write_text(text, encoding="utf-8")
    if (folder / URDF).is_file():
        write_fits(robot, folder)


def _curobo(robot: Robot, folder: Path) -> None:
    (folder / "robot.yml").write_text(curobo_text(robot, URDF), encoding="utf-8")
    _with_meshes("urdf", robot, folder)


def _usd(robot: Robot, folder: Path) -> None:
    with TemporaryDirectory() as scratch:
        _with_meshes("urdf", robot, Path(scratch))
        convert_urdf(Path(scratch) / URDF, folder)


TEXTS: Mapping[str, Callable[[Robot, MeshUri], Mapping[str, str]]] = {
    "urdf": lambda robot, uri: {URDF: urdf_text(robot, uri)},
    "mjcf": lambda robot, uri: {MJCF: mjcf_text(robot, uri)},
    "sdf": lambda robot, uri: {
        MODEL_SDF: sdf_text(robot, uri),
        MODEL_CONFIG: model_config_text(robot),
    },
}
"""Functions that return a robot's texts by their names, by the format's name."""
FILES: Mapping[str, Callable[[Robot], bytes]] = {
    "html": _html,
    "mp4": partial(_video, ".mp4"),
    "gif": partial(_video, ".gif"),
    "glb": lambda robot: glb_bytes(split_colours(robot)),
    "srdf": lambda robot: robot_srdf_text(robot).encode(),
}
"""Functions that return the content of a robot's file, by the format's name, which is its suffix.
"""
FOLDERS: Mapping[str, Callable[[Robot, Path], None]] = {
    **{name: partial(_with_meshes, name) for name in TEXTS},
    "curobo": _curobo,
    "usd": _usd,
    "ros2": lambda robot, folder: write_ros_package(robot, folder, robot_srdf_text(robot)),
}
"""Functions that write a robot's files into an empty folder, by the format's name."""

"""Read robot descriptions of every format: URDF, xacro and MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from morphgen.errors import FormatError
from morphgen.formats.mjcf_read import read_mjcf
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.urdf import read_urdf, require_description_file
from morphgen.formats.xml import root_tag
from morphgen.model.robot import Robot

SUFFIXES = (".urdf", ".xacro", ".xml")
"""File name suffixes of robot descriptions."""
_MAX_HEAD = 2**20
"""Number of bytes within which the root element of an MJCF begins."""


def read_description(
    path: Path,
    args: Mapping[str, str] | None = None,
    finder: PackageFinder | None = None,
    *,
    root_link: str | None = None,
    written_frames: bool = False,
) -> Robot:
    """Read a xacro (by its suffix), an MJCF (by its root element ``<mujoco>``), or a URDF.

    Args:
        path: The file.
        args: Values of the xacro's arguments.
        finder: Finds ROS packages, and the folder that files may come from.
        root_link: Body of an MJCF to read, with all below it; see ``read_mjcf``. Without effect on
            other files.
        written_frames: Whether to turn links that ``urdf_text`` wrote for frames into frames.

    Raises:
        UnsoundError: If the tree of a URDF is broken or a mesh is not found.
        FormatError: If the file cannot be read, is of no such format, or does not expand.
    """
    require_description_file(path)
    if is_mjcf(path):
        if args:
            raise FormatError(
                f"{path}: xacro arguments {', '.join(args)} for a file that is not a xacro"
            )
        return read_mjcf(path, finder, root_body=root_link)
    return read_urdf(path, args, finder, written_frames=written_frames)


def is_mjcf(path: Path) -> bool:
    """Return whether a file is an MJCF: its root element is ``<mujoco>``.

    A file with the suffix ``.xacro`` is none; it is not opened.

    Raises:
        OSError: If the file cannot be read.
    """
    if path.suffix == ".xacro" or not path.is_file():
        return False
    with path.open("rb") as file:
        return root_tag(file.read(_MAX_HEAD)) == "mujoco"

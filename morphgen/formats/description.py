"""Read robot descriptions of every format: URDF, xacro and MJCF."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

from morphgen.formats import resolve
from morphgen.formats.data_files import kept_reading
from morphgen.formats.urdf.read import read_urdf, require_description_file, require_no_arguments
from morphgen.formats.xml import root_tag
from morphgen.model.findings import Finding
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Pose, Shape, Sphere
from morphgen.model.robot import Frame, Inertial, Joint, Link, Mimic, Robot

_ROBOT = (Robot, Link, Joint, Frame, Inertial, Mimic, Shape, Pose, Finding)
_GEOMETRIES = (Box, Capsule, Cylinder, Mesh, Sphere)
SUFFIXES = (".urdf", ".xacro", ".xml")  # file name suffixes of robot descriptions
_MAX_HEAD = 2**20  # number of bytes within which the root element of an MJCF begins


def read_description(
    path: Path,
    args: Mapping[str, str] | None = None,
    finder: resolve.PackageFinder | None = None,
    *,
    root_link: str | None = None,
    written_frames: bool = False,
) -> Robot:
    """Read a xacro (by its suffix), an MJCF (by its root element ``<mujoco>``), or a URDF."""
    require_description_file(path)
    if is_mjcf(path):
        from morphgen.formats.mjcf.read import read_mjcf  # takes a second to load

        require_no_arguments(path, args)
        return read_mjcf(path, finder, root_body=root_link)
    return read_urdf(path, args, finder, written_frames=written_frames)


def read_installed(package: str, file: str, args: Mapping[str, str]) -> Robot:
    """Read a description of an installed data package, kept in the user's cache."""
    path, finder = resolve.distribution_file(package, file), resolve.default_finder()
    read = partial(read_description, path, args, finder)
    if not (resolve.is_installed(path) and resolve.finds_installed_only(finder)):
        return read()
    key = (path, finder.roots, dict(args))
    robot = kept_reading("robot", key, read, (*_ROBOT, *_GEOMETRIES))
    return robot if all(mesh.path.is_file() for mesh in robot.meshes) else read()


def is_mjcf(path: Path) -> bool:
    """Return whether a file is an MJCF: its root element is ``<mujoco>``.

    A file with the suffix ``.xacro`` is none; it is not opened.
    """
    if path.suffix == ".xacro" or not path.is_file():
        return False
    with path.open("rb") as file:
        return root_tag(file.read(_MAX_HEAD)) == "mujoco"

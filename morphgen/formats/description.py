"""Read robot descriptions of every format: URDF, xacro and MJCF."""

from __future__ import annotations

import pkgutil
from collections.abc import Mapping
from functools import partial
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

from morphgen.errors import FormatError, nearest
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


DESCRIPTIONS = "robot_descriptions"  # module of the pip package, and prefix of its robots
_PATHS = ("MJCF_PATH", "URDF_PATH", "XACRO_PATH")
"""Names of the paths in a module of ``robot_descriptions``; the first one that exists is taken."""


def find_description(text: str) -> tuple[Path, dict[str, str]]:
    """Return the file that a path or ``robot_descriptions:NAME`` names, and its xacro arguments."""
    collection, colon, name = text.partition(":")
    if not colon or collection != DESCRIPTIONS:
        return Path(text), {}
    spec = find_spec(DESCRIPTIONS)
    if spec is None:
        raise FormatError(f"{text}: pip install {DESCRIPTIONS}, which has its robots")
    modules = pkgutil.iter_modules(spec.submodule_search_locations)
    names = [module.name for module in modules if module.name.endswith("_description")]
    if name not in names:
        raise FormatError(f"{text}: no such robot{nearest(name, names)}")
    try:
        module = import_module(f"{DESCRIPTIONS}.{name}")
    except Exception as error:  # whatever the package's download raises, such as GitCommandError
        raise FormatError(f"{text}: cannot be loaded: {error}") from error
    for key in _PATHS:
        if path := getattr(module, key, None):
            args = getattr(module, "XACRO_ARGS", {}) if key == "XACRO_PATH" else {}
            return Path(path), {name: str(args[name]) for name in args}
    raise FormatError(f"{text}: the module has none of {', '.join(_PATHS)}")

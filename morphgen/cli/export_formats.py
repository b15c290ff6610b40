"""The formats of ``morphgen export``, one row each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from morphgen.formats.urdf_text import MeshUri
    from morphgen.model.robot import Robot

SAMPLES, MAX_SAMPLES = 10_000, 1_000_000
"""Default and largest number of sampled configurations of an SRDF; the default is
``morphgen.checks.collision_matrix.MATRIX_SAMPLES``."""


@dataclass(frozen=True)
class ExportSettings:
    """Values of the options that only some formats have."""

    dark: bool = False
    """Whether a page is dark."""
    samples: int = SAMPLES
    """Number of configurations in which pairs of links are tested."""
    seed: int = 0
    """Seed of these configurations."""
    spheres: int | None = None
    """Number of spheres per link that replace its collision shapes; None to keep the shapes."""
    cover: float | None = None
    """Share of each link that its spheres must cover; None for the largest overlap."""
    folders: tuple[Path, ...] = ()
    """Folders of parts, for their stored fits."""


@dataclass(frozen=True)
class FileFormat:
    """A format whose robots are one file each, named after the robot with the format as suffix."""

    summary: str
    """Content of an exported file in a few words, for the help of the command."""
    content: Callable[[Robot, ExportSettings], bytes]
    """Function that returns the content of a robot's file."""
    options: tuple[str, ...] = ()
    """Fields of ``ExportSettings`` that have an effect."""


@dataclass(frozen=True)
class FolderFormat:
    """A format whose robots are one folder each."""

    summary: str
    """Content of an exported folder in a few words, for the help of the command."""
    write: Callable[[Robot, Path, ExportSettings], None]
    """Function that writes a robot's files into an empty folder."""
    folder_name: Callable[[str], str]
    """Function that returns the name of the folder for the name of a robot."""
    options: tuple[str, ...] = ()
    """Fields of ``ExportSettings`` that have an effect."""


def formats_with(option: str) -> str:
    """Return the formats in which an option has an effect, such as ``srdf, curobo or ros2``."""
    *names, last = (name for name, row in FORMATS.items() if option in row.options)
    return " or ".join([", ".join(names), last] if names else [last])


def _html(robot: Robot, settings: ExportSettings) -> bytes:
    from morphgen.viewer.web_page import robot_page

    return robot_page(robot, dark=settings.dark)


def _video(suffix: str) -> Callable[[Robot, ExportSettings], bytes]:
    def content(robot: Robot, settings: ExportSettings) -> bytes:
        from morphgen.viewer.turntable import turntable

        return turntable(robot, suffix)

    return content


def _glb(robot: Robot, settings: ExportSettings) -> bytes:
    from morphgen.formats.bundle import split_colours
    from morphgen.formats.glb import glb_bytes

    return glb_bytes(split_colours(robot))


def _with_spheres(robot: Robot, settings: ExportSettings) -> Robot:
    """Return the robot with spheres as its collision shapes, if the settings have a number."""
    if settings.spheres is None:
        return robot
    from morphgen.fitting.sphere_robot import as_spheres

    return as_spheres(robot, settings.folders, spheres=settings.spheres, cover=settings.cover)


def _srdf(robot: Robot, settings: ExportSettings) -> bytes:
    from morphgen.checks.robot_srdf import robot_srdf_text
    from morphgen.fitting.sphere_robot import link_spheres
    from morphgen.formats.srdf import require_tool

    require_tool(robot)
    # The pairs are those of the robot's own shapes, which planners may test, too.
    spheres = link_spheres(_with_spheres(robot, settings))
    text = robot_srdf_text(robot, samples=settings.samples, seed=settings.seed, spheres=spheres)
    return text.encode()


def _curobo(robot: Robot, folder: Path, settings: ExportSettings) -> None:
    from morphgen.checks.collision_matrix import collision_matrix
    from morphgen.checks.robot_srdf import matrix_evidence
    from morphgen.fitting.sphere_robot import SPHERES, link_spheres
    from morphgen.formats.bundle import URDF
    from morphgen.formats.curobo import CONFIG, curobo_text
    from morphgen.formats.srdf import require_tool

    require_tool(robot)
    if settings.spheres is None:
        settings = replace(settings, spheres=SPHERES)
    robot = _with_spheres(robot, settings)
    matrix = collision_matrix(robot, samples=settings.samples, seed=settings.seed)
    spheres = link_spheres(robot)
    text = curobo_text(robot, spheres, matrix.reasons, URDF, matrix_evidence(robot, matrix))
    _with_meshes(_urdf)(robot, folder, replace(settings, spheres=None))
    (folder / CONFIG).write_text(text, encoding="utf-8")


def _with_meshes(
    texts: Callable[[Robot, MeshUri], Mapping[str, str]],
) -> Callable[[Robot, Path, ExportSettings], None]:
    """Return a function that writes meshes and the texts that name them by relative paths."""

    def write(robot: Robot, folder: Path, settings: ExportSettings) -> None:
        from morphgen.formats.bundle import MESHES, URDF, split_colours, write_fits, write_meshes

        robot = split_colours(_with_spheres(robot, settings))
        files = write_meshes(robot, folder / MESHES)
        for name, text in texts(robot, files.__getitem__).items():
            (folder / name).write_text(text, encoding="utf-8")
        if (folder / URDF).is_file():
            write_fits(robot, folder)

    return write


def _urdf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    from morphgen.formats.bundle import URDF
    from morphgen.formats.urdf_text import urdf_text

    return {URDF: urdf_text(robot, mesh_uri)}


def _mjcf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    from morphgen.formats.bundle import MJCF
    from morphgen.formats.mjcf import mjcf_text

    return {MJCF: mjcf_text(robot, mesh_uri)}


def _sdf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    from morphgen.formats.sdf import MODEL_CONFIG, MODEL_SDF, model_config_text, sdf_text

    return {MODEL_SDF: sdf_text(robot, mesh_uri), MODEL_CONFIG: model_config_text(robot)}


def _usd(robot: Robot, folder: Path, settings: ExportSettings) -> None:
    from morphgen.formats.bundle import URDF
    from morphgen.formats.usd import convert_urdf

    with TemporaryDirectory() as scratch:
        _with_meshes(_urdf)(robot, Path(scratch), settings)
        convert_urdf(Path(scratch) / URDF, folder)


def _ros2(robot: Robot, folder: Path, settings: ExportSettings) -> None:
    from morphgen.checks.robot_srdf import robot_srdf_text
    from morphgen.fitting.sphere_robot import link_spheres
    from morphgen.formats.ros_package import write_ros_package
    from morphgen.formats.srdf import require_tool

    require_tool(robot)
    robot = _with_spheres(robot, settings)
    srdf = robot_srdf_text(
        robot, samples=settings.samples, seed=settings.seed, spheres=link_spheres(robot)
    )
    write_ros_package(robot, folder, srdf)


def _ros2_name(robot_name: str) -> str:
    from morphgen.formats.ros_package import ros_package_name

    return ros_package_name(robot_name)


_SPHERES = ("spheres", "cover")
FORMATS: dict[str, FileFormat | FolderFormat] = {
    "html": FileFormat(
        "a page with the robot in 3D that needs no server and no network", _html, ("dark",)
    ),
    "mp4": FileFormat("a video of a turn", _video(".mp4")),
    "gif": FileFormat("a video of a turn", _video(".gif")),
    "glb": FileFormat("the visual shapes at home, a node per link", _glb),
    "srdf": FileFormat(
        "groups, home and disabled pairs for MoveIt, with reasons",
        _srdf,
        ("samples", "seed", *_SPHERES),
    ),
    "urdf": FolderFormat("URDF and meshes", _with_meshes(_urdf), "{}-urdf".format, _SPHERES),
    "mjcf": FolderFormat("MJCF and meshes", _with_meshes(_mjcf), "{}-mjcf".format, _SPHERES),
    "sdf": FolderFormat(
        "a model of Gazebo: SDFormat and meshes", _with_meshes(_sdf), "{}-sdf".format, _SPHERES
    ),
    "curobo": FolderFormat(
        "a robot of cuRobo: spheres, pairs to ignore and joints as YAML, and the URDF",
        _curobo,
        "{}-curobo".format,
        ("samples", "seed", *_SPHERES),
    ),
    "usd": FolderFormat(
        "OpenUSD with physics, by urdf-usd-converter", _usd, "{}-usd".format, _SPHERES
    ),
    "ros2": FolderFormat(
        "a ROS 2 package NAME_description with URDF, meshes, SRDF and launch file",
        _ros2,
        _ros2_name,
        ("samples", "seed", *_SPHERES),
    ),
}
"""The formats by name; a new format is one row."""

"""``morphgen export``: robots as files and folders of other tools, web pages and videos."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, number, option
from morphgen.errors import FormatError

if TYPE_CHECKING:
    from morphgen.formats.urdf.write import MeshUri
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.robot import Robot


SAMPLES, MAX_SAMPLES = 10_000, 1_000_000
"""Default and largest number of sampled configurations of an SRDF; the default is
``morphgen.checks.robot_srdf.MATRIX_SAMPLES``."""


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
    from morphgen.viewer.app.web_page import robot_page

    return robot_page(robot, dark=settings.dark)


def _video(suffix: str) -> Callable[[Robot, ExportSettings], bytes]:
    def content(robot: Robot, settings: ExportSettings) -> bytes:
        from morphgen.viewer.scene.robot import turntable

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
    from morphgen.fitting.replace_collision import as_spheres

    return as_spheres(robot, settings.folders, spheres=settings.spheres, cover=settings.cover)


def _srdf(robot: Robot, settings: ExportSettings) -> bytes:
    from morphgen.checks.robot_srdf import robot_srdf_text
    from morphgen.fitting.replace_collision import link_spheres
    from morphgen.formats.srdf import require_tool

    require_tool(robot)
    # The pairs are those of the robot's own shapes, which planners may test, too.
    spheres = link_spheres(_with_spheres(robot, settings))
    text = robot_srdf_text(robot, samples=settings.samples, seed=settings.seed, spheres=spheres)
    return text.encode()


def _curobo(robot: Robot, folder: Path, settings: ExportSettings) -> None:
    from morphgen.checks.robot_srdf import collision_matrix, matrix_evidence
    from morphgen.fitting.replace_collision import SPHERES, link_spheres
    from morphgen.formats.bundle import URDF
    from morphgen.formats.srdf import CUROBO_CONFIG, curobo_text, require_tool

    require_tool(robot)
    if settings.spheres is None:
        settings = replace(settings, spheres=SPHERES)
    robot = _with_spheres(robot, settings)
    matrix = collision_matrix(robot, samples=settings.samples, seed=settings.seed)
    spheres = link_spheres(robot)
    text = curobo_text(robot, spheres, matrix.reasons, URDF, matrix_evidence(robot, matrix))
    _with_meshes(_urdf)(robot, folder, replace(settings, spheres=None))
    (folder / CUROBO_CONFIG).write_text(text, encoding="utf-8")


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
    from morphgen.formats.urdf.write import urdf_text

    return {URDF: urdf_text(robot, mesh_uri)}


def _mjcf(robot: Robot, mesh_uri: MeshUri) -> Mapping[str, str]:
    from morphgen.formats.bundle import MJCF
    from morphgen.formats.mjcf.write import mjcf_text

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
    from morphgen.fitting.replace_collision import link_spheres
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


_DEFAULT = "html"


@command(
    "export",
    "write robots for other tools, as web pages, or as videos in which they turn",
    opt.ROBOTS,
    option(
        "--format",
        "; ".join(f"{name}: {row.summary}" for name, row in FORMATS.items())
        + f" (default: {_DEFAULT})",
        choices=tuple(FORMATS),
        default=_DEFAULT,
    ),
    option(
        "--out DIR", "output folder (default: for files the robot's bundle, else this folder)", Path
    ),
    flag("--dark", f"a dark page ({formats_with('dark')} only)"),
    number(
        "--samples",
        "number of configurations in which pairs of links are tested "
        f"({formats_with('samples')} only; default: {SAMPLES:,})",
        most=MAX_SAMPLES,
    ),
    number(
        "--seed", f"seed of these configurations ({formats_with('seed')} only; default: 0)", least=0
    ),
    number(
        "--spheres",
        "replace the collision shapes of each link by N spheres; in an SRDF, add them "
        f"({formats_with('spheres')} only; default: keep the shapes, for curobo 8)",
    ),
    option(
        "--cover SHARE",
        "with --spheres: share of each link's volume that they must cover, such as 0.995",
        float,
    ).needing("--spheres"),
    opt.ROOT,
    *opt.LIBRARY_JSON,
    details="In a bundle a file is robot.html, robot.glb and so on, elsewhere it has the name of "
    "the robot. Folders are NAME-urdf and so on. An existing folder is replaced only if all its "
    "files are those of an earlier export. A robot that cannot be read or written does not stop "
    "the others; the exit code is then 2.",
    examples=(
        "export robots/ur5-plane --format html",
        "export arm=ur5 ee=plane --format gif --out figures",
        "export arm=ur5 ee=plane --format ros2 --out src",
        "export arm=ur5 ee=plane --format curobo --spheres 16 --cover 0.995",
    ),
)
def export(args: argparse.Namespace) -> int:
    """Write a file or a folder for each robot."""
    from morphgen.grammar.robot_source import read_source

    settings = _settings(args)
    if args.out is not None and not args.out.is_dir():
        problem = "is no folder" if args.out.exists() else "no such folder; create it first"
        raise FormatError(f"--out {args.out}: {problem}")
    paths: list[Path] = []

    def write(source: RobotSource, library: Library) -> None:
        robot = read_source(source, library, args.root)
        path = _target(source, robot, args)
        if path in paths:
            raise FormatError(f"{source.label}: {path} is of another robot of this command already")
        _write(robot, path, args.format, settings)
        paths.append(path)

    _, refused = opt.for_each_robot(args, "exporting", write)
    refusals = [{"robot": label, **error} for label, error in refused.items()]
    data = [*map(str, paths), *refusals]
    opt.print_result(args, data, lambda: "\n".join(map(str, paths)))
    return 2 if refused else 0


def _settings(args: argparse.Namespace) -> ExportSettings:
    """Return the values of the options that only some formats have."""
    names = [each.name for each in fields(ExportSettings) if each.name != "folders"]
    values = opt.given(args, names)
    for name in values:
        if name not in FORMATS[args.format].options:
            raise FormatError(
                f"--{name} has no effect on --format {args.format}; expected --format "
                + formats_with(name)
            )
    return ExportSettings(**values, folders=tuple(opt.library_of(args).folders))


def _target(source: RobotSource, robot: Robot, args: argparse.Namespace) -> Path:
    """Return the path of a robot's file or folder."""
    from morphgen.formats.bundle import CARD, bundle_folder

    row = FORMATS[args.format]
    path = bundle_folder(args.out or Path(), robot.name)
    if isinstance(row, FolderFormat):
        return path.with_name(row.folder_name(robot.name))
    if args.out is None and source.path is not None and (source.path / CARD).is_file():
        return source.path / f"robot.{args.format}"
    return path.with_name(f"{path.name}.{args.format}")


def _write(robot: Robot, path: Path, format_name: str, settings: ExportSettings) -> None:
    """Write a robot's file or folder atomically."""
    from morphgen.formats.files import write_atomic, writing_export

    row = FORMATS[format_name]
    if isinstance(row, FolderFormat):
        with writing_export(path, format_name, robot.name) as partial:
            row.write(robot, partial, settings)
    else:
        write_atomic(path, row.content(robot, settings))

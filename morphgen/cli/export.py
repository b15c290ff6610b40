"""``morphgen export``: robots as files and folders of other tools, web pages and videos."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option, path_option, whole_number
from morphgen.cli.export_formats import (
    FORMATS,
    MAX_SAMPLES,
    SAMPLES,
    ExportSettings,
    FolderFormat,
    formats_with,
)
from morphgen.errors import FormatError

if TYPE_CHECKING:
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.robot import Robot

_DEFAULT = "html"


@command(
    "export",
    "write robots for other tools, as web pages, or as videos in which they turn",
    opt.ROBOTS,
    option(
        "--format",
        choices=tuple(FORMATS),
        default=_DEFAULT,
        help="; ".join(f"{name}: {row.summary}" for name, row in FORMATS.items())
        + f" (default: {_DEFAULT})",
    ),
    path_option(
        "--out",
        "DIR",
        "output folder (default: for files the robot's bundle, else this folder)",
    ),
    flag("--dark", f"a dark page ({formats_with('dark')} only)"),
    option(
        "--samples",
        type=whole_number(1, MAX_SAMPLES),
        metavar="N",
        help="number of configurations in which pairs of links are tested "
        f"({formats_with('samples')} only; default: {SAMPLES:,})",
    ),
    option(
        "--seed",
        type=whole_number(0),
        metavar="N",
        help=f"seed of these configurations ({formats_with('seed')} only; default: 0)",
    ),
    option(
        "--spheres",
        type=whole_number(1),
        metavar="N",
        help="replace the collision shapes of each link by N spheres; in an SRDF, add them "
        f"({formats_with('spheres')} only; default: keep the shapes, for curobo 8)",
    ),
    option(
        "--cover",
        type=float,
        metavar="SHARE",
        help="with --spheres: share of each link's volume that they must cover, such as 0.995",
    ),
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
    """Return the values of the options that only some formats have.

    Raises:
        FormatError: If one is given that the format does not have.
    """
    given = {
        "samples": args.samples,
        "seed": args.seed,
        "dark": args.dark or None,
        "spheres": args.spheres,
        "cover": args.cover,
    }
    values = {name: value for name, value in given.items() if value is not None}
    for name in values:
        if name not in FORMATS[args.format].options:
            raise FormatError(
                f"--{name} has no effect on --format {args.format}; expected --format "
                + formats_with(name)
            )
    if args.spheres is None:
        opt.reject_idle({"--cover": args.cover is not None}, "only with --spheres")
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
    from morphgen.formats.export_folder import writing_export
    from morphgen.formats.files import write_atomic

    row = FORMATS[format_name]
    if isinstance(row, FolderFormat):
        with writing_export(path, format_name, robot.name) as partial:
            row.write(robot, partial, settings)
    else:
        write_atomic(path, row.content(robot, settings))

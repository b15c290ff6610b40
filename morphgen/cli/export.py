"""``morphgen export``: web pages and turntable videos of robots."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option, path_option
from morphgen.cli.progress import track
from morphgen.errors import FormatError

if TYPE_CHECKING:
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.robot import Robot

FORMATS = ("html", "mp4", "gif")


@command(
    "export",
    "write robots as web pages or as videos in which they turn",
    opt.ROBOTS,
    option(
        "--format",
        choices=FORMATS,
        default="html",
        help="html: a page with the robot in 3D that needs no server and no network; mp4, gif: a "
        "video of a turn (default: html)",
    ),
    path_option(
        "--out",
        "DIR",
        "output folder (default: the robot's bundle, or this folder for robots without a bundle)",
    ),
    flag("--dark", "a dark page (html only)"),
    opt.ROOT,
    *opt.LIBRARY_JSON,
    details="In a bundle the file is robot.html, robot.mp4 or robot.gif, elsewhere it has the name "
    "of the robot.",
    examples=(
        "export robots/ur5-plane --format html",
        "export arm=ur5 ee=plane --format gif --out figures",
    ),
)
def export(args: argparse.Namespace) -> None:
    """Write a file for each robot."""
    from morphgen.formats.files import write_atomic
    from morphgen.grammar.robot_source import read_source

    if args.dark and args.format != "html":
        raise FormatError(f"--dark: a {args.format} has no dark page; expected --format html")
    sources, library = opt.sources_of(args), opt.library_of(args)
    if args.out is not None and not args.out.is_dir():
        raise FormatError(f"--out {args.out}: no such folder; create it first")
    make, paths = _exporter(args.format, dark=args.dark), []
    for source in track(sources, args, "exporting", "robot", len(sources)):
        robot = read_source(source, library, args.root)
        paths.append(_target(source, robot, args))
        write_atomic(paths[-1], make(robot))
    opt.print_result(args, [str(path) for path in paths], lambda: "\n".join(map(str, paths)))


def _exporter(name: str, *, dark: bool) -> Callable[[Robot], bytes]:
    """Return the function that makes the content of a file."""
    if name == "html":
        from morphgen.viewer.web_page import robot_page

        return lambda robot: robot_page(robot, dark=dark)
    from morphgen.viewer.turntable import turntable

    return lambda robot: turntable(robot, f".{name}")


def _target(source: RobotSource, robot: Robot, args: argparse.Namespace) -> Path:
    """Return the path of a robot's file."""
    from morphgen.formats.bundle import CARD, bundle_folder

    if args.out is None and source.path is not None and (source.path / CARD).is_file():
        return source.path / f"robot.{args.format}"
    name = bundle_folder(args.out or Path(), robot.name)
    return name.with_name(f"{name.name}.{args.format}")

"""``morphgen import``: any URDF or xacro to a bundle."""

from __future__ import annotations

import argparse
from pathlib import Path

from morphgen.cli.options import Subparsers, add_json, add_out, add_root


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "import",
        help="turn any URDF or xacro into a bundle",
        description="Turn any URDF or xacro into a bundle, with meshes baked to metres and z up. "
        "Exit code 1 if an error is left that no safe repair removes (see morphgen check); the "
        "bundle is written all the same.",
    )
    parser.add_argument("file", type=Path, help="a URDF, or a xacro by its suffix")
    parser.add_argument(
        "--root-link",
        metavar="LINK",
        help="link where the robot begins (default: the file's root)",
    )
    parser.add_argument("--tool", help="link whose frame is the tool")
    parser.add_argument(
        "--arg",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="a xacro argument; may be repeated",
    )
    parser.add_argument(
        "--as-is",
        action="store_true",
        help="do not make the safe repairs (see morphgen check), without which some loaders "
        "refuse the robot",
    )
    add_root(parser)
    add_out(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Import, check, write and say where."""
    from morphgen.cli.written import write_and_report
    from morphgen.errors import FormatError
    from morphgen.formats.bundle import bundle_folder
    from morphgen.grammar.robot_source import import_robot

    if args.name is not None:
        bundle_folder(args.out, args.name)
    pairs = [entry.partition("=") for entry in args.arg]
    for name, equals, value in pairs:
        if not name or not equals:
            raise FormatError(f"--arg {name}{equals}{value}: expected NAME=VALUE")
    arguments = {name: value for name, _, value in pairs}
    if args.root is not None and not args.root.is_dir():
        raise FormatError(
            f"--root {args.root}: there is no such folder; the link where the robot begins is "
            "named by --root-link"
        )
    robot = import_robot(
        args.file,
        arguments,
        root=args.root,
        root_link=args.root_link,
        tool=args.tool,
        name=args.name,
        repair=not args.as_is,
    )
    return write_and_report(robot, args)

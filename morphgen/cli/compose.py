"""``morphgen compose``: parts to a robot."""

from __future__ import annotations

import argparse

from morphgen.cli.options import Subparsers, add_json, add_library, add_out, library_of


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "compose",
        help="join a base, arms and end-effectors into a robot",
        description="Join a base, arms and end-effectors into a robot and write its bundle. A "
        "grammar named first (see: morphgen grammar list) is followed instead: its first "
        "alternatives and typical values, but for what is pinned.",
        epilog="example: morphgen compose arm=ur5 ee=plane ee.size=80mm --out robots/",
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="[GRAMMAR] KEY=VALUE",
        help="arm=ur5, ee=plane, ee.size=0.1, left.arm=panda, ee.mount_yaw=45deg ...",
    )
    parser.add_argument(
        "--geometry",
        choices=["mesh", "primitive"],
        default="mesh",
        help="collision shapes of real parts: meshes, or fitted boxes, cylinders and spheres",
    )
    add_out(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Compose, check, write and say where."""
    from morphgen.cli.written import write_and_report
    from morphgen.grammar.compose import compose
    from morphgen.grammar.request import parse_words

    library = library_of(args)
    derivation, name = parse_words(args.words, library)
    robot = compose(derivation, library, name if args.name is None else args.name)
    if args.geometry == "primitive":
        from morphgen.fitting.replace_collision import as_primitives

        robot = as_primitives(robot, library.folders)
    return write_and_report(robot, args)

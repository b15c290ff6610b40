"""``morphgen tokens``: a robot as 48 numbers a link."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import (
    ROBOTS_HELP,
    Subparsers,
    add_json,
    add_library,
    add_max_links,
    add_root,
    library_of,
    max_links_for,
    sources_named,
)

if TYPE_CHECKING:
    from morphgen.model.geometry import Shape
    from morphgen.model.robot import Robot
    from morphgen.typing import Array

HEADERS = (
    "#",
    "link",
    "parent",
    "tool",
    "geometry (m)",
    "joint",
    "axis",
    "origin xyz (m)",
    "origin rpy (deg)",
    "q scaled",
)


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "tokens",
        help="print or write a robot's tokens, 48 numbers a link",
        description="Print what a robot's tokens say, link by link, at its home; with --out, write "
        "them. A link's token holds the one primitive that overlaps it most.",
        epilog="examples: morphgen tokens robots/ur5-plane --out ur5-plane.npz; "
        "morphgen tokens arm=ur5 ee=plane; morphgen tokens --layout",
    )
    parser.add_argument(
        "words",
        nargs="*",
        metavar="ROBOT",
        help=ROBOTS_HELP,
    )
    parser.add_argument("--layout", action="store_true", help="print the fields of a token")
    parser.add_argument(
        "--out", metavar="FILE.npz", type=Path, help="write the tokens to this file"
    )
    add_max_links(parser, "23, or as many as the largest robot has")
    add_root(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Print, write."""
    from morphgen.benchmark.tokens import tokens
    from morphgen.errors import BenchmarkError
    from morphgen.fitting.token_shapes import token_shapes
    from morphgen.grammar.robot_source import read_source

    if not args.words:
        return _run_layout(args)
    if args.out and args.out.suffix != ".npz":
        raise BenchmarkError(f"--out {args.out}: expected a name that ends in .npz")
    library = library_of(args)
    robots = [read_source(source, library, args.root) for source in sources_named(args)]
    if args.out and len(robots) > 1:
        raise BenchmarkError(f"--out {args.out}: {len(robots)} robots are named; expected one")
    max_links = max_links_for(args, robots)
    data = []
    for robot in robots:
        made = tokens(robot, token_shapes(robot, library.folders), max_links=max_links)
        data.append(_data(made, robot, max_links))
        if args.out:
            _write(args.out, made, robot, max_links)
            data[-1]["file"] = str(args.out)
        if not args.json:
            print(_text(made, robot, max_links))
    if args.json:
        print(json.dumps(data[0] if len(data) == 1 else data))
        return 0
    if args.layout:
        print(f"\n{_layout_text()}")
    if args.out:
        print(args.out)
    return 0


def _run_layout(args: argparse.Namespace) -> int:
    """Print the layout alone."""
    from morphgen.errors import BenchmarkError

    if not args.layout or args.out or args.max_links is not None:
        raise BenchmarkError("name a robot, such as arm=ur5 ee=plane, or say --layout alone")
    print(json.dumps(_layout_data()) if args.json else _layout_text())
    return 0


def _write(path: Path, tokens: Array, robot: Robot, max_links: int) -> None:
    from morphgen.benchmark.tokens import tokens_npz
    from morphgen.formats.files import write_file

    write_file(path, tokens_npz(tokens, [link.name for link in robot.links], robot.name, max_links))


def _text(tokens: Array, robot: Robot, max_links: int) -> str:
    """A row a link, read back from the tokens."""
    from tabulate import tabulate

    from morphgen.benchmark.tokens import robot_from_tokens

    read, shapes = robot_from_tokens(tokens, robot.name, max_links=max_links)
    home = dict(zip(read.independent_joints, read.home, strict=True))
    tools = {frame.link for frame in read.frames}
    rows = []
    for i, link in enumerate(read.links):
        joint = read.joints[i - 1] if i else None
        pose = joint.T_parent_joint if joint else None
        rows.append(
            (
                i,
                robot.links[i].name,
                read.parents[i] if joint else "",
                "tool" if link.name in tools else "",
                _geometry_text(shapes.get(link.name)),
                joint.kind if joint else "",
                _numbers(joint.axis) if joint and joint.is_movable else "",
                _numbers(pose.position, 4) if pose else "",
                _numbers([math.degrees(angle) for angle in pose.rpy], 4) if pose else "",
                f"{home[i - 1] + 0.0:.3f}" if i - 1 in home else "",
            )
        )
    table = tabulate(rows, HEADERS, disable_numparse=True)
    return f"{table}\n{robot.name}: {tokens.shape}, indices over {max_links - 1}"


def _geometry_text(shape: Shape | None) -> str:
    from morphgen.model.geometry import Box, Cylinder, Sphere

    match shape.geometry if shape else None:
        case Box(edges):
            return f"box {' x '.join(f'{edge:.3g}' for edge in edges)}"
        case Cylinder(radius, length):
            return f"cylinder r {radius:.3g}, length {length:.3g}"
        case Sphere(radius):
            return f"sphere r {radius:.3g}"
        case _:
            return ""


def _numbers(values: Sequence[float], digits: int = 3) -> str:
    """Numbers as text, without -0."""
    return " ".join(f"{round(value, digits) + 0.0:g}" for value in values)


def _layout_text() -> str:
    from tabulate import tabulate

    from morphgen.benchmark.tokens import LAYOUT

    rows = [
        (field.name, f"{field.start}:{field.columns.stop}", field.size, field.content)
        for field in LAYOUT
    ]
    return tabulate(rows, ("field", "columns", "size", "content"), disable_numparse=True)


def _layout_data() -> list[dict[str, object]]:
    from dataclasses import asdict

    from morphgen.benchmark.tokens import LAYOUT

    return [asdict(field) for field in LAYOUT]


def _data(tokens: Array, robot: Robot, max_links: int) -> dict[str, object]:
    return {
        "name": robot.name,
        "links": [link.name for link in robot.links],
        "max_links": max_links,
        "shape": list(tokens.shape),
        "layout": _layout_data(),
        "tokens": tokens.tolist(),
    }

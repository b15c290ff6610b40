"""``morphgen tokens``: a robot as 48 numbers per link."""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option, path_option
from morphgen.cli.progress import track
from morphgen.errors import BenchmarkError

if TYPE_CHECKING:
    from morphgen.model.geometry import Shape
    from morphgen.model.robot import Robot
    from morphgen.typing import Array

HEADERS = (
    *("#", "link", "parent", "tool", "geometry (m)", "joint", "axis"),
    *("origin xyz (m)", "origin rpy (deg)", "q scaled"),
)


@command(
    "tokens",
    "print or write the tokens of robots, 48 numbers per link",
    option("words", nargs="*", metavar="ROBOT", help=opt.ROBOTS_HELP),
    flag("--layout", "print the fields of a token"),
    path_option("--out", "FILE.npz", "write the tokens to this file"),
    opt.MAX_LINKS,
    *opt.ROOT_LIBRARY_JSON,
    details="The table shows the tokens decoded, at the home configuration. The token of a link "
    "holds the one primitive that overlaps the link most.",
    examples=(
        "tokens robots/ur5-plane --out ur5-plane.npz",
        "tokens arm=ur5 ee=plane",
        "tokens --layout",
    ),
)
def tokens(args: argparse.Namespace) -> None:
    """Print the tokens of the robots, or write those of one."""
    from morphgen.benchmark.tokens import tokens, tokens_npz
    from morphgen.fitting.token_shapes import token_shapes
    from morphgen.formats.files import require_writable_file, write_file

    if not args.words:
        if not args.layout or args.out or args.max_links is not None:
            raise BenchmarkError("name a robot, such as arm=ur5 ee=plane, or say --layout alone")
        opt.print_result(args, _layout_data(), _layout_text)
        return
    if args.out:
        require_writable_file(args.out, "--out", ".npz")
    robots, folders = [robot for _, robot in opt.read_robots(args)], opt.library_of(args).folders
    if args.out and len(robots) > 1:
        raise BenchmarkError(f"--out {args.out}: {len(robots)} robots are named; expected one")
    max_links = opt.max_links_for(args, robots)
    tables = [
        tokens(robot, token_shapes(robot, folders), max_links=max_links)
        for robot in track(robots, args, "computing tokens", "robot", len(robots))
    ]
    data = [_data(*pair, max_links) for pair in zip(robots, tables, strict=True)]
    lines = [_text(*pair, max_links) for pair in zip(robots, tables, strict=True)]
    if args.layout:
        lines.append(f"\n{_layout_text()}")
    if args.out:
        names = [link.name for link in robots[0].links]
        write_file(args.out, tokens_npz(tables[0], names, robots[0].name, max_links))
        data[0]["file"] = str(args.out)
        lines.append(str(args.out))
    opt.print_result(args, data[0] if len(data) == 1 else data, lambda: "\n".join(lines))


def _data(robot: Robot, tokens: Array, max_links: int) -> dict[str, object]:
    return {
        "name": robot.name,
        "links": [link.name for link in robot.links],
        "max_links": max_links,
        "shape": list(tokens.shape),
        "layout": _layout_data(),
        "tokens": tokens.tolist(),
    }


def _text(robot: Robot, tokens: Array, max_links: int) -> str:
    """Return a table with a row per link, decoded from the tokens."""
    from tabulate import tabulate

    from morphgen.benchmark.tokens import robot_from_tokens

    decoded, shapes = robot_from_tokens(tokens, robot.name, max_links=max_links)
    home = dict(zip(decoded.independent_joints, decoded.home, strict=True))
    tools = {frame.link for frame in decoded.frames}
    rows = []
    for i, link in enumerate(decoded.links):
        joint = decoded.joints[i - 1] if i else None
        pose = joint.T_parent_joint if joint else None
        rows.append(
            (
                i,
                robot.links[i].name,
                decoded.parents[i] if joint else "",
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
    """Return numbers as text; adding 0.0 turns -0 into 0."""
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
    from morphgen.benchmark.tokens import LAYOUT

    return [asdict(field) for field in LAYOUT]

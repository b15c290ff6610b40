"""Options that several commands share."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from morphgen.tasks.registry import SIMULATORS, TASKS

if TYPE_CHECKING:
    from morphgen.grammar.library import Library
    from morphgen.grammar.robot_source import RobotSource
    from morphgen.model.robot import Robot

Subparsers: TypeAlias = "argparse._SubParsersAction[argparse.ArgumentParser]"


def add_task(parser: argparse.ArgumentParser, name: str, text: str = "") -> None:
    """Let the user choose a task, also one of another package.

    Args:
        parser: The command's parser.
        name: Name of the argument.
        text: Text before the names in the help.
    """
    names = f"{text}{', '.join(TASKS.builtin)} or one that another package brings"
    parser.add_argument(name, choices=TASKS, metavar="TASK", help=names)


def add_sim(parser: argparse.ArgumentParser, default: str | None = "pybullet") -> None:
    """Let the user choose a simulator, also one of another package.

    Args:
        parser: The command's parser.
        default: The default; None for that of the training.
    """
    parser.add_argument(
        "--sim",
        choices=SIMULATORS,
        metavar="SIM",
        default=default,
        help=f"{', '.join(SIMULATORS.builtin)} or one that another package brings (default: "
        f"{default or 'that of the training'})",
    )


def add_library(parser: argparse.ArgumentParser) -> None:
    """Let the user name folders of own parts."""
    parser.add_argument(
        "--library",
        metavar="DIR",
        type=Path,
        action="append",
        default=[],
        help="a folder of your own parts (also: MORPHGEN_LIBRARY); may be repeated",
    )


def whole_number(least: int, most: int | None = None) -> Callable[[str], int]:
    """Return a type for argparse: a whole number from ``least`` to ``most``.

    Args:
        least: The smallest valid number.
        most: The largest; None for no limit.
    """
    valid = f"{least} or more" if most is None else f"{least} to {most}"

    def parse(text: str) -> int:
        try:
            number = int(text)
        except ValueError:
            number = least - 1
        if number < least or (most is not None and number > most):
            raise argparse.ArgumentTypeError(f"{text}: expected a whole number, {valid}")
        return number

    return parse


ROBOT_HELP = (
    "a bundle's folder, a URDF or a xacro, parts such as ur5-plane, or words of morphgen compose, "
    "such as arm=ur5 ee=plane"
)
ROBOTS_HELP = f"{ROBOT_HELP}; a set of morphgen sample or a folder of bundles is all its robots"


def add_robot(parser: argparse.ArgumentParser) -> None:
    """Let the user name a robot."""
    parser.add_argument("words", nargs="+", metavar="ROBOT", help=ROBOT_HELP)


def add_robots(parser: argparse.ArgumentParser) -> None:
    """Let the user name one or several robots."""
    parser.add_argument("words", nargs="+", metavar="ROBOT", help=ROBOTS_HELP)


def add_root(parser: argparse.ArgumentParser) -> None:
    """Let the user name a folder that a description's files may come from."""
    parser.add_argument(
        "--root",
        metavar="DIR",
        type=Path,
        help="a folder that meshes, includes and YAML may come from, besides the description's own "
        "folder and package",
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Let the user ask for JSON."""
    parser.add_argument("--json", action="store_true", help="print JSON for machines")


def add_max_links(parser: argparse.ArgumentParser, default: str = "23") -> None:
    """Let the user choose how many links tokens are made for; the text names the default."""
    parser.add_argument(
        "--max-links",
        type=int,
        metavar="N",
        help="the most links that a robot of the study has; indices are divided by one less "
        f"(default: {default})",
    )


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Let the user choose how many processes work."""
    parser.add_argument(
        "--jobs", type=whole_number(1), default=1, metavar="N", help="processes (default: 1)"
    )


def add_out(parser: argparse.ArgumentParser) -> None:
    """Let the user choose where bundles go, and their name."""
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("robots"), help="default: robots/"
    )
    parser.add_argument(
        "--name", help="the robot's name and its folder's (default: from its parts)"
    )
    parser.add_argument("--no-picture", action="store_true", help="do not draw preview.png")


def sources_named(args: argparse.Namespace) -> list[RobotSource]:
    """Return the robots that the arguments name, one or several.

    Raises:
        MorphgenError: If a word names no robot.
    """
    from morphgen.grammar.robot_source import find_robots

    sources = find_robots(args.words, library_of(args))
    _require_files(sources, args)
    return sources


def robot_named(args: argparse.Namespace) -> Robot:
    """Return the one robot that the arguments name.

    Raises:
        MorphgenError: If they name none or several, or it is broken.
    """
    from morphgen.grammar.robot_source import find_robot, read_source

    library = library_of(args)
    source = find_robot(" ".join(args.words), library)
    _require_files([source], args)
    return read_source(source, library, args.root)


def _require_files(sources: list[RobotSource], args: argparse.Namespace) -> None:
    from morphgen.errors import FormatError

    if args.root is not None and (composed := [s for s in sources if s.path is None]):
        raise FormatError(
            f"--root {args.root}: {composed[0].label} is composed; expected a bundle, a URDF or a "
            "xacro"
        )


def max_links_for(args: argparse.Namespace, robots: Sequence[Robot]) -> int:
    """Return the number of links that tokens are made for.

    It is what ``--max-links`` says, else the benchmark's, or that of the largest robot if it has
    more, such as a robot with two arms. All robots of a command have the same.

    Raises:
        BenchmarkError: If a robot has more links than ``--max-links``.
    """
    from morphgen.benchmark.token_layout import MAX_LINKS, require_max_links

    if args.max_links is None:
        return max(MAX_LINKS, *(len(robot.links) for robot in robots))
    for robot in robots:
        require_max_links(len(robot.links), f"robot {robot.name!r}", args.max_links)
    return int(args.max_links)


def library_of(args: argparse.Namespace) -> Library:
    """The library that the arguments ask for."""
    from morphgen.grammar.library import default_library

    return default_library(args.library)

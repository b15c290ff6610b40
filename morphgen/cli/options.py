"""Options that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

if TYPE_CHECKING:
    from morphgen.grammar.library import Library

from morphgen.tasks.registry import SIMULATORS, TASKS

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


def add_max_links(parser: argparse.ArgumentParser) -> None:
    """Let the user choose how many links tokens are made for."""
    parser.add_argument(
        "--max-links",
        type=int,
        metavar="N",
        help="the most links that a robot of the study has; indices are divided by one less "
        "(default: 23)",
    )


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Let the user choose how many processes work."""
    parser.add_argument("--jobs", type=int, default=1, help="processes (default: 1)")


def add_out(parser: argparse.ArgumentParser) -> None:
    """Let the user choose where bundles go, and their name."""
    parser.add_argument(
        "--out", metavar="DIR", type=Path, default=Path("robots"), help="default: robots/"
    )
    parser.add_argument(
        "--name", help="the robot's name and its folder's (default: from its parts)"
    )
    parser.add_argument("--no-picture", action="store_true", help="do not draw preview.png")


def library_of(args: argparse.Namespace) -> Library:
    """The library that the arguments ask for."""
    from morphgen.grammar.library import default_library

    return default_library(args.library)

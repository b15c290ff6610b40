"""What ``import morphgen`` offers: compose, check, read and write robots."""

from __future__ import annotations

from collections.abc import Iterable
from os import PathLike
from pathlib import Path

from morphgen.checks import check, fix
from morphgen.formats.bundle import read_robot, write_bundle
from morphgen.grammar.compose import compose as compose_derivation
from morphgen.grammar.library import default_library
from morphgen.grammar.request import default_name, parse_request
from morphgen.model.robot import Robot

__all__ = ["check", "compose", "fix", "read", "write"]


def compose(request: str, *, name: str | None = None, library: Iterable[Path] = ()) -> Robot:
    """Join parts into a robot.

    Args:
        request: ``key=value`` words, such as ``arm=ur5 ee=plane ee.size=80mm``.
        name: The robot's name; by default from its parts.
        library: Folders of your own parts.

    Raises:
        MorphgenError: If the request names what does not exist or does not fit; the message
            says what does.
    """
    parts = default_library(library)
    derivation = parse_request(request.split(), parts)
    return compose_derivation(derivation, parts, name or default_name(derivation, parts))


def read(path: str | PathLike[str]) -> Robot:
    """Read a bundle's folder, a URDF or a xacro.

    Raises:
        FormatError: If it is none of them, or broken.
    """
    return read_robot(Path(path))


def write(robot: Robot, folder: str | PathLike[str], *, picture: bool = True) -> Path:
    """Check a robot and write its bundle: ``folder / robot.name``.

    Raises:
        FormatError: If the folder cannot be written, or holds something else of that name.
    """
    return write_bundle(robot, Path(folder) / robot.name, check(robot), picture=picture)

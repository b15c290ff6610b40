"""Robots as tasks use them, by whatever name they are given."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Literal

from morphgen.fitting.replace_collision import as_primitives
from morphgen.grammar.library import default_library
from morphgen.grammar.robot_source import find_robot, read_source
from morphgen.model.robot import Robot


def robot_of(
    given: str | Path | Robot,
    geometry: Literal["primitive", "mesh"] = "primitive",
    library: Iterable[Path] = (),
) -> Robot:
    """Return the robot that a user names, with fitted primitives as its collision shapes.

    The name is a file, a bundle, words of ``morphgen compose`` or parts joined by dashes; see
    ``morphgen.grammar.robot_source``.

    A robot is the same, with the same goals and scores, whatever names it: words, its bundle, the
    bundle's URDF, or the robot itself as ``morphgen.compose`` makes it or ``morphgen.read`` reads
    it.

    Args:
        given: The robot, or its name.
        geometry: Its collision shapes: fitted boxes, cylinders and spheres, or as they are.
        library: Folders of your own parts.

    Raises:
        CompositionError: If nothing has this name, or the parts do not fit.
        FormatError: If the file is broken.
        MorphgenError: If the words name what does not exist or does not fit.
    """
    parts = default_library(library)
    robot = given if isinstance(given, Robot) else read_source(find_robot(given, parts), parts)
    return as_primitives(robot, parts.folders) if geometry == "primitive" else robot

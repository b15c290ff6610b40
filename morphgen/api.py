"""What ``import morphgen`` offers: compose, check, read and write robots."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from os import PathLike
from pathlib import Path
from typing import Literal

from morphgen.checks import check, fix
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import read_robot, write_bundle
from morphgen.grammar.compose import compose as compose_derivation
from morphgen.grammar.conditions import require_condition
from morphgen.grammar.grammar_file import find_grammar, load_grammar
from morphgen.grammar.library import default_library
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import sample_robots
from morphgen.grammar.syntax import parse_condition
from morphgen.model.robot import Robot

__all__ = ["check", "compose", "fix", "read", "sample", "write"]


def compose(
    request: str = "",
    *,
    name: str | None = None,
    geometry: Literal["mesh", "primitive"] = "mesh",
    library: Iterable[Path] = (),
    **words: str | float,
) -> Robot:
    """Join parts into a robot.

    Args:
        request: ``key=value`` words, such as ``arm=ur5 ee=plane ee.size=80mm``, parts joined by
            dashes, such as ``ur5-plane``, or a grammar and what is pinned in it, such as
            ``chain beads=5``.
        name: The robot's name; by default from its parts.
        geometry: Collision shapes of real parts: meshes, or fitted boxes, cylinders and spheres.
        library: Folders of your own parts.
        **words: More words of the request: ``compose(arm="ur5", ee="plane")``; keys with a point
            as ``**{"ee.size": "80mm"}``.

    Raises:
        MorphgenError: If the request names what does not exist or does not fit; the message
            says what does.
    """
    parts = default_library(library)
    request_words = [*request.split(), *(f"{key}={value}" for key, value in words.items())]
    derivation, own = parse_words(request_words, parts)
    robot = compose_derivation(derivation, parts, name or own)
    return as_primitives(robot, parts.folders) if geometry == "primitive" else robot


def sample(
    grammar: str | PathLike[str],
    n: int,
    *,
    seed: int = 0,
    where: str | None = None,
    library: Iterable[Path] = (),
) -> Iterator[Robot]:
    """Draw robots from a grammar, one when asked for.

    Args:
        grammar: Name of a grammar that comes with morphgen or lies in ``library``, or a path.
        n: How many.
        seed: Seed; robot i does not depend on n.
        where: A condition such as ``reach > 0.4 and dof >= 5``.
        library: Folders of your own parts and grammars.

    Raises:
        GrammarError: If the grammar or condition is malformed.
        SamplingError: If the conditions can hardly be met.
    """
    parts = default_library(library)
    found = load_grammar(find_grammar(str(grammar), parts.folders), parts.folders)
    conditions = [parse_condition(where)] if where else []
    for condition in conditions:
        require_condition(condition)
    return (drawn.robot for drawn in sample_robots(found, parts, n, seed=seed, where=conditions))


def read(path: str | PathLike[str], *, root: str | PathLike[str] | None = None) -> Robot:
    """Read a bundle's folder, a URDF or a xacro.

    Args:
        path: The file or folder.
        root: A folder that meshes, includes and YAML may come from, besides the description's own
            folder and package.

    Raises:
        FormatError: If it is none of them, or broken.
    """
    return read_robot(Path(path), root=None if root is None else Path(root))


def write(robot: Robot, folder: str | PathLike[str], *, picture: bool = True) -> Path:
    """Check a robot and write its bundle: ``folder / robot.name``.

    Raises:
        FormatError: If the folder cannot be written, or holds something else of that name.
    """
    return write_bundle(robot, Path(folder) / robot.name, check(robot), picture=picture)

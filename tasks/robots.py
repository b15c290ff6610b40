"""Robots by whatever name they are given: a file, words of ``morphgen compose``, ur5-plane."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from morphgen.errors import CompositionError, nearest
from morphgen.fitting.replace_collision import as_primitives
from morphgen.formats.bundle import CARD, read_robot
from morphgen.grammar.compose import compose
from morphgen.grammar.library import Library, default_library
from morphgen.grammar.model import SUFFIX, grammar_names
from morphgen.grammar.request import SLOTS, parse_words
from morphgen.model.robot import TOOL, Frame, Robot

FILES = (".urdf", ".xacro")
"""What a robot's file may end in."""


def robot_of(
    given: str | Path | Robot,
    geometry: Literal["primitive", "mesh"] = "primitive",
    library: Iterable[Path] = (),
) -> Robot:
    """The robot that a user means.

    What is a bundle's folder, a URDF or a xacro is read; a link that is called ``tool`` is its tool
    (``morphgen import --tool`` names another). What begins with a word that has an ``=``,
    or with the name of a grammar, are words of ``morphgen compose``. Anything else is parts joined
    by dashes, each of which goes where its kind belongs: ``ur5-plane`` is ``arm=ur5 ee=plane``,
    ``gantry-cube`` is ``base=gantry ee=cube``.

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
    if isinstance(given, Robot):
        robot = given
    elif isinstance(given, Path) or is_file(given):
        robot = _with_tool(read_robot(Path(given)))
    else:
        derivation, name = parse_words(_words(given, parts), parts)
        robot = compose(derivation, parts, name)
    return as_primitives(robot, parts.folders) if geometry == "primitive" else robot


def _with_tool(robot: Robot) -> Robot:
    """What a URDF calls ``tool`` is a link; here it is the frame that tasks move."""
    if TOOL in robot.link_index and all(frame.name != TOOL for frame in robot.frames):
        return replace(robot, frames=(*robot.frames, Frame(TOOL, TOOL)))
    return robot


def is_file(text: str) -> bool:
    """Whether it names a robot on disk; a folder that merely has a grammar's name is none."""
    path = Path(text)
    if (path / CARD).is_file() or (text.endswith(FILES) and path.is_file()):
        return True
    if "=" in text or text.partition(" ")[0].endswith(SUFFIX):
        return False
    return "/" in text or text.endswith(FILES)


def _words(text: str, library: Library) -> list[str]:
    words = text.split()
    if not words:
        raise CompositionError("no robot is named; such as ur5-plane, or arm=ur5 ee=plane")
    if "=" in words[0] or _is_grammar(words[0], library):
        return words
    if len(words) > 1:
        raise CompositionError(
            f"robot {text!r}: {words[0]!r} is neither a grammar nor of the form key=value"
            + nearest(words[0], _grammars(library))
        )
    return [_word(part, text, library) for part in words[0].split("-")]


def _word(part: str, text: str, library: Library) -> str:
    """A part with where it belongs, such as ``arm=ur5``."""
    if part not in library.paths:
        names = {name for kind in SLOTS for name in library.names(kind)} | _grammars(library)
        raise CompositionError(
            f"robot {text!r}: there is no such bundle or URDF, and {part!r} is no part"
            + nearest(part, names)
        )
    kind = library.manifest(part).kind
    if kind not in SLOTS:
        raise CompositionError(
            f"robot {text!r}: {part!r} is a {kind}, which only a grammar can place"
            + nearest(part, _grammars(library))
        )
    return f"{kind}={part}"


def _is_grammar(word: str, library: Library) -> bool:
    return word.endswith(SUFFIX) or word in _grammars(library)


def _grammars(library: Library) -> set[str]:
    own = (path.stem for folder in library.folders for path in folder.rglob(f"*{SUFFIX}"))
    return {*grammar_names(), *own}

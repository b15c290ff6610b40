"""Where robots come from: folders, files, words of ``morphgen compose``, splits and uploads.

A robot's place is a text that fits into an address:

    robots/ur5-plane                               a bundle's folder, or a URDF or xacro
    words:arm=ur5 ee=plane                         as for ``morphgen compose``
    derivation:body=cubes(size=0.1)                parts and parameters
    split:extrapolation/arms/reach@test/widowx     a member of a split
    upload:3f2a/some.urdf                          what a user sent, while the viewer runs
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from morphgen.benchmark.split import SIDES, Member, Side, Split, compose_member
from morphgen.benchmark.split_file import find_split, read_split_file, split_names
from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import MorphgenError, nearest
from morphgen.formats.bundle import CARD, MJCF, URDF, read_robot, split_colours
from morphgen.formats.resolve import file_stamp
from morphgen.formats.urdf_text import urdf_text
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import Derivation, parse_derivation
from morphgen.grammar.grammar_file import SUFFIX, Grammar, find_grammar, load_grammar
from morphgen.grammar.library import Library
from morphgen.grammar.request import default_name, parse_words
from morphgen.grammar.robot_set import DERIVATION, INDEX, SETTINGS
from morphgen.model.robot import TOOL, Frame, Robot

WORDS, DERIVED, MEMBER, UPLOAD = "words:", "derivation:", "split:", "upload:"
SPLIT_SUFFIX = ".yaml"
EPISODE_SUFFIX, CHECKPOINT = ".npz", "checkpoint.pt"
PLAYED = (EPISODE_SUFFIX, ".pt")
"""What files end in that are played: episodes and checkpoints."""
ROBOT_SUFFIXES = (".urdf", ".xacro", ".xml")
LONGEST_TOLD = 1000
"""Characters of an error that a page shows."""
_TEMPORARY = re.compile(rf"{re.escape(tempfile.gettempdir())}/(tmp|morphgen-)[^/\s]*/?(robot/)?")


class UriError(MorphgenError):
    """There is nothing to see at a place."""


@dataclass(frozen=True)
class FileAccess:
    """What may be looked at; plain data that a worker gets, too."""

    folders: tuple[Path, ...]
    """Of the library."""
    roots: tuple[Path, ...]
    """Folders and files that addresses may name, absolute; nothing outside of them is read."""
    uploads: Path
    """Where uploads are kept."""

    @cached_property
    def library(self) -> Library:
        """Where parts are."""
        return Library(self.folders)

    def path(self, text: str) -> Path:
        """The file or folder of a place that is a path.

        Raises:
            UriError: If it does not exist, or is outside of ``roots``.
        """
        base, name, allowed = self.roots[0], text, self.roots
        if text.startswith(UPLOAD):
            base, name, allowed = self.uploads, text.removeprefix(UPLOAD), (self.uploads,)
        path = base / name
        try:
            inside = any(path.resolve().is_relative_to(root) for root in allowed)
            exists = inside and path.exists()
        except (OSError, ValueError):  # a name that no file system takes
            inside, exists = True, False
        if not inside:
            raise UriError(
                f"{shortened(text)}: is outside of the folders that this viewer was started for"
            )
        if not exists:
            raise UriError(f"{shortened(text)}: no such file or folder")
        return path

    def told(self, error: object) -> str:
        """The text of an error as a page may show it: without folders of this machine."""
        text = str(error).replace(f"{self.uploads}/", UPLOAD).replace(str(self.uploads), UPLOAD)
        text = _TEMPORARY.sub("", text)
        for root in self.roots:
            text = re.sub(rf"{re.escape(str(root))}/(?=\w)", "", text)
            text = re.sub(rf"{re.escape(str(root))}(?![\w.-])", ".", text)
        return shortened(text, LONGEST_TOLD)


def shortened(text: str, most: int = 100) -> str:
    """A text for a message: no control characters, and not longer than a number of characters."""
    plain = "".join(each if each.isprintable() else ascii(each)[1:-1] for each in text[: most + 1])
    return plain if len(plain) <= most else f"{plain[:most]}..."


def is_robot(folder: Path) -> bool:
    """Whether a folder is a robot's: a bundle, or one of a light set."""
    return (folder / CARD).is_file() or (folder / DERIVATION).is_file()


def is_set(folder: Path) -> bool:
    """Whether a folder is a set that ``morphgen sample`` made."""
    return (folder / INDEX).is_file() or (folder / SETTINGS).is_file()


def read_robot_uri(place: str, places: FileAccess) -> Robot:
    """The robot at a place.

    Raises:
        UnsoundError: If its structure is broken; the findings say how.
        MorphgenError: If there is none, or it cannot be read or composed.
    """
    try:
        return _read(place, places)
    except RecursionError:
        raise UriError(f"{shortened(place)}: is nested too deeply") from None


def _read(place: str, places: FileAccess) -> Robot:
    if place.startswith(MEMBER):
        return compose_member(resolve_member(place, places), places.library)
    if derivation := resolve_derivation(place, places):
        return compose(derivation, places.library, _name(place, derivation, places))
    path = places.path(place)
    if place.startswith(UPLOAD) and path.is_file() and path.suffix != ROBOT_SUFFIXES[0]:
        raise UriError(f"{shortened(place)}: only a URDF or a bundle is read from an upload")
    return _with_tool(read_robot(path))


def _with_tool(robot: Robot) -> Robot:
    """The robot with its link ``tool`` as tool, as tasks take it, if it has no other."""
    if TOOL in robot.link_index and all(frame.name != TOOL for frame in robot.frames):
        return replace(robot, frames=(*robot.frames, Frame(TOOL, TOOL)))
    return robot


def resolve_grammar(name: str, places: FileAccess) -> Grammar:
    """The grammar of a name, or of a file.

    Raises:
        UriError: If the file may not be looked at.
        GrammarError: If there is none, or it cannot be read.
    """
    folders = places.library.folders
    (word,) = _with_path([name], places)
    return load_grammar(find_grammar(word, folders), folders)


def resolve_words(text: str, places: FileAccess) -> tuple[Derivation, str]:
    """What words of ``morphgen compose`` derive, and the robot's name; see ``parse_words``.

    Raises:
        UriError: If they name a grammar's file that may not be looked at.
        MorphgenError: If they name what does not exist or does not fit.
    """
    return parse_words(_with_path(text.split(), places), places.library)


def _with_path(words: list[str], places: FileAccess) -> list[str]:
    """Words with the path of the grammar's file that the first of them names, if it does."""
    first = words[0] if words else ""
    if "=" in first or not (first.endswith(SUFFIX) or "/" in first):
        return words
    path = places.path(first)
    if path.suffix != SUFFIX:
        raise UriError(f"{shortened(first)}: a grammar's file ends in {SUFFIX}")
    return [str(path), *words[1:]]


def with_library_meshes(robot: Robot, library: Library) -> Robot:
    """The robot with the meshes of the library's parts, to which fits are stored.

    A bundle has copies of them. A robot whose derivation does not give the same text of URDF, but
    for the meshes' names, stays as it is.
    """
    text = robot.provenance.get("derivation")
    if not text:
        return robot
    try:
        made = compose(parse_derivation(str(text)), library, robot.name)
    except (MorphgenError, RecursionError):
        return robot  # its parts are not here, so no fits of them are
    return made if _nameless(made) == _nameless(robot) else robot


def _nameless(robot: Robot) -> str:
    return urdf_text(split_colours(robot), lambda mesh: "")


def name_of(place: str) -> str:
    """What to call a robot before it is read."""
    for prefix in (WORDS, DERIVED):
        if place.startswith(prefix):
            return place.removeprefix(prefix)
    return place.rstrip("/").rpartition("/")[2]


def resolve_derivation(place: str, places: FileAccess) -> Derivation | None:
    """How the robot at a place is derived; None if it is read from a URDF.

    Raises:
        MorphgenError: If there is no such place, or its derivation is none.
    """
    if place.startswith(WORDS):
        return resolve_words(place.removeprefix(WORDS), places)[0]
    if place.startswith(DERIVED):
        return parse_derivation(place.removeprefix(DERIVED))
    if place.startswith(MEMBER):
        return parse_derivation(resolve_member(place, places).derivation)
    light = places.path(place) / DERIVATION
    if light.is_file() and not (places.path(place) / CARD).is_file():
        return parse_derivation(light.read_text(encoding="utf-8"), str(light))
    return None


def _name(place: str, derivation: Derivation, places: FileAccess) -> str:
    if place.startswith(WORDS):
        return resolve_words(place.removeprefix(WORDS), places)[1]
    if place.startswith(DERIVED):
        return default_name(derivation, places.library)
    return places.path(place).resolve().name


def resolve_split(text: str, places: FileAccess) -> Split:
    """A split by its name, file or built folder.

    Raises:
        MorphgenError: If there is none, or it cannot be read.
    """
    if text in split_names():
        return read_split_file(find_split(text)).split
    path = places.path(text)
    return read_split_file(path / SPLIT_FILE if path.is_dir() else path).split


def member_uri(split: str, side: Side, member: Member) -> str:
    """The place of a member of a split."""
    return f"{MEMBER}{split}@{side}/{member.name}"


def resolve_member(place: str, places: FileAccess) -> Member:
    """The member of a split at a place.

    Raises:
        UriError: If there is none.
    """
    name, at, member = place.removeprefix(MEMBER).rpartition("@")
    text, _, robot = member.partition("/")
    side = next((each for each in SIDES if each == text), None)
    if not at or side is None:
        raise UriError(f"{place}: expected split:NAME@train/ROBOT or split:NAME@test/ROBOT")
    members = {each.name: each for each in resolve_split(name, places).side(side)}
    if robot not in members:
        raise UriError(
            f"{place}: split {name} has no {side} robot {robot!r}" + nearest(robot, members)
        )
    return members[robot]


def content_hash(place: str, places: FileAccess) -> str:
    """A hash that changes when the robot at a place may: its files, its parts, morphgen.

    Raises:
        MorphgenError: If there is no such place.
    """
    lines = [version("morphgen")]
    if derivation := resolve_derivation(place, places):
        lines.append(str(derivation))
        lines += _stamps(_part_files(derivation, places.library))
    else:
        path = places.path(place)
        files = (path / URDF, path / MJCF, path / CARD) if path.is_dir() else (path,)
        lines += [str(path.resolve()), *_stamps(files)]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:32]


def _part_files(derivation: Derivation, library: Library) -> Iterable[Path]:
    for part in {node.part for node in derivation.walk()}:
        manifest = library.manifest(part)
        yield manifest.path
        if isinstance(manifest.source, Path):
            yield manifest.source


def _stamps(files: Iterable[Path]) -> list[str]:
    return [f"{path} {file_stamp(path)}" for path in sorted(set(files))]

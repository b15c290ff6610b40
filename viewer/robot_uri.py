"""Robot URIs, and the files that addresses may name.

A robot URI is a text that fits into an address:

    robots/ur5-plane                               the folder of a bundle, or a URDF, xacro or MJCF
    words:arm=ur5 ee=plane                         words as for ``morphgen compose``
    derivation:body=cubes(size=0.1)                parts and parameters
    split:extrapolation/arms/reach@test/widowx     a member of a split
    upload:3f2a/some.urdf                          a file that a user uploaded to this viewer

Threat: addresses come from whoever can open a page, so every path in them is resolved by
``FileAccess.path``, which rejects whatever lies outside the allowed folders, symbolic links
included; and every error is shown through ``FileAccess.redact``, which removes the folders of this
machine.
"""

from __future__ import annotations

import hashlib
import re
import tempfile
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import version
from pathlib import Path

from platformdirs import user_cache_path

from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import MorphgenError, nearest
from morphgen.files import file_stamp
from morphgen.formats.bundle import CARD, MJCF, URDF, is_mjcf, split_colours
from morphgen.formats.mjcf.document import read_document
from morphgen.formats.resolve import PackageFinder
from morphgen.formats.urdf.write import urdf_text
from morphgen.grammar.compose import compose
from morphgen.grammar.grammar_file import SUFFIX, Grammar, find_grammar, load_grammar
from morphgen.grammar.library import Library
from morphgen.grammar.request import default_name, parse_words
from morphgen.grammar.robot_source import RobotReference, light_derivation, read_source
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.robot import Robot
from morphgen.splits.split import (
    SIDES,
    Member,
    Side,
    Split,
    compose_member,
    find_split,
    read_split_file,
    split_names,
)

WORDS, DERIVATION, MEMBER, UPLOAD = "words:", "derivation:", "split:", "upload:"
"""Schemes of robot URIs; a URI without scheme is a path."""
DEFAULT_WORDS = "arm=ur5 ee=plane"  # words of the robot that pages show when none is named
CHECKPOINT = "checkpoint.pt"
_VERSION = version("morphgen")  # it takes longer to look up than the rest of a hash
MAX_ERROR = 1000  # longest error that a page shows [characters]
_TEMPORARY = re.compile(rf"{re.escape(tempfile.gettempdir())}/(tmp|morphgen-)[^/\s]*/?(robot/)?")


class UriError(MorphgenError):
    """A URI or path does not exist, or the viewer may not read it."""


@dataclass(frozen=True)
class FileAccess:
    """Folders that a viewer may read. Plain data, so that worker processes get it too."""

    library_folders: tuple[Path, ...]  # folders of the library of parts
    roots: tuple[Path, ...]
    """Absolute folders below which addresses may name files; relative paths start at the first."""
    uploads: Path  # folder with the users' uploads

    @cached_property
    def library(self) -> Library:
        """The library of parts."""
        return Library(self.library_folders)

    def path(self, text: str) -> Path:
        """Return the existing file or folder that a path or an ``upload:`` URI names."""
        base, name, allowed = self.roots[0], text, self.roots
        if text.startswith(UPLOAD):
            base, name, allowed = self.uploads, text.removeprefix(UPLOAD), (self.uploads,)
        path = base / name
        try:
            inside = any(path.resolve().is_relative_to(root) for root in allowed)
            exists = inside and path.exists()
        except (OSError, ValueError):  # not a valid file name
            inside, exists = True, False
        if not inside:
            raise UriError(
                f"{shorten(text)}: is outside of the folders that this viewer was started for"
            )
        # The folder of all uploads has the names of other users' folders.
        if not exists or (text.startswith(UPLOAD) and path.resolve() == self.uploads.resolve()):
            raise UriError(f"{shorten(text)}: no such file or folder")
        return path

    def redact(self, error: object) -> str:
        """Return the text of an error without this machine's folders, for a page."""
        text = str(error).replace(f"{self.uploads}/", UPLOAD).replace(str(self.uploads), UPLOAD)
        text = _TEMPORARY.sub("", text).replace(f"{user_cache_path('morphgen')}/", "")
        for root in self.roots:
            text = re.sub(rf"{re.escape(str(root))}/(?=\w)", "", text)
            text = re.sub(rf"{re.escape(str(root))}(?![\w.-])", ".", text)
        return shorten(text, MAX_ERROR)


def shorten(text: str, limit: int = 100) -> str:
    """Return a text for a message: control characters escaped, at most ``limit`` characters."""
    head = text[: limit + 1]
    plain = "".join(char if char.isprintable() else ascii(char)[1:-1] for char in head)
    return plain if len(plain) <= limit else f"{plain[:limit]}..."


def uri_name(uri: str) -> str:
    """Return a short name for a URI, without reading its robot."""
    for scheme in (WORDS, DERIVATION):
        if uri.startswith(scheme):
            return uri.removeprefix(scheme)
    return uri.rstrip("/").rpartition("/")[2]


def parent_folder(uri: str) -> str:
    """Return the folder part of a URI that is a path; empty if it has none."""
    return "" if ":" in uri else uri.rstrip("/").rpartition("/")[0]


def member_uri(split: str, side: Side, member: Member) -> str:
    """Return the URI of a member of a split."""
    return f"{MEMBER}{split}@{side}/{member.name}"


def member_split(uri: str) -> str:
    """Return the split that the URI of a member names; empty for other URIs."""
    return uri.removeprefix(MEMBER).rpartition("@")[0] if uri.startswith(MEMBER) else ""


def read_robot_uri(uri: str, files: FileAccess) -> Robot:
    """Read or compose the robot of a URI."""
    try:
        if uri.startswith(MEMBER):
            return compose_member(resolve_member(uri, files), files.library)
        if uri.startswith(WORDS):
            derivation, name = resolve_words(uri.removeprefix(WORDS), files)
            return compose(derivation, files.library, name)
        if uri.startswith(DERIVATION):
            derivation = parse_derivation(uri.removeprefix(DERIVATION))
            return compose(derivation, files.library, default_name(derivation, files.library))
        path = files.path(uri)
        if uri.startswith(UPLOAD) and path.is_file():
            _require_readable_upload(uri, path, files)
        return read_source(RobotReference(uri, path), files.library)
    except RecursionError:
        raise UriError(f"{shorten(uri)}: is nested too deeply") from None


def _require_readable_upload(uri: str, path: Path, files: FileAccess) -> None:
    """Require that a file of an upload is one that pages read: no xacro, which is a program.

    An address may name any MJCF of an upload, so its files are checked whenever they are read.
    """
    if path.suffix.lower() not in (".urdf", ".xml"):
        raise UriError(f"{shorten(uri)}: only a URDF, an MJCF or a bundle is read from an upload")
    if is_mjcf(path):
        own = path.resolve().relative_to(files.uploads).parts[0]
        require_own_files(path, files.uploads / own)


def require_own_files(mjcf: Path, folder: Path) -> None:
    """Require that an MJCF names only files of a folder, symbolic links resolved.

    The paths are found by the function that later reads them: it joins ``meshdir`` and the like,
    decodes escapes (``%2f``) and finds packages elsewhere on this machine.
    """
    document = read_document(mjcf, PackageFinder())
    for file in (*document.includes, *document.meshes.values()):
        if not file.resolve().is_relative_to(folder):
            raise UriError(f"{mjcf.name}: names {file.name!r}, which is not in the upload")


def resolve_derivation(uri: str, files: FileAccess) -> Derivation | None:
    """Return the derivation of a URI's robot; None if the robot is read from a description."""
    if uri.startswith(WORDS):
        return resolve_words(uri.removeprefix(WORDS), files)[0]
    if uri.startswith(DERIVATION):
        return parse_derivation(uri.removeprefix(DERIVATION))
    if uri.startswith(MEMBER):
        return parse_derivation(resolve_member(uri, files).derivation)
    return light_derivation(files.path(uri))


def resolve_grammar(name: str, files: FileAccess) -> Grammar:
    """Return the grammar of a name or of an allowed file."""
    folders = files.library.folders
    (word,) = _resolve_grammar_path([name], files)
    return load_grammar(find_grammar(word, folders), folders)


def resolve_words(text: str, files: FileAccess) -> tuple[Derivation, str]:
    """Return the derivation and name of the robot that words of ``morphgen compose`` describe."""
    return parse_words(_resolve_grammar_path(text.split(), files), files.library)


def _resolve_grammar_path(words: list[str], files: FileAccess) -> list[str]:
    """Return the words with the absolute path of the grammar's file, if the first names one."""
    first = words[0] if words else ""
    if "=" in first or not (first.endswith(SUFFIX) or "/" in first):
        return words
    path = files.path(first)
    if path.suffix != SUFFIX:
        raise UriError(f"{shorten(first)}: a grammar's file ends in {SUFFIX}")
    return [str(path), *words[1:]]


def resolve_split(text: str, files: FileAccess) -> Split:
    """Return a split by its name, its file or its built folder."""
    if text in split_names():
        return read_split_file(find_split(text)).split
    path = files.path(text)
    return read_split_file(path / SPLIT_FILE if path.is_dir() else path).split


def resolve_member(uri: str, files: FileAccess) -> Member:
    """Return the member of a split that a URI names."""
    name, at, member = uri.removeprefix(MEMBER).rpartition("@")
    side_name, _, robot = member.partition("/")
    side = next((side for side in SIDES if side == side_name), None)
    if not at or side is None:
        raise UriError(f"{uri}: expected split:NAME@train/ROBOT or split:NAME@test/ROBOT")
    members = {member.name: member for member in resolve_split(name, files).side(side)}
    if robot not in members:
        raise UriError(
            f"{uri}: split {name} has no {side} robot {robot!r}{nearest(robot, members)}"
        )
    return members[robot]


def with_library_meshes(robot: Robot, library: Library) -> Robot:
    """Return a bundle's robot with the library's meshes, for which fits are stored.

    It is unchanged if its derivation does not compose to the same URDF, apart from meshes.
    """
    text = robot.provenance.get("derivation")
    if not text:
        return robot
    try:
        composed = compose(parse_derivation(str(text)), library, robot.name)
    except (MorphgenError, RecursionError):
        return robot  # the library lacks its parts, so it has no fits of them either
    texts = [urdf_text(split_colours(variant), lambda mesh: "") for variant in (composed, robot)]
    return composed if texts[0] == texts[1] else robot


def content_hash(uri: str, files: FileAccess) -> str:
    """Return a hash that changes with the robot's description, its parts and morphgen's version."""
    # Meshes and included xacro files would take long: who edits one restarts the viewer.
    lines = [_VERSION]
    if derivation := resolve_derivation(uri, files):
        lines.append(str(derivation))
        manifests = [files.library.manifest(node.part) for node in derivation.walk()]
        paths = [path for manifest in manifests for path in (manifest.path, manifest.source)]
    else:
        path = files.path(uri)
        lines.append(str(path.resolve()))
        paths = [path / URDF, path / MJCF, path / CARD] if path.is_dir() else [path]
    # Sources that are no paths are files of installed packages, which change with their version.
    stamped = sorted({path for path in paths if isinstance(path, Path)})
    lines += [f"{path} {file_stamp(path)}" for path in stamped]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:32]

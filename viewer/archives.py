"""Zips from strangers: read within bounds, with names that every file system takes."""

from __future__ import annotations

import io
import stat
import struct
import zipfile
import zlib
from pathlib import PurePosixPath

from morphgen.errors import MorphgenError
from morphgen.viewer.robot_uri import shortened

LARGEST = 100 * 2**20
"""Bytes of all files, unpacked."""
MOST_FILES = 2000
LONGEST_PART = 100
"""Characters of a file's or folder's name."""
DEEPEST = 20
"""Folders within one another."""
_ENTRY = b"PK\x01\x02"
"""Begins every entry of a zip's table of contents."""
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Others can ask for gigabytes of memory before they give a byte."""


class ArchiveError(MorphgenError):
    """A zip that is not read."""


def unpacked(name: str, content: bytes) -> dict[str, bytes]:
    """The files of a zip by their paths.

    Args:
        name: Of the zip, for messages.
        content: All of it.

    Raises:
        ArchiveError: If it is damaged or encrypted, unpacks to too much, or has a name that leads
            out of its folder, that is there twice, or that is a link's or too long.
    """
    if content.count(_ENTRY) > MOST_FILES:  # counted before a table of millions is read
        raise ArchiveError(f"{name}: holds more than {MOST_FILES} files")
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            if sum(entry.file_size for entry in entries) > LARGEST:
                raise ArchiveError(f"{name}: unpacks to more than {LARGEST // 2**20} MB")
            paths = [_checked_path(name, entry) for entry in entries]
            _require_apart(name, paths)
            return {path: archive.read(entry) for path, entry in zip(paths, entries, strict=True)}
    except (
        zipfile.BadZipFile,
        zlib.error,
        struct.error,
        EOFError,
        OSError,
        RuntimeError,
        ValueError,
    ) as error:
        raise ArchiveError(f"{name}: no readable zip: {shortened(str(error))}") from error


def is_inside(path: str) -> bool:
    """Whether a path with slashes stays in the folder that it begins in."""
    depth = 0
    for part in path.replace("\\", "/").split("/"):
        depth += {"..": -1, ".": 0, "": 0}.get(part, 1)
        if depth < 0:
            return False
    return not path.startswith(("/", "\\"))


def _checked_path(name: str, entry: zipfile.ZipInfo) -> str:
    told = f"{name}: {shortened(entry.orig_filename)!r}"
    path = PurePosixPath(entry.orig_filename.replace("\\", "/"))
    if not is_inside(entry.orig_filename) or ".." in path.parts or ":" in str(path):
        raise ArchiveError(f"{told} leads out of its folder")
    if stat.S_ISLNK(entry.external_attr >> 16):
        raise ArchiveError(f"{told} is a link")
    if entry.compress_type not in _METHODS:
        raise ArchiveError(f"{told} is packed by a method other than deflate")
    if not path.parts or len(path.parts) > DEEPEST or not str(path).isprintable():
        raise ArchiveError(f"{told} is no name of a file, or one in more than {DEEPEST} folders")
    if any(len(part.encode()) > LONGEST_PART for part in path.parts):
        raise ArchiveError(f"{told} is longer than {LONGEST_PART} characters")
    return str(path)


def _require_apart(name: str, paths: list[str]) -> None:
    """Require that no two files have the same path, and none the path of a folder."""
    seen: set[str] = set()
    for path in paths:
        if path.casefold() in seen:
            raise ArchiveError(f"{name}: {shortened(path)!r} is there twice")
        seen.add(path.casefold())
    for path in paths:
        for folder in PurePosixPath(path.casefold()).parents:
            if str(folder) in seen:
                raise ArchiveError(f"{name}: {shortened(path)!r} is in a folder that is a file")

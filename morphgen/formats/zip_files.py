"""Zip archives: written with the same bytes for the same files, and read without trust.

Threat: an archive from a stranger may name files outside its folder, hold links or two files of one
name, or unpack to more than the disk holds. Everything is checked before the first file is written.
"""

from __future__ import annotations

import posixpath
import stat
import struct
import tokenize
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import FormatError, shortened
from morphgen.files import replacing_file
from morphgen.formats.files import writing

_ENTRY_SIGNATURE = b"PK\x01\x02"  # first bytes of every entry in a zip's table of contents
_COMPRESSION = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
"""Accepted methods; others (LZMA) can allocate gigabytes before they return a byte."""
_EPOCH = (1980, 1, 1, 0, 0, 0)  # time of all written entries: the earliest that a zip can hold
_MODE = 0o100644  # mode of all written entries: a regular file that its owner may write
_UNIX = 3  # system that written entries name as their creator
_LEVEL = 9
_CHUNK = 2**20  # bytes that are unpacked at once

UNREADABLE = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    OSError,
    RuntimeError,  # an encrypted file
    ValueError,
)
"""Errors that ``zipfile`` raises for malformed archives."""


@dataclass(frozen=True)
class ZipLimits:
    """Bounds on an archive that is read."""

    max_bytes: int  # largest total size of the unpacked files [bytes]
    max_files: int
    max_name: int = 250  # longest name of a file or folder [bytes]
    max_depth: int = 20  # longest path [names]


def write_zip(path: Path, files: Mapping[str, bytes | Path]) -> None:
    """Write an archive in place of an earlier one; nothing half-written stays."""
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacing_file(path) as partial, partial.open("wb") as target:
            write_entries(target, files)
            target.close()  # before the rename: Windows replaces no open file


def write_entries(target: IO[bytes], files: Mapping[str, bytes | Path]) -> None:
    """Write an archive of files to an open file; for the arguments see ``write_zip``.

    Entries are sorted and have no time, so the same files give the same bytes with the same zlib.
    """
    with zipfile.ZipFile(target, "w") as archive:
        for name in sorted(files):
            entry = zipfile.ZipInfo(name, _EPOCH)
            entry.external_attr, entry.create_system = _MODE << 16, _UNIX
            content = files[name]
            data = content.read_bytes() if isinstance(content, Path) else content
            archive.writestr(entry, data, zipfile.ZIP_DEFLATED, _LEVEL)


def unpack_zip(path: Path, folder: Path, limits: ZipLimits) -> None:
    """Unpack an archive into an empty folder."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe may never end
            raise FormatError(f"{path}: is not a regular file")
        if status.st_size > limits.max_bytes:
            raise FormatError(f"{path}: more than {limits.max_bytes // 2**20} MB")
        with path.open("rb") as file:
            require_few_entries(file, limits)
        with zipfile.ZipFile(path) as archive:
            for entry, name in safe_entries(archive, limits):
                target = folder / name
                target.parent.mkdir(parents=True, exist_ok=True)
                _unpack_entry(archive, entry, target)
    except FormatError as error:
        raise FormatError(str(error) if str(path) in str(error) else f"{path}: {error}") from error
    except FileNotFoundError as error:
        raise FormatError(f"{path}: no such file") from error
    except UNREADABLE as error:
        raise FormatError(f"{path}: not a readable zip: {shortened(str(error))}") from error


def require_few_entries(file: IO[bytes], limits: ZipLimits) -> None:
    """Require that the table of contents of an archive is not too large to be read.

    The entries are counted in the raw bytes, because ``zipfile`` reads a table of millions of them
    into memory.
    """
    count, end = 0, b""
    while chunk := file.read(_CHUNK):
        count += (end + chunk).count(_ENTRY_SIGNATURE)
        end = chunk[1 - len(_ENTRY_SIGNATURE) :]  # one byte too short to be counted again
    # Folders are entries, too; compressed data may hold the signature by chance.
    if count > 2 * limits.max_files:
        raise FormatError(f"holds more than {limits.max_files} files")


def safe_entries(archive: zipfile.ZipFile, limits: ZipLimits) -> list[tuple[zipfile.ZipInfo, str]]:
    """Return the files of an archive with their paths, after checking its table of contents."""
    entries = [entry for entry in archive.infolist() if not entry.is_dir()]
    if len(entries) > limits.max_files:
        raise FormatError(f"holds more than {limits.max_files} files")
    if sum(entry.file_size for entry in entries) > limits.max_bytes:
        raise FormatError(f"unpacks to more than {limits.max_bytes // 2**20} MB")
    paths = [_entry_path(entry, limits) for entry in entries]
    _require_distinct(paths)
    return list(zip(entries, paths, strict=True))


def stays_inside(path: str) -> bool:
    """Return whether a path with slashes or backslashes stays in the folder that it starts in."""
    normal = posixpath.normpath(path.replace("\\", "/"))
    return normal != ".." and not normal.startswith(("/", "../"))


def _unpack_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path) -> None:
    """Write one file; its size is that of the table of contents at most."""
    left = entry.file_size
    with archive.open(entry) as source, target.open("xb") as file:
        while chunk := source.read(_CHUNK):
            left -= len(chunk)
            if left < 0:
                raise FormatError(f"{shortened(entry.filename)!r} is larger than its entry says")
            file.write(chunk)


def _entry_path(entry: zipfile.ZipInfo, limits: ZipLimits) -> str:
    """Return the path of an entry, if every file system can store it safely."""
    path = PurePosixPath(entry.orig_filename.replace("\\", "/"))
    fault = ""
    if not stays_inside(entry.orig_filename) or ".." in path.parts or ":" in str(path):
        fault = "leads out of its folder"
    elif stat.S_ISLNK(entry.external_attr >> 16):
        fault = "is a link"
    elif entry.compress_type not in _COMPRESSION:
        fault = "is compressed by a method other than deflate"
    elif not path.parts or len(path.parts) > limits.max_depth or not str(path).isprintable():
        fault = f"is not a valid file name, or lies in more than {limits.max_depth} folders"
    elif any(len(part.encode()) > limits.max_name for part in path.parts):
        fault = f"is longer than {limits.max_name} characters"
    if fault:
        raise FormatError(f"{shortened(entry.orig_filename)!r} {fault}")
    return str(path)


def _require_distinct(paths: Sequence[str]) -> None:
    """Require that no two paths are equal, whatever the case, and none the folder of another."""
    known_paths: set[str] = set()
    for path in paths:
        if path.casefold() in known_paths:
            raise FormatError(f"{shortened(path)!r} is there twice")
        known_paths.add(path.casefold())
    for path in paths:
        if not known_paths.isdisjoint(map(str, PurePosixPath(path.casefold()).parents)):
            raise FormatError(f"{shortened(path)!r} is in a folder that is a file")


UNREADABLE_NPZ = (*UNREADABLE, tokenize.TokenError, KeyError, MemoryError, OverflowError)
"""Errors of NumPy for malformed archives; a header may claim any shape."""
MAX_BYTES = 2**30  # largest total size of the arrays of an archive [bytes]


def read_npz(
    source: Path | IO[bytes], names: Sequence[str] | None = None, max_bytes: int | None = None
) -> dict[str, NDArray[Any]]:
    """Return arrays of an archive by their names, all of them by default."""
    most = MAX_BYTES if max_bytes is None else max_bytes
    try:
        with zipfile.ZipFile(source) as archive:
            if sum(entry.file_size for entry in archive.infolist()) > most:
                raise ValueError(f"its arrays have more than {most // 2**20} MB")
        with np.load(source, allow_pickle=False) as data:
            return {name: data[name] for name in (data.files if names is None else names)}
    except FileNotFoundError:
        raise
    except UNREADABLE_NPZ as error:
        raise ValueError(str(error)) from error

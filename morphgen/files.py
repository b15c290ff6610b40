"""Write files atomically, tell their versions apart, and keep computed values in the user's cache.

A value is kept under a hash of what it was computed from, so an entry never has to be cleared.
Entries hold plain data and arrays. Nothing in them is executed, and one that is broken, or that
another program wrote, is ignored. A cache that cannot be written makes commands slower only.
"""

from __future__ import annotations

import hashlib
import logging
import os
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import fields, is_dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from morphgen.errors import FormatError

if TYPE_CHECKING:
    from lxml import etree

T = TypeVar("T")
_LOGGER = logging.getLogger(__name__)


def xml_parser(*, recover: bool = False, huge_tree: bool = False) -> etree.XMLParser:
    """Return a parser of XML from strangers: it resolves no entity, and loads no other file.

    ``huge_tree`` lifts libxml2's limit on the length of a text.
    """
    from lxml import etree  # here, because most users of this module read no XML

    return etree.XMLParser(
        recover=recover,
        huge_tree=huge_tree,
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        remove_comments=True,
        remove_pis=True,
    )


def file_stamp(path: Path) -> tuple[int, int]:
    """Return modification time [ns] and size [bytes] of a file; zeros if it does not exist."""
    if not path.is_file():
        return (0, 0)
    status = path.stat()
    return (status.st_mtime_ns, status.st_size)


def cached_until_changed(function: Callable[[Path], T]) -> Callable[[Path], T]:
    """Cache the results of a function of a file; a file that changed is read again."""

    @lru_cache(maxsize=4096)
    def cached(path: Path, stamp: tuple[int, int]) -> T:
        del stamp
        return function(path)

    return lambda path: cached(path.absolute(), file_stamp(path))


def file_sha256(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@cached_until_changed
def content_sha256(path: Path) -> str:
    """Return the SHA-256 of a file."""
    try:
        return file_sha256(path)
    except OSError as error:
        raise FormatError(f"{path}: cannot be read: {error.strerror}") from error


def write_atomic(path: Path, content: str | bytes) -> None:
    """Write a file by way of ``replacing_file``."""
    with replacing_file(path) as partial:
        partial.write_bytes(content.encode() if isinstance(content, str) else content)


@contextmanager
def replacing_file(path: Path) -> Iterator[Path]:
    """Yield a path in a temporary folder whose file replaces ``path`` if the block succeeds.

    Concurrent processes may write the same file. An ``OSError`` names ``path``.
    """
    try:
        # Only a rename within one file system is atomic.
        with tempfile.TemporaryDirectory(prefix=f".{path.name}.", dir=path.parent) as folder:
            partial = Path(folder) / path.name
            yield partial
            partial.replace(path)
    except OSError as error:
        error.filename = str(path)
        raise


def write_cache_file(path: Path, content: str | bytes) -> None:
    """Write a file of a cache and create its folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, content)


def keep_file(path: Path, content: str | bytes, what: str) -> None:
    """Write a file of the user's cache; if that fails, say so once for its folder."""
    try:
        write_cache_file(path, content)
    except OSError as error:
        _warn_of(path.parent, error.strerror, what)


@lru_cache(maxsize=1024)
def _warn_of(folder: Path, reason: str | None, what: str) -> None:
    text = "cannot keep %s in %s: %s; they are made again each time"
    _LOGGER.warning(text, what, folder, reason)


KEPT = "compiled-1"
"""Folder of kept values in the user's cache; the number rises when the same key gets another
value, or the form of an entry changes."""
_ROOMS = ("model", "formats", "formats/mjcf", "formats/urdf", "formats/xacro", "checks")
"""Folders of the modules that compute kept values."""
MAX_KEPT = 2**29
"""Size of all kept values above which those are removed that were not used for longest [bytes]."""
_USED_AGAIN = 86_400.0  # time after which reading an entry counts as a new use [s]
_FAULTS = (ArithmeticError, LookupError, RecursionError, TypeError, ValueError)
"""Exceptions that a file which is no entry can raise."""
_room = 0  # number of bytes that may be kept before the folder is measured again


def read_kept(kind: str, key: Sequence[object], types: Sequence[type] = ()) -> Any:  # noqa: ANN401
    """Return a value of the user's cache; None without one.

    types: Dataclasses and named tuples that the value may contain. Lists come back as tuples, and
        arrays are read-only.
    """
    import msgspec  # here and below, because files are written without it

    path = _kept_path(kind, key)
    try:
        data = path.read_bytes()
        if zlib.crc32(data[4:]).to_bytes(4, "big") != data[:4]:
            return None
        name, plain = msgspec.msgpack.decode(data[4:])
        value = _from_plain(plain, {each.__name__: each for each in types})
    except (OSError, msgspec.MsgspecError, *_FAULTS):
        return None
    if name != path.name:
        return None
    with suppress(OSError):
        if time.time() - path.stat().st_mtime > _USED_AGAIN:
            os.utime(path)
    return value


def keep(kind: str, key: Sequence[object], value: object) -> None:
    """Keep a value in the user's cache for ``read_kept``."""
    import msgspec

    path = _kept_path(kind, key)
    body = msgspec.msgpack.encode([path.name, _to_plain(value)])
    _make_room(path.parent, len(body))
    keep_file(path, zlib.crc32(body).to_bytes(4, "big") + body, "compiled parts and meshes")


def kept(kind: str, key: Sequence[object], make: Callable[[], T], types: Sequence[type] = ()) -> T:
    """Return a value of the user's cache, which is made and kept if it is not there.

    types: See ``read_kept``.
    """
    found: T | None = read_kept(kind, key, types)
    if found is None:
        found = make()
        keep(kind, key, found)
    return found


def _kept_path(kind: str, key: Sequence[object]) -> Path:
    import msgspec
    from platformdirs import user_cache_path

    text = msgspec.msgpack.encode([kind, _versions(), _to_plain(key)])
    name = f"{kind}-{hashlib.sha256(text).hexdigest()[:32]}"
    return user_cache_path("morphgen") / KEPT / name


@lru_cache(maxsize=1)
def _versions() -> tuple[object, ...]:
    """Return what tells versions of the code that computes kept values apart."""
    from importlib.metadata import version

    modules = (
        entry.stat().st_mtime_ns  # a developer's change counts as a version, too
        for room in _ROOMS
        for entry in os.scandir(Path(__file__).parent / room)
        if entry.name.endswith(".py")
    )
    return (*map(version, ("morphgen", "mujoco", "trimesh")), max(modules))


def _make_room(folder: Path, size: int) -> None:
    """Remove entries that were not used for longest if too many bytes are kept."""
    global _room
    if size > _room:
        with suppress(OSError):  # other processes remove entries, too
            entries = sorted(
                (status.st_mtime, status.st_size, entry.path)
                for entry in (os.scandir(folder) if folder.is_dir() else ())
                for status in [entry.stat()]
                if entry.is_file()  # else the folder of another process, which writes an entry
            )
            total = size + sum(entry[1] for entry in entries)
            if total > MAX_KEPT:
                for _, length, path in entries:
                    Path(path).unlink()
                    total -= length
                    if total <= MAX_KEPT / 2:
                        break
            _room = max(size, int(MAX_KEPT - total) // 4)
    _room -= size


def _to_plain(value: Any) -> Any:  # noqa: ANN401
    """Return a value as lists, dictionaries, numbers, texts and bytes."""
    kind = type(value).__name__
    if isinstance(value, list | tuple) and not hasattr(value, "_fields"):
        return [_to_plain(each) for each in value]
    if isinstance(value, dict):
        return {name: _to_plain(each) for name, each in value.items()}
    if isinstance(value, Path):
        return {"": "Path", "path": str(value)}
    if kind == "ndarray":
        array = {"dtype": value.dtype.str, "shape": value.shape, "data": value.tobytes()}
        return {"": "ndarray", **array}
    names = (
        [each.name for each in fields(value) if each.init]
        if is_dataclass(value)
        else getattr(value, "_fields", None)
    )
    if names is None:
        return value
    return {"": kind, **{name: _to_plain(getattr(value, name)) for name in names}}


def _from_plain(value: Any, types: dict[str, type]) -> Any:  # noqa: ANN401
    """Return the value that ``_to_plain`` was given."""
    if isinstance(value, list):
        return tuple(_from_plain(each, types) for each in value)
    if not isinstance(value, dict):
        return value
    kind = value.pop("", None)
    if kind == "ndarray":
        import numpy as np

        return np.frombuffer(value["data"], value["dtype"]).reshape(value["shape"])
    if kind == "Path":
        return Path(value["path"])
    values = {name: _from_plain(each, types) for name, each in value.items()}
    return values if kind is None else types[kind](**values)

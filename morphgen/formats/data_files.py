"""Read JSON and YAML from untrusted sources: regular files of bounded size, depth and expansion."""

from __future__ import annotations

import json
import stat
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

import yaml

from morphgen.errors import FormatError
from morphgen.files import content_sha256, keep, read_kept

T = TypeVar("T")

MAX_FILE_BYTES = 64 * 2**20  # largest data file that is read [bytes]
MAX_DEPTH = 100  # deepest nesting of lists and objects that is read
MAX_YAML_VALUES = 1_000_000  # largest number of values in a YAML file, with every alias expanded

_files_read: ContextVar[set[Path] | None] = ContextVar("files_read", default=None)
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_bytes(path: Path, max_bytes: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file of at most ``max_bytes``."""
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):  # a pipe may never end
            raise FormatError(f"{path}: is not a regular file")
        if status.st_size > max_bytes:
            raise FormatError(f"{path}: holds {status.st_size} bytes; at most {max_bytes} are read")
        with path.open("rb") as file:
            data = file.read(max_bytes + 1)
    except OSError as error:
        is_missing = isinstance(error, FileNotFoundError)
        why = "no such file" if is_missing else f"cannot be read: {error.strerror}"
        raise FormatError(f"{path}: {why}") from error
    if len(data) > max_bytes:
        raise FormatError(f"{path}: holds more than {max_bytes} bytes, the most that is read")
    if (files := _files_read.get()) is not None:
        files.add(path)
    return data


def kept_reading(
    kind: str, key: Sequence[object], read: Callable[[], T], types: Sequence[type] = ()
) -> T:
    """Return what is read from installed files, from the user's cache until one of them changes.

    read: Reads them by ``read_bytes``, in this process.
    types: See ``read_kept``.
    """
    try:
        kept: tuple[dict[str, str], T] | None = read_kept(kind, key, types)
        if kept and all(content_sha256(Path(name)) == hash_ for name, hash_ in kept[0].items()):
            return kept[1]
    except FormatError:  # a file is gone
        pass
    files: set[Path] = set()
    token = _files_read.set(files)
    try:
        value = read()
    finally:
        _files_read.reset(token)
    keep(kind, key, ({str(path): content_sha256(path) for path in files}, value))
    return value


def read_text(path: Path, max_bytes: int = MAX_FILE_BYTES) -> str:
    """Return the text of a regular UTF-8 file, with its line ends unified."""
    try:
        text = read_bytes(path, max_bytes).decode("utf-8")
    except UnicodeDecodeError as error:
        why = f"not UTF-8 text ({error.reason} at byte {error.start})"
        raise FormatError(f"{path}: cannot be read: {why}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> Any:  # noqa: ANN401
    """Return the content of a JSON file."""
    return parse_json(read_text(path), str(path))


def parse_json(text: str, origin: str) -> Any:  # noqa: ANN401
    """Return the value of a JSON text."""
    try:
        data = json.loads(text)
    except RecursionError as error:
        raise _too_deep(origin) from error
    except ValueError as error:
        raise FormatError(f"{origin}: invalid JSON: {error}") from error
    level = [data]
    for _ in range(MAX_DEPTH):
        level = [
            child
            for value in level
            if isinstance(value, (dict, list))
            for child in (value.values() if isinstance(value, dict) else value)
        ]
        if not level:
            return data
    raise _too_deep(origin)


def require_plain_yaml(text: str | bytes, origin: str) -> None:
    """Require that YAML can be loaded without exhausting the stack or the memory.

    PyYAML's C parser crashes the process on deeply nested brackets, and nested aliases multiply
    ("billion laughs"). Counting the parser's events first needs neither recursion nor expansion.
    """
    sizes: dict[str, int] = {}
    opened: list[tuple[str | None, int]] = []
    count = 0
    for event in yaml.parse(text, Loader=_Loader):
        match event:
            case yaml.CollectionStartEvent():
                opened.append((event.anchor, count))
                count += 1
            case yaml.CollectionEndEvent():
                anchor, before = opened.pop()
                sizes[anchor or ""] = count - before
            case yaml.ScalarEvent():
                sizes[event.anchor or ""] = 1
                count += 1
            case yaml.AliasEvent():
                if any(anchor == event.anchor for anchor, _ in opened):
                    line = event.start_mark.line + 1 if event.start_mark else 1
                    why = "found unconstructable recursive node"
                    raise FormatError(f"{origin}:{line}: invalid YAML: {why}")
                count += sizes.get(event.anchor or "", 1)
        if len(opened) > MAX_DEPTH:
            raise _too_deep(origin)
        if count > MAX_YAML_VALUES:
            raise FormatError(f"{origin}: holds more than {MAX_YAML_VALUES} values")


class _RepeatedKeysLoader(_Loader):  # type: ignore[misc]
    """Safe loader that refuses repeated keys."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        keys: set[str] = set()
        for key in (key for key, _ in node.value if isinstance(key, yaml.ScalarNode)):
            if key.value in keys:
                raise yaml.constructor.ConstructorError(
                    None, None, f"key {key.value!r} is given twice", key.start_mark
                )
            keys.add(key.value)
        mapping: dict[Any, Any] = super().construct_mapping(node, deep)
        return mapping


def parse_yaml(text: str | bytes, origin: str) -> Any:  # noqa: ANN401
    """Return the value of a YAML text, whose mappings may not repeat a key."""
    try:
        require_plain_yaml(text, origin)
        return yaml.load(text, Loader=_RepeatedKeysLoader)
    except yaml.YAMLError as error:
        raise FormatError(f"{origin}{yaml_problem(error)}") from error
    except (ValueError, KeyError) as error:  # such as a date with a thirteenth month
        raise FormatError(f"{origin}: invalid YAML: {' '.join(str(error).split())}") from error


def yaml_problem(error: yaml.YAMLError) -> str:
    """Return what is wrong with YAML, with its location: text to append to the file's name."""
    if not isinstance(error, yaml.MarkedYAMLError):
        return f": invalid YAML: {' '.join(str(error).split())}"
    mark = error.problem_mark
    location = f":{mark.line + 1}:{mark.column + 1}" if mark is not None else ""
    return f"{location}: invalid YAML: {error.problem}"


def _too_deep(origin: str) -> FormatError:
    return FormatError(f"{origin}: is nested deeper than {MAX_DEPTH} levels")

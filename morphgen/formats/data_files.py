"""Read JSON and YAML of strangers: regular files only, bounded in size, depth and expansion."""

from __future__ import annotations

import json
import stat
from pathlib import Path
from typing import Any

import yaml

from morphgen.errors import FormatError

MAX_FILE_BYTES = 64 * 2**20
"""Bytes of the largest data file that is read."""
MAX_DEPTH = 100
"""Levels of lists and objects in the deepest data that is read."""
MAX_YAML_VALUES = 1_000_000
"""Values in the largest YAML file that is read, those of repeated aliases included."""

_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def read_bytes(path: Path, most: int = MAX_FILE_BYTES) -> bytes:
    """Return the content of a regular file.

    Args:
        path: The file; a link to one will do. A pipe or a device is not opened.
        most: Bytes of the largest file to read.

    Raises:
        FormatError: If it is no regular file or larger than that.
        OSError: If it cannot be read.
    """
    status = path.stat()
    if not stat.S_ISREG(status.st_mode):
        raise FormatError(f"{path}: is no regular file")
    if status.st_size > most:
        raise FormatError(f"{path}: holds {status.st_size} bytes; at most {most} are read")
    with path.open("rb") as file:
        data = file.read(most + 1)
    if len(data) > most:
        raise FormatError(f"{path}: holds more than {most} bytes, which is the most that is read")
    return data


def read_text(path: Path, most: int = MAX_FILE_BYTES) -> str:
    """Return the text of a regular UTF-8 file of at most so many bytes, line ends made alike.

    Raises:
        FormatError: As ``read_bytes``, or it is no UTF-8.
        OSError: If it cannot be read.
    """
    try:
        text = read_bytes(path, most).decode("utf-8")
    except UnicodeDecodeError as error:
        why = f"no UTF-8 text ({error.reason} at byte {error.start})"
        raise FormatError(f"{path}: cannot be read: {why}") from error
    return text.replace("\r\n", "\n").replace("\r", "\n")


def read_json(path: Path) -> Any:  # noqa: ANN401
    """Return what a JSON file holds.

    Raises:
        FormatError: As ``read_text``, or it is no JSON.
        OSError: If it cannot be read.
    """
    return parse_json(read_text(path), str(path))


def parse_json(text: str, origin: str) -> Any:  # noqa: ANN401
    """Return what JSON text holds.

    Args:
        text: One JSON value.
        origin: Where it stands, for messages.

    Raises:
        FormatError: If it is no JSON, or deeper than ``MAX_DEPTH``.
    """
    try:
        data = json.loads(text)
    except RecursionError as error:
        raise _too_deep(origin) from error
    except ValueError as error:
        raise FormatError(f"{origin}: no valid JSON: {error}") from error
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
    """Require that YAML can be composed without harm.

    PyYAML's C parser ends the process on brackets nested some thousand deep, and an alias to a list
    of aliases multiplies. So the events are counted first, which need no recursion.

    Args:
        text: One document.
        origin: Where it stands, for messages.

    Raises:
        FormatError: If it is deeper than ``MAX_DEPTH`` or holds more than ``MAX_YAML_VALUES``.
        yaml.YAMLError: If it is no YAML.
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
                    raise FormatError(f"{origin}:{line}: no valid YAML: {why}")
                count += sizes.get(event.anchor or "", 1)
        if len(opened) > MAX_DEPTH:
            raise _too_deep(origin)
        if count > MAX_YAML_VALUES:
            raise FormatError(f"{origin}: holds more than {MAX_YAML_VALUES} values")


def _too_deep(origin: str) -> FormatError:
    return FormatError(f"{origin}: is nested deeper than {MAX_DEPTH} levels")

"""The file of a split: YAML, a robot a line, the same bytes for the same split."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path

import yaml

from morphgen.benchmark.split import FORMAT, Member, Split, split_id
from morphgen.benchmark.split_reader import MEMBER, ROBOT_NAME, SplitFile, parse_split
from morphgen.errors import BenchmarkError, FormatError, nearest
from morphgen.formats.data_files import read_text
from morphgen.formats.files import write_atomic

SUFFIX = ".yaml"
_HEAD = (
    "# Robots to train and to test on, by their derivations; `morphgen split verify` with this\n"
    "# file proves that it is whole and that they are the same robots here.\n"
)
_PLAIN = re.compile(r"[A-Za-z][\w-]*(?:[./][\w-]+)*")
_WORDS = frozenset(("true", "false", "yes", "no", "on", "off", "null", "y", "n"))
_QUOTED = frozenset(("id", "body", "derivation"))
"""Keys whose values are always quoted, as some hashes must be."""
_SPLIT_NAME = re.compile(r"[A-Za-z0-9][\w.-]*(?:/[A-Za-z0-9][\w.-]*)*")


def split_names() -> list[str]:
    """Names of the splits that come with morphgen, sorted."""
    root = _shipped()
    return sorted(
        path.relative_to(root).with_suffix("").as_posix() for path in root.rglob(f"*{SUFFIX}")
    )


def find_split(name_or_path: str | Path, folders: Iterable[Path] = ()) -> Path:
    """The file of a split.

    Args:
        name_or_path: A file, or the name of a split in a folder or of morphgen's own.
        folders: Where a name is looked for first, as ``<folder>/<name>.yaml``.

    Raises:
        BenchmarkError: If there is none.
    """
    name = str(name_or_path)
    path = Path(name)
    if path.suffix == SUFFIX or path.is_file():
        if not path.is_file():
            raise BenchmarkError(f"{path}: no such file")
        return path
    if _SPLIT_NAME.fullmatch(name):
        for folder in (*folders, _shipped()):
            found = folder / f"{name}{SUFFIX}"
            if found.is_file():
                return found
    raise BenchmarkError(
        f"{name}: no such file, and no split of this name{nearest(name, split_names())}"
    )


def read_split(name_or_path: str | Path, folders: Iterable[Path] = ()) -> Split:
    """Read a split, by its name or file; see ``find_split``.

    Raises:
        BenchmarkError: If there is none, the file is malformed, or its robots are not those that
            it was written with.
    """
    read = read_split_file(find_split(name_or_path, folders))
    if not read.is_whole:
        raise BenchmarkError(
            f"{read.path}:{read.id_line}: id: {read.id} is not that of its robots, which is "
            f"{split_id(read.split)}; the file was changed since it was written (if on purpose, "
            "write the new id)"
        )
    return read.split


def read_split_file(path: Path) -> SplitFile:
    """Read a file, whether or not its id is that of its robots.

    Raises:
        BenchmarkError: If it cannot be read or is malformed.
    """
    try:
        text = read_text(path)
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error.strerror}") from error
    return parse_split(text, path)


def write_split(split: Split, path: Path) -> None:
    """Write a split's file, by way of a temporary one; its folder is made.

    Raises:
        BenchmarkError: If it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, split_text(split))
    except OSError as error:
        raise BenchmarkError(f"cannot write {path}: {error.strerror}") from error


def split_text(split: Split) -> str:
    """A split as the text of its file.

    Raises:
        BenchmarkError: If its name or that of a robot is none.
    """
    require_split_name(split.name)
    head: dict[str, object] = {
        "format": FORMAT,
        "morphgen": version("morphgen"),
        "name": split.name,
        "id": split_id(split),
        "regime": split.regime,
        "summary": split.summary,
    }
    if split.reference:
        head["reference"] = split.reference
    lines = [f"{_pair(key, value)}\n" for key, value in head.items()]
    blocks = {"made": split.made, "accepted": split.accepted, "statistics": split.statistics}
    lines += [_block(key, value) for key, value in blocks.items() if value]
    for side, members in (("train", split.train), ("test", split.test)):
        lines += [f"{side}:\n", *map(_member_line, members)]
    return _HEAD + "".join(lines)


def require_split_name(name: str) -> None:
    """Require that a name can be a file's.

    Raises:
        BenchmarkError: If it cannot.
    """
    if not _SPLIT_NAME.fullmatch(name):
        raise BenchmarkError(
            f"name {name!r}: use letters, digits, '-', '_' and '.', in words parted by '/'"
        )


def _shipped() -> Path:
    return Path(str(files("morphgen.benchmark"))) / "splits"


def _block(key: str, value: Mapping[str, object]) -> str:
    text: str = yaml.safe_dump(
        {key: _plain_data(value)},
        sort_keys=False,
        allow_unicode=True,
        width=10_000,
        default_flow_style=False if key == "accepted" else None,
    )
    return text


def _plain_data(value: object) -> object:
    """Mappings and sequences of any kind as those that YAML knows."""
    if isinstance(value, Mapping):
        return {str(key): _plain_data(each) for key, each in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain_data(each) for each in value]
    return value


def _member_line(member: Member) -> str:
    if not ROBOT_NAME.fullmatch(member.name):
        raise BenchmarkError(f"robot name {member.name!r}: use letters, digits, '-', '_' and '.'")
    values = ", ".join(_pair(key, getattr(member, key)) for key in MEMBER)
    return f"- {{{values}}}\n"


def _pair(key: str, value: object) -> str:
    """Text bare where every reader of YAML takes it for text, else as JSON writes it."""
    plain = isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _WORDS
    return (
        f"{key}: {value if plain and key not in _QUOTED else json.dumps(value, ensure_ascii=False)}"
    )

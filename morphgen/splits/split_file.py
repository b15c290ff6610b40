"""Read and write split files: YAML with one line per robot, the same bytes for the same split."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import yaml
from msgspec import Meta

from morphgen.encoding.robot_hash import HASH_LENGTH
from morphgen.errors import BenchmarkError, nearest
from morphgen.files import write_atomic
from morphgen.formats.data_files import parse_yaml, read_text
from morphgen.formats.files import writing
from morphgen.formats.records import Record, read_record
from morphgen.splits.split import FORMAT, SIDES, Member, Regime, Split, split_id

MEMBER = ("name", "category", "task", "obstacles", "body", "derivation")
"""Keys of a robot, in order."""
ROBOT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}")
_ROBOT_RULE = "use letters, digits, '-', '_', '+' and '.'"
TASK_NAME = re.compile(r"[a-z][a-z0-9_-]*")
_BODY = re.compile(rf"[0-9a-f]{{{HASH_LENGTH}}}")
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
_NAME_RULE = "use letters, digits, '-', '_' and '.', in words parted by '/'"
_Text = Annotated[str, Meta(min_length=1)]


class MemberRecord(Record, frozen=True):
    """An entry of ``train`` or ``test``."""

    name: _Text
    category: _Text
    derivation: _Text
    task: _Text
    obstacles: bool
    robot_hash: _Text = msgspec.field(name="body")

    def __post_init__(self) -> None:
        if not ROBOT_NAME.fullmatch(self.name):
            raise ValueError(f"name: {self.name!r}: {_ROBOT_RULE}")
        if not TASK_NAME.fullmatch(self.task):
            rule = "expected a name of lower-case letters, digits, '-' and '_'"
            raise ValueError(f"task: {self.task!r}: {rule}")
        if not _BODY.fullmatch(self.robot_hash):
            raise ValueError(
                f"body: {self.robot_hash!r} is no hash of {HASH_LENGTH} hexadecimal digits"
            )


class _Content(Record, frozen=True):
    """The content of a split file under its keys."""

    format: Literal[1]
    version: _Text = msgspec.field(name="morphgen")
    name: _Text
    id: _Text
    regime: Regime
    summary: _Text
    train: Annotated[tuple[MemberRecord, ...], Meta(min_length=1)]
    test: Annotated[tuple[MemberRecord, ...], Meta(min_length=1)]
    provenance: dict[str, Any] = msgspec.field(name="made", default_factory=dict)
    accepted: dict[str, _Text] = msgspec.field(default_factory=dict)
    reference: str = ""
    statistics: dict[str, Any] = msgspec.field(default_factory=dict)

    def __post_init__(self) -> None:
        if not is_split_name(self.name):
            raise ValueError(f"name: {self.name!r}: {_NAME_RULE}")
        for side, robots in (("train", self.train), ("test", self.test)):
            for name, count in Counter(robot.name for robot in robots).items():
                if count > 1:
                    raise ValueError(f"{side}: {count} robots are named {name!r}")


@dataclass(frozen=True)
class SplitFile:
    """The content of a split file; its id may be wrong."""

    split: Split
    id: str  # id of the split when it was written


def parse_split(text: str, path: Path) -> SplitFile:
    """Parse the text of a split file."""
    data = parse_yaml(text, str(path))
    if not isinstance(data, dict):
        raise BenchmarkError(
            f"{path}: no split: expected 'format: {FORMAT}', 'name: ...' and so on"
        )
    content = read_record(data, _Content, str(path), BenchmarkError, yaml_text=text)
    fields: dict[str, Any] = msgspec.structs.asdict(content)
    for side in SIDES:
        robots = map(msgspec.structs.asdict, fields[side])
        fields[side] = tuple(Member(**robot) for robot in robots)
    del fields["format"], fields["id"]
    return SplitFile(Split(**fields), content.id)


def split_names() -> list[str]:
    """Return the names of the splits that are shipped with morphgen, sorted."""
    root = _shipped()
    return sorted(
        path.relative_to(root).with_suffix("").as_posix() for path in root.rglob(f"*{SUFFIX}")
    )


def find_split(name_or_path: str | Path) -> Path:
    """Return the path of a split file."""
    name = str(name_or_path)
    path = Path(name)
    if path.suffix == SUFFIX or path.is_file():
        if not path.is_file():
            raise BenchmarkError(f"{path}: no such file")
        return path
    shipped = _shipped() / f"{name}{SUFFIX}"
    if is_split_name(name) and shipped.is_file():
        return shipped
    raise BenchmarkError(
        f"{name}: no such file, and no split of this name{nearest(name, split_names())}"
    )


def read_split(name_or_path: str | Path) -> Split:
    """Read a split by its name or file; see ``find_split``."""
    path = find_split(name_or_path)
    stored = read_split_file(path)
    computed = split_id(stored.split)
    if stored.id != computed:
        raise BenchmarkError(
            f"{path}: id: {stored.id} is not that of its robots, which is {computed}; the file was "
            "changed since it was written (if on purpose, write the new id)"
        )
    return stored.split


def read_split_file(path: Path) -> SplitFile:
    """Read a split file without checking its id."""
    return parse_split(read_text(path), path)


def write_split(split: Split, path: Path) -> None:
    """Write a split file through a temporary file; the folder is created if needed."""
    with writing(path, BenchmarkError):
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, split_text(split))


def split_text(split: Split) -> str:
    """Return the text of a split file."""
    require_split_name(split.name)
    head: dict[str, object] = {
        "format": FORMAT,
        "morphgen": split.version,
        "name": split.name,
        "id": split_id(split),
        "regime": split.regime,
        "summary": split.summary,
    }
    if split.reference:
        head["reference"] = split.reference
    lines = [f"{_pair(key, value)}\n" for key, value in head.items()]
    blocks = {"made": split.provenance, "accepted": split.accepted, "statistics": split.statistics}
    lines += [_block(key, value) for key, value in blocks.items() if value]
    for side, members in (("train", split.train), ("test", split.test)):
        lines += [f"{side}:\n", *map(_member_line, members)]
    return _HEAD + "".join(lines)


def require_split_name(name: str) -> None:
    """Check that the name of a split can be a file's name."""
    if not is_split_name(name):
        raise BenchmarkError(f"name {name!r}: {_NAME_RULE}")


def is_split_name(name: str) -> bool:
    """Return whether a text can be the name of a split: also the path of a file in a folder."""
    return bool(_SPLIT_NAME.fullmatch(name))


def _shipped() -> Path:
    return Path(str(files("morphgen.splits")))


def _block(key: str, value: Mapping[str, object]) -> str:
    text: str = yaml.safe_dump(
        {key: msgspec.to_builtins(dict(value))},  # YAML writes tuples as lists
        sort_keys=False,
        allow_unicode=True,
        width=10_000,
        default_flow_style=False if key == "accepted" else None,
    )
    return text


def _member_line(member: Member) -> str:
    if not ROBOT_NAME.fullmatch(member.name):
        raise BenchmarkError(f"robot name {member.name!r}: {_ROBOT_RULE}")
    values = ", ".join(
        _pair(key, member.robot_hash if key == "body" else getattr(member, key)) for key in MEMBER
    )
    return f"- {{{values}}}\n"


def _pair(key: str, value: object) -> str:
    """Return ``key: value``; text is quoted if a YAML reader could take it for another type."""
    plain = isinstance(value, str) and _PLAIN.fullmatch(value) and value.lower() not in _WORDS
    return (
        f"{key}: {value if plain and key not in _QUOTED else json.dumps(value, ensure_ascii=False)}"
    )


_VERSION = re.compile(r"(?m)^morphgen: .*\n")


def split_paths(out: Path, splits: Sequence[Split]) -> list[Path]:
    """Return the path of each split's file."""
    if out.suffix != SUFFIX:
        return [out / f"{split.name}{SUFFIX}" for split in splits]
    if len(splits) == 1:
        return [out]
    return [out.with_stem(f"{out.stem}-train{split.provenance['train']}") for split in splits]


def write_new_splits(splits: Sequence[Split], paths: Sequence[Path]) -> None:
    """Write all files, or none if one exists with another content, apart from versions."""
    missing = []
    for split, path in zip(splits, paths, strict=True):
        if not path.is_file():
            missing.append((split, path))
        elif _without_version(path.read_bytes()) != _without_version(split_text(split).encode()):
            raise BenchmarkError(f"{path} exists with another content; choose another name or path")
    for split, path in missing:
        write_split(split, path)


def _without_version(content: bytes) -> str:
    return _VERSION.sub("", content.decode("utf-8", "replace"), count=1)

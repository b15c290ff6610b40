"""Read and write split files: YAML with one line per robot, the same bytes for the same split."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any, cast

import yaml
from yaml.nodes import MappingNode, Node, SequenceNode

from morphgen.benchmark.robot_hash import HASH_LENGTH
from morphgen.benchmark.split import FORMAT, REGIMES, Member, Regime, Split, split_id
from morphgen.errors import BenchmarkError, FormatError, nearest
from morphgen.formats.data_files import read_text, require_plain_yaml
from morphgen.formats.files import write_atomic

FIELDS = (
    "format",
    "morphgen",
    "name",
    "id",
    "regime",
    "summary",
    "reference",
    "made",
    "accepted",
    "statistics",
    "train",
    "test",
)
"""Keys of the file, in order."""
OPTIONAL = ("reference", "made", "accepted", "statistics")
MEMBER = ("name", "category", "task", "obstacles", "body", "derivation")
"""Keys of a robot, in order."""
ROBOT_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._+-]{0,199}")
_ROBOT_RULE = "use letters, digits, '-', '_', '+' and '.'"
TASK_NAME = re.compile(r"[a-z][a-z0-9_-]*")
_BODY = re.compile(rf"[0-9a-f]{{{HASH_LENGTH}}}")
_Loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
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


@dataclass(frozen=True)
class SplitFile:
    """The content of a split file; its id may be wrong."""

    path: Path
    split: Split
    id: str
    """Id of the split when it was written."""
    id_line: int
    """Line of the id in the file."""

    @property
    def is_whole(self) -> bool:
        """True if the id matches the robots: the file was not changed since it was written."""
        return self.id == split_id(self.split)


def parse_split(text: str, path: Path) -> SplitFile:
    """Parse the text of a split file."""
    try:
        require_plain_yaml(text, str(path))
        loader = _Loader(text)
        try:
            return _Reader(path, loader).file(loader.get_single_node())
        finally:
            loader.dispose()
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    except yaml.MarkedYAMLError as error:
        raise BenchmarkError(f"{path}{_yaml_problem(error)}") from error
    except yaml.YAMLError as error:
        raise BenchmarkError(f"{path}: invalid YAML: {error}") from error


def _yaml_problem(error: yaml.MarkedYAMLError) -> str:
    """Return line and problem of a YAML error, and the line where its context begins."""
    mark = error.problem_mark or error.context_mark
    line = f":{mark.line + 1}" if mark else ""
    began = error.context_mark.line + 1 if error.context and error.context_mark else 0
    context = f" ({error.context} from line {began})" if began else ""
    return f"{line}: invalid YAML: {error.problem}{context}"


class _Reader:
    """Convert YAML nodes, which know their lines, to a split."""

    def __init__(self, path: Path, loader: Any) -> None:  # noqa: ANN401
        self._path, self._loader = path, loader

    def file(self, node: Node | None) -> SplitFile:
        if node is None:
            raise BenchmarkError(f"{self._path}: is empty; expected a split")
        self._require_format(node)
        fields = self._fields(node, FIELDS, "a split", optional=OPTIONAL)
        names = {key: self._text(fields[key], key) for key in ("morphgen", "name", "id", "summary")}
        if not is_split_name(names["name"]):
            raise self._fail(fields["name"], f"name: {names['name']!r}: {_NAME_RULE}")
        split = Split(
            names["name"],
            cast(Regime, self._choice(fields["regime"], "regime", REGIMES)),
            names["summary"],
            self._members(fields["train"], "train"),
            self._members(fields["test"], "test"),
            self._free(fields.get("made"), "made"),
            self._reasons(fields.get("accepted")),
            self._text(fields["reference"], "reference") if "reference" in fields else "",
            self._free(fields.get("statistics"), "statistics"),
            names["morphgen"],
        )
        return SplitFile(self._path, split, names["id"], fields["id"].start_mark.line + 1)

    def _fail(self, node: Node, what: str) -> BenchmarkError:
        return BenchmarkError(f"{self._path}:{node.start_mark.line + 1}: {what}")

    def _require_format(self, node: Node) -> None:
        """Check the version of the format before anything else."""
        if not isinstance(node, MappingNode):
            raise self._fail(node, "no split: expected 'format: 1', 'name: ...' and so on")
        for key, value in node.value:
            if key.value == "format" and self._value(value) != FORMAT:
                raise self._fail(
                    value, f"format: {value.value!r} is not known to this morphgen; valid: {FORMAT}"
                )

    def _fields(
        self, node: Node, known: Sequence[str], what: str, optional: Sequence[str] = ()
    ) -> dict[str, Node]:
        if not isinstance(node, MappingNode):
            raise self._fail(node, f"expected {what} with {', '.join(known)}")
        fields: dict[str, Node] = {}
        for key, value in node.value:
            if key.value not in known:
                raise self._fail(key, f"unknown key {key.value!r}{nearest(str(key.value), known)}")
            if key.value in fields:
                raise self._fail(key, f"key {key.value!r} is there twice")
            fields[key.value] = value
        missing = [key for key in known if key not in fields and key not in optional]
        if missing:
            raise self._fail(node, f"{what} lacks {', '.join(map(repr, missing))}")
        return fields

    def _members(self, node: Node, side: str) -> tuple[Member, ...]:
        if not isinstance(node, SequenceNode) or not node.value:
            raise self._fail(node, f"{side}: expected a list of robots, one at least")
        members: dict[str, Member] = {}
        for entry in node.value:
            member = self._member(entry, side)
            if member.name in members:
                raise self._fail(entry, f"{side}: two robots are named {member.name!r}")
            members[member.name] = member
        return tuple(members.values())

    def _member(self, node: Node, side: str) -> Member:
        fields = self._fields(node, MEMBER, f"a robot of {side}")
        name = self._text(fields["name"], "name")
        if not ROBOT_NAME.fullmatch(name):
            raise self._fail(fields["name"], f"name: {name!r}: {_ROBOT_RULE}")
        body = self._text(fields["body"], "body")
        if not _BODY.fullmatch(body):
            raise self._fail(
                fields["body"], f"body: {body!r} is no hash of {HASH_LENGTH} hexadecimal digits"
            )
        task = self._text(fields["task"], "task")
        if not TASK_NAME.fullmatch(task):
            raise self._fail(
                fields["task"],
                f"task: {task!r}: expected a name of lower-case letters, digits, '-' and '_'",
            )
        obstacles = self._value(fields["obstacles"])
        if not isinstance(obstacles, bool):
            raise self._fail(fields["obstacles"], f"obstacles: {obstacles!r}; valid: false, true")
        return Member(
            name,
            self._text(fields["category"], "category"),
            self._text(fields["derivation"], "derivation"),
            task,
            obstacles,
            body,
        )

    def _text(self, node: Node, key: str) -> str:
        value = self._value(node)
        if not isinstance(value, str) or not value:
            raise self._fail(node, f"{key}: expected text, not {value!r}")
        return value

    def _choice(self, node: Node, key: str, valid: Sequence[str]) -> str:
        value = self._text(node, key)
        if value not in valid:
            raise self._fail(node, f"{key}: unknown {value!r}{nearest(value, valid)}")
        return value

    def _free(self, node: Node | None, key: str) -> dict[str, object]:
        """Return the keys and values of a mapping whose content is not checked."""
        if node is None:
            return {}
        if not isinstance(node, MappingNode):
            raise self._fail(node, f"{key}: expected keys and values")
        return {str(key.value): self._value(value) for key, value in node.value}

    def _reasons(self, node: Node | None) -> dict[str, str]:
        if node is None:
            return {}
        if not isinstance(node, MappingNode):
            raise self._fail(node, "accepted: expected a reason for every code of a finding")
        return {
            str(key.value): self._text(value, f"accepted {key.value}") for key, value in node.value
        }

    def _value(self, node: Node) -> object:
        if node.tag == "tag:yaml.org,2002:str":
            return node.value
        try:
            return self._loader.construct_object(node, deep=True)
        except (ValueError, KeyError) as error:  # such as a date with a thirteenth month
            raise self._fail(node, f"{node.value!r:.60}: no valid {node.tag[18:]}") from error


def split_names() -> list[str]:
    """Return the names of the splits that are shipped with morphgen, sorted."""
    root = _shipped()
    return sorted(
        path.relative_to(root).with_suffix("").as_posix() for path in root.rglob(f"*{SUFFIX}")
    )


def find_split(name_or_path: str | Path, folders: Iterable[Path] = ()) -> Path:
    """Return the path of a split file."""
    name = str(name_or_path)
    path = Path(name)
    if path.suffix == SUFFIX or path.is_file():
        if not path.is_file():
            raise BenchmarkError(f"{path}: no such file")
        return path
    if is_split_name(name):
        for folder in (*folders, _shipped()):
            candidate = folder / f"{name}{SUFFIX}"
            if candidate.is_file():
                return candidate
    raise BenchmarkError(
        f"{name}: no such file, and no split of this name{nearest(name, split_names())}"
    )


def read_split(name_or_path: str | Path, folders: Iterable[Path] = ()) -> Split:
    """Read a split by its name or file; see ``find_split``."""
    stored = read_split_file(find_split(name_or_path, folders))
    if not stored.is_whole:
        raise BenchmarkError(
            f"{stored.path}:{stored.id_line}: id: {stored.id} is not that of its robots, which is "
            f"{split_id(stored.split)}; the file was changed since it was written (if on purpose, "
            "write the new id)"
        )
    return stored.split


def read_split_file(path: Path) -> SplitFile:
    """Read a split file without checking its id."""
    try:
        text = read_text(path)
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    return parse_split(text, path)


def write_split(split: Split, path: Path) -> None:
    """Write a split file through a temporary file; the folder is created if needed."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(path, split_text(split))
    except OSError as error:
        raise BenchmarkError(f"cannot write {path}: {error.strerror}") from error


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
    """Convert mappings and sequences of any type to dictionaries and lists."""
    if isinstance(value, Mapping):
        return {str(key): _plain_data(entry) for key, entry in value.items()}
    if isinstance(value, Sequence) and not isinstance(value, str):
        return [_plain_data(entry) for entry in value]
    return value


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
    """Write all files, or none if one of them exists with another content.

    A file of the same content that another version of morphgen wrote is kept.
    """
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

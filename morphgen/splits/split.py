"""A split: the robots and tasks to train on, and those to test on; its file; and its candidates.

A split contains the derivation of each robot instead of a file, so any machine can rebuild it. The
hash of each robot proves that the result is the same. A split's file is YAML with one line per
robot, the same bytes for the same split.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import yaml
from msgspec import Meta

from morphgen.checks import check
from morphgen.encoding.robot_hash import HASH_LENGTH, digest, robot_hash
from morphgen.encoding.similarity import Features, features
from morphgen.encoding.tokens import LARGEST_MAX_LINKS, MAX_LINKS, require_max_links
from morphgen.errors import BenchmarkError, nearest
from morphgen.files import write_atomic
from morphgen.fitting.token_shapes import token_shapes
from morphgen.formats.data_files import parse_yaml, read_text
from morphgen.formats.files import writing
from morphgen.formats.records import Record, read_record
from morphgen.grammar.compose import compose, join
from morphgen.grammar.grammar_file import Grammar, grammar_names
from morphgen.grammar.library import Library
from morphgen.grammar.request import parse_words
from morphgen.grammar.sampling import sample_robot
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.robot import Robot

Regime = Literal["interpolation", "composition", "extrapolation", "hold-out"]
REGIMES: tuple[Regime, ...] = ("interpolation", "composition", "extrapolation", "hold-out")
HOLD_OUT: Regime = "hold-out"
"""Regime of splits whose test robots have what ``provenance`` says is held out."""
Side = Literal["train", "test"]
SIDES: tuple[Side, ...] = ("train", "test")

FORMAT = 1
COMPOSED = "composed"  # category of a robot that was not sampled from a grammar
MAX_LINKS_KEY = "max_links"
"""Key in ``provenance`` of the largest number of links, if it is not the paper's."""
HOLD_OUT_KEY = "hold_out"
"""Key in ``provenance`` of the rules that say what is held out, see ``hold_out``."""


@dataclass(frozen=True)
class Member:
    """A robot of a split and its task."""

    name: str  # name of the robot, unique on each side of the split
    category: str  # grammar that the robot was sampled from, or `composed`
    derivation: str  # parts and parameters of the robot, see `morphgen.grammar.syntax`
    task: str  # name of the task; the tasks package knows which tasks exist
    obstacles: bool  # the scene has obstacles
    robot_hash: str
    """Hash of the composed robot, see ``morphgen.encoding.robot_hash``; ``body`` in files."""

    def as_dict(self) -> dict[str, object]:
        """Return the member under the keys of the file, for JSON."""
        data = asdict(self)
        return {"body" if key == "robot_hash" else key: data[key] for key in data}


def require_side(side: str) -> None:
    """Require a side of a split."""
    if side not in SIDES:
        raise BenchmarkError(f"unknown side {side!r}{nearest(str(side), SIDES)}")


@dataclass(frozen=True)
class Split:
    """Train and test robots, with the history of the split."""

    name: str  # name, such as `extrapolation/arms/reach`
    regime: Regime
    summary: str
    train: tuple[Member, ...]
    test: tuple[Member, ...]
    provenance: Mapping[str, object] = field(default_factory=dict)
    """Arguments and seed of the generator that chose the robots; ``made`` in files."""
    accepted: Mapping[str, str] = field(default_factory=dict)
    """Findings of the audit that the author accepts: reasons by code."""
    reference: str = ""  # source of the split, such as a table of a paper
    statistics: Mapping[str, object] = field(default_factory=dict)
    """Statistics of the robots, for readers; nothing depends on them."""
    version: str = field(default_factory=lambda: version("morphgen"), compare=False)
    """Version of morphgen that made the split, which its files and runs keep; ``morphgen`` in
    files."""

    @property
    def max_links(self) -> int:
        """Largest number of links of a robot, which scales link indices in tokens."""
        max_links = self.provenance.get(MAX_LINKS_KEY, MAX_LINKS)
        if type(max_links) is not int or not 2 <= max_links <= LARGEST_MAX_LINKS:
            raise BenchmarkError(
                f"split {self.name!r}: made: {MAX_LINKS_KEY}: {max_links!r}; expected a whole "
                f"number from 2 to {LARGEST_MAX_LINKS}"
            )
        return max_links

    def side(self, side: Side) -> tuple[Member, ...]:
        """Return the members of a side."""
        require_side(side)
        return self.train if side == "train" else self.test

    def as_dict(self) -> dict[str, object]:
        """Return the split under the keys of the file, for JSON."""
        names = {"provenance": "made", "version": "morphgen"}
        data = {names.get(key, key): value for key, value in vars(self).items()}
        return data | {side: [member.as_dict() for member in self.side(side)] for side in SIDES}


def split_id(split: Split) -> str:
    """Return a hash of the regime and of the members of each side in order: 32 hex digits.

    It covers ``max_links`` where a split names it: the tokens of its robots depend on it.
    """
    sides = [[list(member.as_dict().values()) for member in split.side(side)] for side in SIDES]
    links = [split.max_links] if MAX_LINKS_KEY in split.provenance else []
    return digest([split.regime, *sides, *links])


def compose_side(split: Split, side: Side, library: Library) -> Iterator[Robot]:
    """Compose the robots of a side one after another; see ``compose_member``."""
    for member in split.side(side):
        yield compose_member(member, library)


def compose_member(member: Member, library: Library) -> Robot:
    """Compose the robot of a member."""
    derivation = parse_derivation(member.derivation, f"derivation of {member.name!r}")
    robot = compose(derivation, library, member.name)
    composed_hash = robot_hash(robot)
    if composed_hash != member.robot_hash:
        raise BenchmarkError(
            f"robot {member.name!r}: the split was made with body {member.robot_hash}, but its "
            f"derivation gives {composed_hash}: a part, or morphgen, has changed since"
        )
    return robot


def sided_members(split: Split) -> list[tuple[Side, Member]]:
    """Return every member with its side, the train robots first: the order of all files."""
    return [(side, member) for side in SIDES for member in split.side(side)]


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


@dataclass(frozen=True)
class SampledRecipe:
    """A robot sampled from a grammar: robot ``number`` of ``morphgen sample --seed``."""

    grammar: Grammar
    number: int
    seed: int
    name: str

    @property
    def category(self) -> str:
        """Name of the grammar."""
        return self.grammar.name


@dataclass(frozen=True)
class DerivedRecipe:
    """A robot given by its derivation."""

    derivation: Derivation
    name: str
    category: str = COMPOSED


Recipe = SampledRecipe | DerivedRecipe


def recipe_of(words: Sequence[str], library: Library) -> DerivedRecipe:
    """Return the recipe for the arguments of ``morphgen compose``, which also give a name."""
    derivation, name = parse_words(words, library)
    # The category is the grammar that the arguments begin with, if they are no parts.
    is_request = "=" in words[0] or (words[0] in library.paths and words[0] not in grammar_names())
    category = COMPOSED if is_request else words[0].rpartition("/")[2].removesuffix(".grammar")
    return DerivedRecipe(derivation, name, category)


class UnfitRobotError(BenchmarkError):
    """A robot can be composed, but cannot be a member of a split."""

    def __init__(self, message: str, reason: str) -> None:
        """Create the error from its message and a reason that is the same for similar robots."""
        super().__init__(message, reason)
        self.reason = reason

    def __str__(self) -> str:
        """Return the message."""
        return str(self.args[0])


@dataclass(frozen=True, eq=False)
class Candidate:
    """A robot that may become a member of a split."""

    name: str
    category: str
    derivation: Derivation
    hash: str  # hash of the robot, see `robot_hash`
    features: Features | None = None
    """Features for similarity measures; None if the factory does not compute them."""

    def member(self, task: str, tasks: Sequence[str], obstacles: bool) -> Member:
        """Return the member of a split with these tasks; of several, its name ends in its own."""
        return Member(
            self.name if len(tasks) == 1 else f"{self.name}-{task}",
            self.category,
            str(self.derivation),
            task,
            obstacles,
            self.hash,
        )


@dataclass(frozen=True)
class RobotFactory:
    """Make candidates from recipes; can be pickled and sent to a worker process."""

    library: Library
    with_features: bool = False  # compute the features of each robot
    max_links: int = MAX_LINKS  # largest number of links of a robot

    def __call__(self, recipe: Recipe) -> Candidate:
        """Make a robot."""
        if isinstance(recipe, SampledRecipe):
            sample = sample_robot(
                recipe.grammar, self.library, recipe.number, seed=recipe.seed, name=recipe.name
            )
            return self._candidate(sample.robot, sample.derivation, recipe.category)
        # Joining parts is fast, and the search for contacts of a composed robot is not.
        self._require_links(join(recipe.derivation, self.library, recipe.name))
        robot = compose(recipe.derivation, self.library, recipe.name)
        for finding in check(robot):
            if finding.severity == "error":
                text = f"{recipe.name}: {finding.code} at {finding.where}: {finding.why}"
                raise UnfitRobotError(text, f"an error of morphgen check: {finding.code}")
        return self._candidate(robot, recipe.derivation, recipe.category)

    def _require_links(self, robot: Robot) -> None:
        try:
            require_max_links(len(robot.links), f"robot {robot.name!r}", self.max_links)
        except BenchmarkError as error:
            raise UnfitRobotError(str(error), f"more than {self.max_links} links") from error

    def _candidate(self, robot: Robot, derivation: Derivation, category: str) -> Candidate:
        # The text of a derivation has 12 digits per number. A split stores the text, so the robot
        # must be the one that the text gives.
        written = parse_derivation(str(derivation))
        if written != derivation:
            robot = compose(written, self.library, robot.name)
        self._require_links(robot)
        robot_features = None
        if self.with_features:
            shapes = token_shapes(robot, self.library.folders)
            robot_features = features(robot, shapes, max_links=self.max_links)
        return Candidate(robot.name, category, written, robot_hash(robot), robot_features)


def numbered_name(prefix: str, number: int) -> str:
    """Return the name of a sampled robot, such as ``arm3-000004``."""
    return f"{prefix}-{number:06d}"

"""A split: the robots and tasks to train on, and those to test on.

A split contains the derivation of each robot instead of a file, so any machine can rebuild it. The
hash of each robot proves that the result is the same. ``split_file`` reads and writes splits.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from importlib.metadata import version
from typing import Literal

from morphgen.encoding.robot_hash import digest, robot_hash
from morphgen.encoding.tokens import LARGEST_MAX_LINKS, MAX_LINKS
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.compose import compose
from morphgen.grammar.library import Library
from morphgen.grammar.syntax import parse_derivation
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

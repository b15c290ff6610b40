"""A split: which robots are trained on, which tested on, at which task.

Robots are given by their derivations, never by a file, so any machine rebuilds them; the hash of
each body tells that it is the same. ``morphgen.benchmark.split_file`` has the file.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from typing import Literal

from morphgen.benchmark.robot_hash import digest, robot_hash
from morphgen.benchmark.token_layout import MAX_LINKS
from morphgen.errors import BenchmarkError
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.model.robot import (
    Robot,
)

Regime = Literal["interpolation", "composition", "extrapolation"]
REGIMES: tuple[Regime, ...] = ("interpolation", "composition", "extrapolation")
Side = Literal["train", "test"]
SIDES: tuple[Side, ...] = ("train", "test")

FORMAT = 1
COMPOSED = "composed"
"""Category of a robot that was drawn from no grammar."""
MAX_LINKS_KEY = "max_links"
"""Key in ``made`` of the most links of a robot, if they are not the paper's."""


@dataclass(frozen=True)
class Member:
    """A robot of a split, and what it does there."""

    name: str
    """Unique within the split, and the name of the robot."""
    category: str
    """The grammar that it was drawn from, or ``composed``."""
    derivation: str
    """Parts and parameters, see ``morphgen.grammar.derivation``."""
    task: str
    """Name of a task; whoever makes environments of the split knows which there are."""
    obstacles: bool
    robot_hash: str
    """Hash of the composed robot, see ``morphgen.benchmark.robot_hash``; ``body`` in files."""

    def as_dict(self) -> dict[str, object]:
        """Return the member under the keys of the file, for JSON."""
        data = asdict(self)
        return {"body" if key == "robot_hash" else key: data[key] for key in data}


@dataclass(frozen=True)
class Split:
    """Robots to train and to test on."""

    name: str
    """Such as ``extrapolation/arms/reach``."""
    regime: Regime
    summary: str
    train: tuple[Member, ...]
    test: tuple[Member, ...]
    provenance: Mapping[str, object] = field(default_factory=dict)
    """How the robots were chosen: arguments and seed of the generator."""
    accepted: Mapping[str, str] = field(default_factory=dict)
    """Findings of the audit that the author knows of: reason by code."""
    reference: str = ""
    """Where the split comes from, such as a paper's table."""
    statistics: Mapping[str, object] = field(default_factory=dict)
    """Figures about its robots, for readers; nothing depends on them."""

    @property
    def max_links(self) -> int:
        """The most links that a robot may have, by which indices of tokens are scaled.

        Raises:
            BenchmarkError: If the split was made with another than a whole number from 2 on.
        """
        given = self.provenance.get(MAX_LINKS_KEY, MAX_LINKS)
        if type(given) is not int or given < 2:
            raise BenchmarkError(
                f"split {self.name!r}: made: {MAX_LINKS_KEY}: {given!r}; expected a whole number, "
                "2 or more"
            )
        return given

    def side(self, side: Side) -> tuple[Member, ...]:
        """The members of a side."""
        return self.train if side == "train" else self.test

    def as_dict(self) -> dict[str, object]:
        """Return the split under the keys of the file, for JSON."""
        data = {"made" if key == "provenance" else key: value for key, value in vars(self).items()}
        return data | {side: [member.as_dict() for member in self.side(side)] for side in SIDES}


def split_id(split: Split) -> str:
    """A hash of what matters: the regime, and each side's members in order; 32 hex digits."""
    sides = [[list(member.as_dict().values()) for member in split.side(side)] for side in SIDES]
    return digest([split.regime, *sides])


def compose_side(split: Split, side: Side, library: Library) -> Iterator[Robot]:
    """The robots of a side in order, each composed when asked for; see ``member_robot``."""
    for member in split.side(side):
        yield compose_member(member, library)


def compose_member(member: Member, library: Library) -> Robot:
    """Compose the robot of a member.

    Raises:
        BenchmarkError: If its body is not the one that the split was made with.
        GrammarError: If its derivation is none.
        CompositionError: If its parts do not fit any more.
        PartError: If the library lacks a part, or a parameter of it.
        FormatError: If a part's source cannot be read.
    """
    derivation = parse_derivation(member.derivation, f"derivation of {member.name!r}")
    robot = compose(derivation, library, member.name)
    body = robot_hash(robot)
    if body != member.robot_hash:
        raise BenchmarkError(
            f"robot {member.name!r}: the split was made with body {member.robot_hash}, but its "
            f"derivation gives {body}: a part, or morphgen, has changed since"
        )
    return robot


def sided_members(split: Split) -> list[tuple[Side, Member]]:
    """Return every member with its side, the train robots first: the order of all files."""
    return [(side, member) for side in SIDES for member in split.side(side)]

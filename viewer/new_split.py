"""A new split of robots that are seen in a gallery."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.benchmark.robot_hash import robot_hash
from morphgen.benchmark.split import COMPOSED, Member, Regime, Split
from morphgen.benchmark.split_file import require_split_name, write_split
from morphgen.errors import BenchmarkError
from morphgen.grammar.compose import compose
from morphgen.grammar.derivation import parse_derivation
from morphgen.viewer.robot_uri import (
    MEMBER,
    FileAccess,
    read_robot_uri,
    resolve_derivation,
    resolve_member,
    shortened,
)

SPLITS = "splits"
"""Folder below which they are written."""
LONGEST_NAME = 200
"""Characters of a split's name."""


def member_of(place: str, category: str, task: str, obstacles: bool, places: FileAccess) -> Member:
    """The robot at a place as a member of a split.

    Raises:
        BenchmarkError: If it does not say how it was derived.
        MorphgenError: If it cannot be composed.
    """
    if place.startswith(MEMBER):
        return replace(resolve_member(place, places), task=task, obstacles=obstacles)
    robot = read_robot_uri(place, places)
    derivation = str(resolve_derivation(place, places) or robot.provenance.get("derivation", ""))
    if not derivation:
        raise BenchmarkError(f"{place} was imported: a split names robots by their derivations")
    composed = compose(parse_derivation(derivation), places.library, robot.name)
    return Member(
        robot.name, category or COMPOSED, derivation, task, obstacles, robot_hash(composed)
    )


def save_split(
    name: str, regime: Regime, train: Sequence[Member], test: Sequence[Member], places: FileAccess
) -> Path:
    """Write the file of a split below the folder where the viewer was started.

    Raises:
        BenchmarkError: If its name is none, a side is empty, the file is there already, or it
            cannot be written.
    """
    require_split_name(name)
    if not train or not test:
        raise BenchmarkError(
            f"{len(train)} train and {len(test)} test robots: one at least of each"
        )
    if len(name) > LONGEST_NAME:
        raise BenchmarkError(f"name {shortened(name)!r}: at most {LONGEST_NAME} characters")
    path = places.roots[0] / SPLITS / f"{name}.yaml"
    if path.exists():
        raise BenchmarkError(f"{path} exists; choose another name")
    summary = f"{len(train)} robots to train on, {len(test)} to test on, chosen in the viewer"
    write_split(Split(name, regime, summary, tuple(train), tuple(test)), path)
    return path

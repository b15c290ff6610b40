"""Rows of a gallery: facts about robots, and how they are filtered, sorted and paged."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

T = TypeVar("T")

PAGE_SIZES = (24, 48, 96)
SORTS = ("order", "name", "category", "dof", "links", "reach", "mass", "role", "findings")
"""What a gallery can be sorted by; ``order`` is that of the set."""
NUMBERS = ("dof", "reach", "mass")
"""Facts that a gallery can be limited to ranges of."""


@dataclass(frozen=True)
class Entry:
    """A robot in a gallery; facts are None while they are not known."""

    name: str
    place: str
    """See ``morphgen.viewer.robot_uri``."""
    category: str = ""
    role: str = ""
    """The side of a split, or a part's kind."""
    task: str = ""
    dof: int | None = None
    links: int | None = None
    reach: float | None = None
    """Metres; None for a robot without a tool, too."""
    mass: float | None = None
    """Kilograms."""
    findings: tuple[str, ...] | None = None
    """Codes of errors and warnings, or of all findings where severities are not known."""
    order: int = 0


@dataclass(frozen=True)
class Filter:
    """Which rows are shown."""

    search: str = ""
    """Words that all must be in the name, category, role, task or findings."""
    category: str = ""
    role: str = ""
    findings: str = ""
    """``with``, ``without``, or empty for both."""
    ranges: Mapping[str, tuple[float, float]] | None = None
    """Least and largest value by fact; rows of which a fact is unknown are left out."""


def filtered(entries: Iterable[Entry], wanted: Filter) -> list[Entry]:
    """The rows that a filter lets through, in order."""
    return [entry for entry in entries if _passes(entry, wanted)]


def ordered(entries: Iterable[Entry], key: str) -> list[Entry]:
    """Rows sorted by a fact; with a minus before it, the largest first.

    Rows of which it is unknown come last either way; equal ones stay in the set's order.

    Raises:
        ValueError: If there is no such fact.
    """
    name = key.removeprefix("-")
    if name not in SORTS:
        raise ValueError(f"cannot sort by {name!r}; valid: {', '.join(SORTS)}")
    value = _sort_value(name)
    entries = sorted(entries, key=lambda entry: entry.order)
    known = sorted((e for e in entries if value(e) is not None), key=value, reverse=key[:1] == "-")
    return [*known, *(entry for entry in entries if value(entry) is None)]


def paged(rows: Sequence[T], number: int, size: int) -> tuple[list[T], int, int]:
    """One page of rows.

    Args:
        rows: All of them.
        number: Which page, from 1; beyond the ends the nearest one is taken.
        size: Rows on a page.

    Returns:
        Its rows, its number, and how many pages there are (at least 1).
    """
    count = max(math.ceil(len(rows) / size), 1)
    number = min(max(number, 1), count)
    return list(rows[(number - 1) * size : number * size]), number, count


def extent(entries: Iterable[Entry], fact: str) -> tuple[float, float] | None:
    """Least and largest value of a fact; None if none is known, or all are the same."""
    values = [getattr(entry, fact) for entry in entries]
    known = [float(value) for value in values if value is not None]
    if not known or min(known) == max(known):
        return None
    return min(known), max(known)


def choices(entries: Iterable[Entry], fact: str) -> list[str]:
    """Every value of a text, sorted, without the empty one."""
    return sorted({getattr(entry, fact) for entry in entries} - {""})


def with_facts(entry: Entry, facts: Mapping[str, object]) -> Entry:
    """The row with what has become known of it."""
    return replace(entry, **facts)  # type: ignore[arg-type]


def facts_line(entry: Entry) -> str:
    """The facts of a row in a few words, such as ``9 DoF · 0.85 m · 3.2 kg``."""
    parts = []
    if entry.dof is not None:
        parts.append(f"{entry.dof} DoF")
    if entry.reach is not None:
        parts.append(f"{entry.reach:.2f} m")
    if entry.mass is not None:
        parts.append(f"{entry.mass:.3g} kg")
    return " · ".join(parts)


def _passes(entry: Entry, wanted: Filter) -> bool:
    text = " ".join((entry.name, entry.category, entry.role, entry.task, *(entry.findings or ())))
    if not all(word in text.lower() for word in wanted.search.lower().split()):
        return False
    if wanted.category not in ("", entry.category) or wanted.role not in ("", entry.role):
        return False
    if wanted.findings and bool(entry.findings) != (wanted.findings == "with"):
        return False
    for fact, (low, high) in (wanted.ranges or {}).items():
        value = getattr(entry, fact)
        if value is None or not low <= value <= high:
            return False
    return True


def _sort_value(name: str) -> Callable[[Entry], Any]:
    if name == "findings":
        return lambda entry: None if entry.findings is None else len(entry.findings)
    return lambda entry: getattr(entry, name)

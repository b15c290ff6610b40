"""The rows of galleries: of a folder or set of robots, of a split, of the library."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from pathlib import Path
from typing import Any

from morphgen.benchmark.split import SIDES, Split
from morphgen.errors import FormatError
from morphgen.formats.bundle import CARD
from morphgen.formats.data_files import parse_json, read_json, read_text
from morphgen.formats.resolve import file_stamp
from morphgen.grammar.library import Library
from morphgen.grammar.robot_set import DERIVATION, INDEX, SETTINGS
from morphgen.viewer.entries import Entry
from morphgen.viewer.robot_uri import (
    DERIVED,
    MEMBER,
    ROBOT_SUFFIXES,
    WORDS,
    FileAccess,
    UriError,
    is_robot,
    member_uri,
    resolve_split,
)

UNREADABLE = "unreadable"
"""Stands for a finding where a card cannot be read."""
_LOUD = ("error", "warning")


def folder_entries(text: str, places: FileAccess) -> list[Entry]:
    """The robots in a folder: of a set by its index, of others by their cards; URDFs, too.

    Raises:
        UriError: If it is no folder, or holds no robot.
    """
    folder = places.path(text)
    if not folder.is_dir():
        raise UriError(f"{text}: no folder")
    index = folder / INDEX
    if index.is_file():
        return list(_set_entries(text.rstrip("/"), folder))
    found: list[Entry] = []
    for path in sorted(folder.iterdir()):
        place = f"{text.rstrip('/')}/{path.name}"
        if path.is_dir() and is_robot(path):
            found.append(_bundle_entry(place, path, len(found)))
        elif path.is_file() and path.suffix in ROBOT_SUFFIXES[:2]:
            found.append(Entry(path.name, place, "description", order=len(found)))
    if not found:
        raise UriError(f"{text} holds no robot; morphgen sample and morphgen compose make some")
    return found


def subfolders(folder: Path) -> list[str]:
    """Folders in a folder that hold robots, sorted; cheap, so only their first one is looked at."""
    if not folder.is_dir():
        return []
    found = []
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith(".") and not is_robot(path):
            inside = (below for below in path.iterdir() if below.is_dir())
            if (path / INDEX).is_file() or any(map(is_robot, inside)):
                found.append(path.name)
    return found


def split_entries(name: str, split: Split) -> list[Entry]:
    """The members of a split, train first."""
    members = [(side, member) for side in SIDES for member in split.side(side)]
    return [
        Entry(
            member.name,
            member_uri(name, side, member),
            member.category,
            side,
            member.task + (" with obstacles" if member.obstacles else ""),
            order=i,
        )
        for i, (side, member) in enumerate(members)
    ]


def part_entries(library: Library) -> list[Entry]:
    """The arms, end-effectors and bodies of a library, each as a robot by itself."""
    found: list[Entry] = []
    for manifest in library.manifests():
        if manifest.kind in ("arm", "ee") and manifest.name != "none":
            place = f"{WORDS}{manifest.kind}={manifest.name}"
        elif manifest.kind == "body":
            place = f"{DERIVED}body={manifest.name}"
        else:
            continue
        made = "template" if manifest.is_template else "real"
        found.append(Entry(manifest.name, place, made, manifest.kind, order=len(found)))
    return found


def neighbours(place: str, places: FileAccess) -> tuple[str, str]:
    """The places of the robots before and after one, in its set or split; empty where none is."""
    if place.startswith(MEMBER):
        name = place.removeprefix(MEMBER).rpartition("@")[0]
        rows = split_entries(name, resolve_split(name, places))
    elif ":" not in place and (folder := place.rstrip("/").rpartition("/")[0]):
        if not (places.path(folder) / INDEX).is_file():
            return "", ""
        rows = folder_entries(folder, places)
    else:
        return "", ""
    every = ["", *(entry.place for entry in rows), ""]
    if place.rstrip("/") not in every:
        return "", ""
    i = every.index(place.rstrip("/"))
    return every[i - 1], every[i + 1]


def _set_entries(place: str, folder: Path) -> Iterator[Entry]:
    try:
        grammar = str(read_json(folder / SETTINGS)["grammar"])
    except (FormatError, OSError, KeyError, TypeError):
        grammar = ""  # a set without its settings still has its robots
    for record in _index(folder / INDEX, file_stamp(folder / INDEX)):
        yield Entry(
            record["name"],
            f"{place}/{record['name']}",
            grammar,
            dof=record["dof"],
            links=record["links"],
            reach=record["reach"],
            mass=record["mass"],
            findings=tuple(record["findings"]),
            order=record["index"],
        )


@lru_cache(maxsize=16)
def _index(path: Path, stamp: tuple[int, int]) -> tuple[dict[str, Any], ...]:
    del stamp
    try:
        lines = read_text(path).splitlines()
        records = tuple(parse_json(line, str(path)) for line in lines)
        for record in records:
            record["name"], record["index"], record["dof"], record["findings"]
    except (FormatError, OSError, KeyError, TypeError) as error:
        raise UriError(f"{path}: no index of a set: {error!r}") from error
    return records


def _bundle_entry(place: str, folder: Path, order: int) -> Entry:
    if not (folder / CARD).is_file():
        return Entry(
            folder.name, place, "light" if (folder / DERIVATION).is_file() else "", order=order
        )
    try:
        card = read_json(folder / CARD)
        findings = {finding["code"] for finding in card["findings"] if finding["severity"] in _LOUD}
        category = "composed" if "derivation" in card else "imported"
        numbers = (card["dof"], card["links"], card["reach"], card["mass"])
    except (FormatError, OSError, KeyError, TypeError):
        return Entry(folder.name, place, findings=(UNREADABLE,), order=order)
    return Entry(
        folder.name,
        place,
        category,
        "",
        "",
        *numbers,
        findings=tuple(sorted(findings)),
        order=order,
    )

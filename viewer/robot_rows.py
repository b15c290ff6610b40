"""Rows of galleries: robots with their facts, listed, filtered, sorted and paged."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import attrgetter
from pathlib import Path
from typing import Any

from morphgen.benchmark.split_folder import SPLIT_FILE
from morphgen.errors import FormatError
from morphgen.files import file_stamp
from morphgen.formats.bundle import CARD, SUFFIXES, is_mjcf, part_licences
from morphgen.formats.data_files import read_json
from morphgen.grammar.catalogue import known_facts, stored_facts
from morphgen.grammar.library import Library
from morphgen.grammar.robot_source import is_robot_folder
from morphgen.grammar.sampling import INDEX, read_index, read_settings
from morphgen.splits.split import Split, sided_members, split_names
from morphgen.viewer import robot_uri

SORTS = ("order", "name", "dof", "links", "reach", "mass")
"""Keys by which rows can be sorted; ``order`` is the order of the set."""
UNITS = {"reach": "m", "mass": "kg", "dof": "DoF", "links": "links"}
"""Facts that are numbers, and their units."""
NUMBERS = ("dof", "links", "reach", "mass")  # facts with a range, in the order of their sliders
UNREADABLE = "unreadable"  # finding of a bundle whose card cannot be read


@dataclass(frozen=True)
class Row:
    """A robot in a gallery; unknown facts are None."""

    name: str
    uri: str
    category: str = ""
    role: str = ""  # side of a split, or kind of a part
    licence: str = ""  # licences of its parts, separated by commas
    task: str = ""
    dof: int | None = None
    links: int | None = None
    reach: float | None = None  # reach [m]; None for a robot without a tool, too
    mass: float | None = None  # mass [kg]
    findings: tuple[str, ...] | None = None  # errors and warnings; sets have all
    order: int = 0

    def completed(self, facts: Mapping[str, Any]) -> Row:
        """Return the row with the facts that it lacks, and with findings of the robot itself."""
        missing = {k: v for k, v in facts.items() if k == "findings" or getattr(self, k) is None}
        return replace(self, **missing)


FILTERS = ("search", "category", "role", "licence", "findings", *NUMBERS)
"""Keys of conditions on rows, as addresses have them: words that must all occur, a category, a
role, a licence, ``with`` or ``without`` findings, and ranges ``LOW..HIGH``, which no unknown
number is in."""
WORDS_OF_ROWS = ("category", "role", "licence")  # facts that are texts
ROUNDING = 1e-9  # browsers round the ends of a range


def passes(row: Row, state: Mapping[str, str]) -> bool:
    """Return whether a row meets the conditions of an address; empty ones hold for every row."""
    facts = (row.name, row.category, row.role, row.task, row.licence, *(row.findings or ()))
    text = " ".join(facts).lower()
    if not all(word in text for word in state.get("search", "").lower().split()):
        return False
    if not all(state.get(key, "") in ("", *words(row, key)) for key in WORDS_OF_ROWS):
        return False
    if (findings := state.get("findings")) and bool(row.findings) != (findings == "with"):
        return False
    for fact in NUMBERS:
        if limits := state.get(fact):
            low, _, high = limits.partition("..")
            value = getattr(row, fact)
            if value is None or not float(low) - ROUNDING <= value <= float(high) + ROUNDING:
                return False
    return True


def sort_rows(rows: Iterable[Row], key: str) -> list[Row]:
    """Sort rows by a fact, or descending by ``-fact``; unknown last, ties in the set's order."""
    name = key.removeprefix("-")
    rows = sorted(rows, key=lambda row: row.order)
    known = [row for row in rows if getattr(row, name) is not None]
    unknown = [row for row in rows if getattr(row, name) is None]
    return [*sorted(known, key=attrgetter(name), reverse=key.startswith("-")), *unknown]


def fact_range(rows: Iterable[Row], fact: str) -> tuple[float, float] | None:
    """Return smallest and largest value of a fact; None if it is unknown of all rows."""
    values = [float(value) for row in rows if (value := getattr(row, fact)) is not None]
    return (min(values), max(values)) if values else None


def fact_choices(rows: Iterable[Row], fact: str) -> list[str]:
    """Return the different values of a text fact, sorted, without the empty one."""
    return sorted({word for row in rows for word in words(row, fact)} - {""})


def words(row: Row, fact: str) -> list[str]:
    """Return the values of a text fact: one, or several licences."""
    text: str = getattr(row, fact)
    return text.split(", ")


def facts_line(row: Row) -> str:
    """Return a row's facts in a few words, such as ``9 DoF · 0.85 m · 3.2 kg``."""
    parts = []
    if row.dof is not None:
        parts.append(f"{row.dof} DoF")
    if row.reach is not None:
        parts.append(f"{row.reach:.2f} m")
    if row.mass is not None:
        parts.append(f"{row.mass:.3g} kg")
    return " · ".join(parts)


def folder_rows(text: str, files: robot_uri.FileAccess) -> list[Row]:
    """Return the robots in a folder: a set's from its index, bundles by their cards, URDFs."""
    folder = files.path(text)
    if not folder.is_dir():
        raise robot_uri.UriError(f"{text}: not a folder")
    text = text.rstrip("/")
    if (folder / INDEX).is_file():
        return list(_set_rows(text, folder))
    rows: list[Row] = []
    for path in sorted(folder.iterdir()):
        uri = f"{text}/{path.name}"
        if path.is_dir() and is_robot_folder(path):
            rows.append(_bundle_row(uri, path, len(rows)))
        elif (
            path.is_file() and path.suffix in SUFFIXES and (path.suffix != ".xml" or is_mjcf(path))
        ):
            rows.append(Row(path.name, uri, "description", order=len(rows)))
    if not rows:
        raise robot_uri.UriError(
            f"{text} holds no robot; morphgen sample and morphgen compose make some"
        )
    return rows


def source_rows(text: str, files: robot_uri.FileAccess) -> list[Row]:
    """Return the robots of a split, by its name, file or built folder, or those in a folder."""
    is_split = text in split_names() or text.endswith(".yaml")
    if is_split or (files.path(text) / SPLIT_FILE).is_file():
        return split_rows(text, robot_uri.resolve_split(text, files))
    return folder_rows(text, files)


def robot_folders(root: Path) -> list[str]:
    """Return the folders of robots below a folder and below its ``robots/``, relative to it."""
    below = [f"robots/{name}" for name in robot_subfolders(root / "robots")]
    return [*robot_subfolders(root), *below]


def robot_subfolders(folder: Path) -> list[str]:
    """Return the sorted names of the subfolders that hold robots, sets or bundles."""
    if not folder.is_dir():
        return []
    names = []
    for path in sorted(folder.iterdir()):
        if path.is_dir() and not path.name.startswith(".") and not is_robot_folder(path):
            children = (child for child in path.iterdir() if child.is_dir())
            if (path / INDEX).is_file() or any(map(is_robot_folder, children)):
                names.append(path.name)
    return names


def split_rows(name: str, split: Split) -> list[Row]:
    """Return the members of a split, train robots first."""
    return [
        Row(
            member.name,
            robot_uri.member_uri(name, side, member),
            member.category,
            side,
            task=member.task + (" with obstacles" if member.obstacles else ""),
            order=i,
        )
        for i, (side, member) in enumerate(sided_members(split))
    ]


def sibling_rows(uri: str, files: robot_uri.FileAccess) -> list[Row]:
    """Return the robots of the split or set that has a robot; none if it is in neither."""
    if split := robot_uri.member_split(uri):
        return split_rows(split, robot_uri.resolve_split(split, files))
    folder = robot_uri.parent_folder(uri)
    is_in_set = folder and (files.path(folder) / INDEX).is_file()
    return folder_rows(folder, files) if is_in_set else []


def uri_rows(uris: Sequence[str], files: robot_uri.FileAccess) -> list[Row]:
    """Return the rows of robots; those of sets and splits have the facts that these know."""
    rows = []
    for i, uri in enumerate(uris):
        known = (row for row in sibling_rows(uri, files) if row.uri == uri)
        rows.append(replace(next(known, Row(robot_uri.uri_name(uri), uri)), order=i))
    return rows


def part_rows(library: Library) -> list[Row]:
    """Return the arms, end-effectors, bodies and objects of a library, each on its own."""
    rows: list[Row] = []
    stored = stored_facts()
    for manifest in library.manifests():
        if manifest.kind in ("arm", "ee", "object") and manifest.name != "none":
            uri = f"{robot_uri.WORDS}{manifest.kind}={manifest.name}"
        elif manifest.kind == "body":
            uri = f"{robot_uri.DERIVATION}body={manifest.name}"
        else:
            continue
        category = "template" if manifest.is_template else "real"
        known = known_facts(manifest, stored)
        facts: dict[str, Any] = {key: known.get(key) for key in ("dof", "reach", "mass")}
        row = Row(manifest.name, uri, category, manifest.kind, manifest.licence, order=len(rows))
        rows.append(replace(row, **facts))
    return rows


def _set_rows(uri: str, folder: Path) -> Iterator[Row]:
    try:
        grammar = str(read_settings(folder)["grammar"])
    except FormatError:
        grammar = ""  # a set without its settings still has its robots
    for record in _read_index(folder, file_stamp(folder / INDEX)):
        yield Row(
            record["name"],
            f"{uri}/{record['name']}",
            grammar,
            findings=tuple(record["findings"]),
            order=record["index"],
            **{fact: record[fact] for fact in NUMBERS},
        )


@lru_cache(maxsize=16)
def _read_index(folder: Path, stamp: tuple[int, int]) -> tuple[dict[str, Any], ...]:
    """Return the index of a set; the stamp of its file renews the cache when it changes."""
    del stamp
    records = tuple(read_index(folder))
    for record in records:
        if missing := {*NUMBERS, "findings"} - record.keys():
            raise robot_uri.UriError(
                f"{folder / INDEX}: a line has no {', '.join(sorted(missing))}"
            )
    return records


def _bundle_row(uri: str, folder: Path, order: int) -> Row:
    """Return the row of a bundle from its card; ``UNREADABLE`` if the card is broken."""
    if not (folder / CARD).is_file():
        return Row(folder.name, uri, "light", order=order)
    try:
        card = read_json(folder / CARD)
        problems = {
            finding["code"]
            for finding in card["findings"]
            if finding["severity"] in ("error", "warning")
        }
        return Row(
            folder.name,
            uri,
            "composed" if "derivation" in card else "imported",
            licence=", ".join(part_licences(card)),
            findings=tuple(sorted(problems)),
            order=order,
            **{fact: card[fact] for fact in NUMBERS},
        )
    except (FormatError, OSError, KeyError, TypeError):
        return Row(folder.name, uri, findings=(UNREADABLE,), order=order)

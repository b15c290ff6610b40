"""The licences of parts, which of them restrict use, and how data sets state them.

Releases of splits and demonstrations have a card, the licences of all parts, and Croissant.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import PurePosixPath
from string import Template
from typing import Any

import yaml

from morphgen.benchmark import read_text
from morphgen.benchmark.regimes import parts as part_names
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.library import Library
from morphgen.grammar.syntax import parse_derivation
from morphgen.splits.split import SIDES, Split, sided_members

LICENCES_FILE = "licences.json"
CROISSANT_FILE = "croissant.json"

UNKNOWN = "unknown"  # restriction of a licence that is not listed
_SPDX = "https://spdx.org/licenses/{}.html"


@dataclass(frozen=True)
class Licence:
    """A licence of parts."""

    id: str
    """Identifier in part manifests: SPDX, or ``LicenseRef-...`` for one that SPDX does not list."""
    restrictions: tuple[str, ...] = ()
    """Restrictions that a release needs permission for, such as ``non-commercial``."""

    @property
    def is_spdx(self) -> bool:
        """Whether SPDX lists the identifier."""
        return self.id in known_licences() and not self.id.startswith("LicenseRef-")

    @property
    def url(self) -> str:
        """Address of the licence's text; empty if SPDX does not list it."""
        return _SPDX.format(self.id) if self.is_spdx else ""

    @property
    def hub_id(self) -> str:
        """Identifier in the front matter of a dataset card of Hugging Face."""
        if self.id == "LicenseRef-BSD":
            return "bsd"
        if UNKNOWN in self.restrictions:
            return "unknown"
        return self.id.lower().removesuffix("-only").removesuffix("-or-later")


@dataclass(frozen=True)
class LicencedPart:
    """A part of a split's robots."""

    part: str  # name of the part
    licence: Licence
    citation: str  # source of the part
    robots: tuple[tuple[str, str], ...]
    """Side and name of every member that has the part, train first."""

    def as_dict(self) -> dict[str, Any]:
        """Return the part as JSON data."""
        names = {side: [name for each, name in self.robots if each == side] for side in SIDES}
        return {
            "part": self.part,
            "licence": self.licence.id,
            "restrictions": list(self.licence.restrictions),
            "source": self.citation,
            "robots": names,
        }


@cache
def known_licences() -> Mapping[str, tuple[str, ...]]:
    """Return the restrictions of the licences in ``licences.yaml`` by identifier."""
    table = yaml.safe_load(read_text("licences.yaml"))
    return {identifier: tuple(restrictions) for identifier, restrictions in table.items()}


def find_licence(identifier: str) -> Licence:
    """Return a licence by its identifier; one that is not known counts as restricted."""
    return Licence(identifier, known_licences().get(identifier, (UNKNOWN,)))


def licenced_parts(split: Split, library: Library) -> tuple[LicencedPart, ...]:
    """Return the parts of a split's robots with their licences, sorted by licence and name."""
    robots: dict[str, list[tuple[str, str]]] = {}
    for side, member in sided_members(split):
        derivation = parse_derivation(member.derivation, f"derivation of {member.name!r}")
        for part in part_names(derivation):
            robots.setdefault(part, []).append((side, member.name))
    manifests = {part: library.manifest(part) for part in robots}
    found = [
        LicencedPart(part, find_licence(manifests[part].licence), manifests[part].citation, (*who,))
        for part, who in robots.items()
    ]
    return tuple(sorted(found, key=lambda each: (each.licence.id, each.part)))


def licence_ids(parts: Iterable[LicencedPart]) -> tuple[str, ...]:
    """Return the identifiers of the parts' licences, sorted."""
    return tuple(sorted({part.licence.id for part in parts}))


def restricted(parts: Iterable[LicencedPart]) -> tuple[LicencedPart, ...]:
    """Return the parts whose licence restricts use."""
    return tuple(part for part in parts if part.licence.restrictions)


def licence_lines(parts: Iterable[LicencedPart]) -> list[str]:
    """Return the licences in one line, and a line for each part whose licence restricts use."""
    parts = tuple(parts)
    lines = [f"licences: {', '.join(licence_ids(parts))}"]
    return lines + [f"restricted: {restriction_text(part)}" for part in restricted(parts)]


def restriction_text(part: LicencedPart) -> str:
    """Return a part's licence, its restrictions, and the robots that have the part."""
    names = ", ".join(dict.fromkeys(name for _, name in part.robots))
    return (
        f"{part.part} ({part.licence.id}: {', '.join(part.licence.restrictions)}) in robots {names}"
    )


def require_allowed(split: Split, parts: Iterable[LicencedPart], allowed: Collection[str]) -> None:
    """Require that every licence with restrictions is allowed by its identifier."""
    parts = tuple(parts)
    ids = licence_ids(parts)
    for identifier in allowed:
        if identifier not in ids:
            raise BenchmarkError(
                f"--licence-allow {identifier}: no part of {split.name} has this licence"
                f"{nearest(identifier, ids)}"
            )
    refused = [part for part in restricted(parts) if part.licence.id not in allowed]
    if refused:
        wanted = ",".join(licence_ids(refused))
        raise BenchmarkError(
            f"{split.name}: {'; '.join(map(restriction_text, refused))}; release a split without "
            f"these parts, or allow the licence with --licence-allow {wanted}"
        )


def dataset_card(
    name: str,
    parts: Sequence[LicencedPart],
    front: Mapping[str, object],
    template: str,
    /,
    **facts: object,
) -> str:
    """Return the dataset card: Markdown with the front matter that Hugging Face reads.

    front: Front matter besides name and licence.
    template: Text of the card, whose placeholders are ``facts`` and ``licences``.
    """
    # Several licences may have one identifier there, such as gpl-3.0.
    ids = list(dict.fromkeys(find_licence(each).hub_id for each in licence_ids(parts)))
    data = {"pretty_name": name, "license": ids[0] if len(ids) == 1 else ids, **front}
    head: str = yaml.safe_dump(data, sort_keys=False, allow_unicode=True, width=10_000)
    text = Template(template).substitute(facts, licences=licence_summary(parts))
    return f"---\n{head}---\n\n{text}"


def licences_json(parts: Sequence[LicencedPart]) -> str:
    """Return the text of ``licences.json``."""
    return json.dumps([part.as_dict() for part in parts], indent=2, ensure_ascii=False) + "\n"


def licence_summary(parts: Sequence[LicencedPart]) -> str:
    """Return the licences in a sentence, with a line for each part whose licence restricts use."""
    limits = [f"Restricted: {restriction_text(part)}." for part in restricted(parts)]
    text = (
        f"The parts of the robots are under {', '.join(licence_ids(parts))}. "
        f"`{LICENCES_FILE}` lists parts, sources and robots."
    )
    return "\n".join([text, *limits])


def croissant_head() -> dict[str, Any]:
    """Return the context of a Croissant description, to which facts and contents are added."""
    data: dict[str, Any] = json.loads(read_text(CROISSANT_FILE))
    return data


def croissant_contents(template: str, sums: Mapping[str, str]) -> dict[str, Any]:
    """Return files and records of a Croissant description.

    template: Name of the template, which describes all files that may exist.
    sums: Hashes of the files that exist, by path.
    """
    data: dict[str, Any] = json.loads(read_text(template))
    files, data["distribution"] = data["distribution"], []
    for entry in files:
        if entry["name"] in sums:
            data["distribution"].append({**entry, "sha256": sums[entry["name"]]})
        elif any(PurePosixPath(path).match(entry.get("includes", "-")) for path in sums):
            data["distribution"].append(entry)  # a set of files
    return data


def licence_addresses(parts: Sequence[LicencedPart]) -> list[str]:
    """Return the address of each licence of the parts, or its identifier if it has none."""
    return [find_licence(each).url or each for each in licence_ids(parts)]

"""The licences of a split's parts, which of them restrict use, and in which robots they are."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from morphgen.benchmark.regimes import NOTHING
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.derivation import parse_derivation
from morphgen.grammar.library import Library
from morphgen.splits.split import SIDES, Split

NON_COMMERCIAL, NO_DERIVATIVES, UNKNOWN = "non-commercial", "no derivatives", "unknown"
SHARE_ALIKE = "share-alike"
_SPDX = "https://spdx.org/licenses/{}.html"


@dataclass(frozen=True)
class Licence:
    """A licence of parts."""

    id: str
    """Identifier in part manifests: SPDX, or ``LicenseRef-...`` for one that SPDX does not list."""
    restrictions: tuple[str, ...] = ()
    """Restrictions that a release needs permission for: ``NON_COMMERCIAL`` and so on."""
    is_spdx: bool = True  # whether SPDX lists the identifier

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


_PERMISSIVE = ("MIT", "BSD-2-Clause", "BSD-3-Clause", "Apache-2.0", "MPL-2.0", "CC0-1.0")
_SHARED = ("CC-BY-4.0", "CC-BY-SA-4.0", "ISC", "GPL-3.0-only", "GPL-3.0-or-later")
LICENCES: Mapping[str, Licence] = {
    licence.id: licence
    for licence in (
        *map(Licence, (*_PERMISSIVE, *_SHARED)),
        Licence("LicenseRef-BSD", is_spdx=False),  # BSD; the source does not say which version
        Licence("CC-BY-NC-4.0", (NON_COMMERCIAL,)),
        # A release may hold parts that are share-alike only: it keeps each part's licence.
        Licence("CC-BY-NC-SA-4.0", (NON_COMMERCIAL, SHARE_ALIKE)),
        Licence("CC-BY-ND-4.0", (NO_DERIVATIVES,)),
        Licence("CC-BY-NC-ND-4.0", (NON_COMMERCIAL, NO_DERIVATIVES)),
        Licence("LicenseRef-unknown", (UNKNOWN,), is_spdx=False),
    )
}
"""Known licences by identifier: those of the library, and others that parts often have."""


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


def find_licence(identifier: str) -> Licence:
    """Return a licence by its identifier; one that is not in ``LICENCES`` counts as unknown."""
    return LICENCES.get(identifier, Licence(identifier, (UNKNOWN,), is_spdx=False))


def licenced_parts(split: Split, library: Library) -> tuple[LicencedPart, ...]:
    """Return the parts of a split's robots with their licences, sorted by licence and name."""
    robots: dict[str, dict[tuple[str, str], None]] = {}
    for side in SIDES:
        for member in split.side(side):
            derivation = parse_derivation(member.derivation, f"derivation of {member.name!r}")
            for node in derivation.walk():
                if node.part != NOTHING:
                    robots.setdefault(node.part, {})[side, member.name] = None
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


def restriction_line(parts: Iterable[LicencedPart]) -> str:
    """Return the restricted parts, if any, in a line with what a release of them needs."""
    limited = restricted(parts)
    if not limited:
        return ""
    return (
        f"restricted: {'; '.join(map(restriction_text, limited))}; split release needs "
        f"--licence-allow {','.join(licence_ids(limited))}"
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

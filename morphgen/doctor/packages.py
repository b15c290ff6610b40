"""The packages that morphgen and its extras depend on: versions, and those outside their ranges."""

from __future__ import annotations

import importlib.metadata
from collections.abc import Iterator, Sequence

from packaging.requirements import Requirement

from morphgen.doctor.entry import Entry

NOT_FOR_USERS = frozenset(("all", "bench", "dev", "docs", "test"))
"""Extras that the diagnosis leaves out: a sum of others, and those for work on morphgen itself."""


def entries() -> Iterator[Entry]:
    """Compare the installed packages with the ranges that morphgen declares."""
    distribution = importlib.metadata.distribution("morphgen")
    declared = [Requirement(line) for line in distribution.requires or ()]
    yield from group_entries("core", requirements_of("", declared))
    for extra in distribution.metadata.get_all("Provides-Extra") or ():
        if extra not in NOT_FOR_USERS:
            yield from group_entries(f"extra {extra}", requirements_of(extra, declared))


def requirements_of(extra: str, declared: Sequence[Requirement]) -> list[Requirement]:
    """Return the requirements of an extra, and of the extras that it includes."""
    chosen: dict[str, Requirement] = {}
    for requirement in declared:
        marker = requirement.marker
        if (marker is None) == bool(extra) or (marker and not marker.evaluate({"extra": extra})):
            continue
        if requirement.name == "morphgen":
            for included in sorted(requirement.extras):
                chosen |= {each.name: each for each in requirements_of(included, declared)}
        else:
            chosen[requirement.name] = requirement
    return list(chosen.values())


def group_entries(name: str, requirements: Sequence[Requirement]) -> Iterator[Entry]:
    """Yield a result for the core or an extra, and one for each package outside its range."""
    versions = {each.name: _version(each.name) for each in requirements}
    missing = [package for package, number in versions.items() if number is None]
    for requirement in requirements:
        number = versions[requirement.name]
        if number and not requirement.specifier.contains(number, prereleases=True):
            text = f"{number} is outside of the range {requirement.specifier} that morphgen needs"
            yield Entry(f"package {requirement.name}", "warning", text)
    kind, _, extra = name.partition(" ")
    if not requirements:
        yield Entry(name, "absent", "not available for this version of Python")
    elif missing and kind == "core":
        text = f"not installed: {', '.join(missing)}; install morphgen again"
        yield Entry(name, "error", text, versions)
    elif missing:
        text = f"not installed: {', '.join(missing)}; pip install 'morphgen[{extra}]'"
        yield Entry(name, "absent", text, versions)
    else:
        text = ", ".join(f"{package} {number}" for package, number in sorted(versions.items()))
        yield Entry(name, "ok", text, versions)


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None

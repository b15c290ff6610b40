"""Files that morphgen reads: parts, data packages of robots, splits, goal sets and policies."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from functools import partial
from importlib.metadata import version
from pathlib import Path

from morphgen.doctor import reference
from morphgen.doctor.entry import Entry, attempt
from morphgen.errors import MorphgenError, PartError
from morphgen.formats.files import file_sha256
from morphgen.formats.resolve import REQUIREMENTS, distribution_file
from morphgen.grammar.catalogue import source_digest, stored_facts
from morphgen.grammar.library import (
    LIBRARY_VARIABLE,
    Library,
    default_library,
    shipped_folders,
)
from morphgen.grammar.manifest import PART_KINDS, PackageSource
from morphgen.tasks.goals.goal_sets import FOLDER, packaged_index

ROS_VARIABLES = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
"""Environment variables with folders in which meshes of imported robots are searched first."""


def entries() -> Iterator[Entry]:
    """Examine the files."""
    yield attempt("library", _library)
    for package in REQUIREMENTS:
        yield attempt(f"robots of {package}", partial(_robot_package, package))
    for variable in ROS_VARIABLES:
        if os.environ.get(variable):
            text = f"{os.environ[variable]}; imported URDFs find packages there first"
            yield Entry(variable, "ok", text)
    yield attempt("splits", _splits)
    yield attempt("goal sets", _goal_sets)
    yield attempt("policies", _policies)


def _library() -> Entry:
    """Count the parts, and name the folders of the user's own."""
    library = default_library()
    try:
        library.paths  # noqa: B018 - which reads the folders
    except PartError as error:
        variable = f"{LIBRARY_VARIABLE}={os.environ.get(LIBRARY_VARIABLE, '')}"
        return Entry("library", "error", f"{error}; change {variable}")
    counts = {kind: len(library.names(kind)) for kind in PART_KINDS}
    listed = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    text = f"{sum(counts.values())} parts: {listed}"
    for folder in library.folders[len(shipped_folders()) :]:
        text += f"; {len(Library([folder]).paths)} of them in {folder} ({LIBRARY_VARIABLE})"
    data = {"parts": counts, "folders": [str(folder) for folder in library.folders]}
    return Entry("library", "ok", text, data)


def _robot_package(package: str) -> Entry:
    """Find the files of all parts from a data package, and compare them with the tested ones."""
    name = f"robots of {package}"
    parts = [
        (manifest, manifest.source.file)
        for manifest in Library(shipped_folders()).manifests()
        if isinstance(manifest.source, PackageSource) and manifest.source.package == package
    ]
    errors = []
    for _, file in parts:
        try:
            distribution_file(package, file)
        except MorphgenError as error:
            errors.append(str(error))
    if errors:
        text = f"{len(errors)} of {len(parts)} parts lack their file: {errors[0]}"
        return Entry(name, "error", text, {"errors": errors})
    stored, number = stored_facts(), version(package)
    changed = [
        manifest.name
        for manifest, _ in parts
        if stored.get(manifest.name, {}).get("digest") != source_digest(manifest)
    ]
    data = {"version": number, "parts": len(parts), "changed": changed}
    if changed:
        text = (
            f"{len(changed)} of {len(parts)} parts are not those that this morphgen was tested "
            f"with: {package} {number} is another version, or their YAML files were changed"
        )
        return Entry(name, "warning", text, data)
    return Entry(name, "ok", f"{number}, with the files of {len(parts)} parts", data)


def _splits() -> Entry:
    """Compare the ids of the shipped splits with the recorded ones."""
    present, expected = reference.splits(), reference.recorded()["splits"]
    return _compared("splits", present, expected, f"{len(present)} with their recorded ids")


def _goal_sets() -> Entry:
    """Compare the shipped goal sets with their index, and the index with its recorded hash."""
    damaged = [
        record["file"]
        for record in packaged_index().values()
        if not _has_hash(FOLDER / record["file"], record["sha256"])
    ]
    if damaged:
        text = f"{len(damaged)} damaged: {', '.join(damaged[:3])}; install morgphen again"
        return Entry("goal sets", "error", text, {"damaged": damaged})
    present, expected = {"the index": reference.goal_sets()}, reference.recorded()["goal_sets"]
    text = f"{len(packaged_index())} with their recorded hashes"
    return _compared("goal sets", present, {"the index": expected}, text)


def _has_hash(path: Path, sha256: str) -> bool:
    return path.is_file() and file_sha256(path) == sha256


def _policies() -> Entry:
    """Compare the files of the shipped policies with their recorded hashes."""
    present, expected = reference.checkpoints(), reference.recorded()["checkpoints"]
    return _compared("policies", present, expected, f"{', '.join(present)} with recorded hashes")


def _compared(
    name: str, present: Mapping[str, str], expected: Mapping[str, str], text: str
) -> Entry:
    """Compare hashes with the recorded ones."""
    names = present.keys() | expected.keys()
    changed = sorted(each for each in names if present.get(each) != expected.get(each))
    if not changed:
        return Entry(name, "ok", text, dict(present))
    text = f"not the recorded: {', '.join(changed)}; results with them do not compare with others"
    return Entry(name, "error", text, {"changed": changed})

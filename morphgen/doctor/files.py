"""Files that morphgen reads: parts, robots of data packages, splits, goal sets and policies."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from functools import partial
from importlib.metadata import version

from morphgen.doctor import Entry, attempt
from morphgen.errors import MorphgenError, PartError, one_line
from morphgen.files import file_sha256
from morphgen.formats.resolve import REQUIREMENTS, distribution_file
from morphgen.grammar.catalogue import source_digest, stored_facts
from morphgen.grammar.library import LIBRARY_VARIABLE, Library, default_library, shipped_folders
from morphgen.grammar.manifest import PART_KINDS, PackageSource
from morphgen.rl.shipped_policies import POLICIES
from morphgen.splits.split import split_id
from morphgen.splits.split_file import read_split, split_names
from morphgen.tasks.goals.goal_sets import FOLDER, packaged_index

ROS_VARIABLES = ("ROS_PACKAGE_PATH", "AMENT_PREFIX_PATH")
"""Environment variables with folders in which meshes of imported robots are searched first."""


def files() -> Iterator[Entry]:
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
    kinds = Counter(manifest.kind for manifest in library.manifests())
    counts = {kind: kinds[kind] for kind in PART_KINDS}
    listed = ", ".join(f"{count} {kind}" for kind, count in counts.items())
    text = f"{sum(counts.values())} parts: {listed}"
    for folder in library.folders[len(shipped_folders()) :]:
        text += f"; {len(Library([folder]).paths)} of them in {folder} ({LIBRARY_VARIABLE})"
    data = {"parts": counts, "folders": [str(folder) for folder in library.folders]}
    if faults := library.faults():
        text += f"; left out: {'; '.join(map(str, faults))}"
    return Entry("library", "warning" if faults else "ok", one_line(text), data)


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
    """Read the shipped splits, whose files have the hashes of their robots."""
    ids = {name: split_id(read_split(name)) for name in split_names()}
    return Entry("splits", "ok", f"{len(ids)} with the ids of their robots", ids)


def _goal_sets() -> Entry:
    """Compare the shipped goal sets with their index."""
    records = list(packaged_index().values())
    damaged = [
        record["file"]
        for record in records
        if not (path := FOLDER / record["file"]).is_file() or file_sha256(path) != record["sha256"]
    ]
    if damaged:
        text = f"{len(damaged)} damaged: {', '.join(damaged[:3])}; install morphgen again"
        return Entry("goal sets", "error", text, {"damaged": damaged})
    return Entry("goal sets", "ok", f"{len(records)} with the hashes of their index")


def _policies() -> Entry:
    """Read the shipped policies, whose files have a hash of their content."""
    from morphgen.rl.runs.checkpoint import read_checkpoint

    for name in POLICIES.builtin:
        read_checkpoint(POLICIES[name].file)
    return Entry("policies", "ok", f"{', '.join(POLICIES.builtin)}: their files are whole")

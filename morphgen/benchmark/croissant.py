"""The Croissant description of a release, for dataset tools: JSON-LD, format 1.0.

See https://docs.mlcommons.org/croissant. It describes the files of the release's folder, to which
its paths are relative.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import PurePosixPath
from typing import Any

from morphgen.benchmark.licences import find_licence
from morphgen.benchmark.release_file import (
    DIFFICULTY_FILE,
    LICENCES_FILE,
    RELEASE_FILE,
    SCORES_FILE,
    Release,
)
from morphgen.benchmark.split import SIDES, Split
from morphgen.benchmark.split_folder import ROBOTS_DIR, ROBOTS_FILE, SPLIT_FILE, TOKENS_FILE

CONFORMS_TO = "http://mlcommons.org/croissant/1.0"
_CROISSANT_TERMS = (
    *("citeAs", "column", "equivalentProperty", "extract", "field", "fileProperty", "fileObject"),
    *("fileSet", "format", "includes", "isLiveDataset", "jsonPath", "key", "md5", "parentField"),
    *("path", "recordSet", "references", "regex", "repeated", "replace", "samplingRate"),
    *("separator", "source", "subField", "transform"),
)
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _CROISSANT_TERMS},
}
"""The context that Croissant 1.0 prescribes."""
_FILES = {
    SPLIT_FILE: ("application/yaml", "The split: derivation, task and hash of every robot"),
    ROBOTS_FILE: ("application/jsonlines", "A line per robot, train robots first"),
    TOKENS_FILE: ("application/x-npz", "Tokens (n, max_links, 48) of the robots, with a mask"),
    RELEASE_FILE: ("application/json", "Version, evaluation and difficulty of the release"),
    DIFFICULTY_FILE: ("text/csv", "Size, nearest train robots and scores of every robot"),
    LICENCES_FILE: ("application/json", "Every part with its licence, source and robots"),
    SCORES_FILE: ("application/json", "Reference scores"),
}
"""Media type and description of the files that are described one by one."""
_SETS = (
    ("urdf", "application/xml", f"{ROBOTS_DIR}/*/robot.urdf", "The URDF of every robot"),
    ("mjcf", "application/xml", f"{ROBOTS_DIR}/*/robot.xml", "The MJCF of every robot"),
    ("goal-sets", "application/x-npz", "goals/*/*.npz", "Goals and starts of every robot"),
)
"""Name, media type, pattern and description of sets of files."""
_FIELDS = (
    ("name", "Text", "Name of the robot"),
    ("side", "Text", "Side of the split: train or test"),
    ("task", "Text", "Task of the robot"),
    ("obstacles", "Boolean", "Whether the scene has obstacles"),
    ("category", "Text", "Grammar that the robot was sampled from, or composed"),
    ("derivation", "Text", "Parts and parameters of the robot"),
    ("hash", "Text", "Hash of the physical robot"),
    ("links", "Integer", "Number of links"),
    ("movable", "Integer", "Number of movable joints"),
    ("movable_to_tool", "Integer", "Number of movable joints between root and tool"),
    ("dof", "Integer", "Number of independent joints"),
    ("reach", "Float", "Largest distance of the tool from the root's origin [m]"),
    ("mass", "Float", "Mass [kg]"),
    ("path", "Text", "Folder of the robot's files"),
)
"""Name, data type and description of the fields of a robot."""


def croissant_text(
    split: Split, release: Release, licences: Sequence[str], sums: Mapping[str, str]
) -> str:
    """Return the text of ``croissant.json``.

    Args:
        split: The split.
        release: The release.
        licences: Identifiers of the licences of its parts.
        sums: SHA-256 of the release's files by path, hexadecimal.
    """
    data: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": CONFORMS_TO,
        "name": release.stem,
        "description": f"{split.summary}. A split of robots for cross-embodiment learning: "
        f"{len(split.train)} robots to train on, {len(split.test)} to test on.",
        "version": release.version,
        "license": [find_licence(each).url or each for each in licences],
        "citeAs": citation(split, release),
    }
    if release.date:
        data["datePublished"] = release.date
    if release.url:
        data["url"] = release.url
    if release.creators:
        people = [{"@type": "sc:Organization", "name": name} for name in release.creators]
        data["creator"] = people
    data["distribution"] = [*_file_objects(sums), *_file_sets(sums)]
    data["recordSet"] = [_sides(), _robots()]
    return json.dumps(data, indent=2, ensure_ascii=False) + "\n"


def citation(split: Split, release: Release) -> str:
    """Return the sentence to cite a release with."""
    who = f"{', '.join(release.creators)}: " if release.creators else ""
    year = f", {release.date[:4]}" if release.date else ""
    after = f"; after {split.reference}" if split.reference else ""
    where = f", {release.url}" if release.url else ""
    return (
        f"{who}{release.name}, version {release.version}{year}. A split of robots, id "
        f"{release.id}, made with morphgen {release.morphgen}{after}{where}"
    )


def _file_objects(sums: Mapping[str, str]) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileObject",
            "@id": name,
            "name": name,
            "description": description,
            "contentUrl": name,
            "encodingFormat": media_type,
            "sha256": sums[name],
        }
        for name, (media_type, description) in _FILES.items()
        if name in sums
    ]


def _file_sets(sums: Mapping[str, str]) -> list[dict[str, Any]]:
    return [
        {
            "@type": "cr:FileSet",
            "@id": name,
            "name": name,
            "description": description,
            "encodingFormat": media_type,
            "includes": pattern,
        }
        for name, media_type, pattern, description in _SETS
        if any(PurePosixPath(path).match(pattern) for path in sums)
    ]


def _sides() -> dict[str, Any]:
    """Return the record set of the sides, which Croissant calls splits."""
    name = "sides/name"
    return {
        "@type": "cr:RecordSet",
        "@id": "sides",
        "name": "sides",
        "dataType": "cr:Split",
        "key": {"@id": name},
        "field": [{"@type": "cr:Field", "@id": name, "name": name, "dataType": "sc:Text"}],
        "data": [{name: side} for side in SIDES],
    }


def _robots() -> dict[str, Any]:
    """Return the record set of the robots."""
    fields = []
    for name, kind, description in _FIELDS:
        field: dict[str, Any] = {
            "@type": "cr:Field",
            "@id": f"robots/{name}",
            "name": f"robots/{name}",
            "description": description,
            "dataType": f"sc:{kind}",
            "source": {"fileObject": {"@id": ROBOTS_FILE}, "extract": {"column": name}},
        }
        if name == "side":
            field["references"] = {"field": {"@id": "sides/name"}}
        fields.append(field)
    return {"@type": "cr:RecordSet", "@id": "robots", "name": "robots", "field": fields}

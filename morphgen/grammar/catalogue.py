"""The catalogue: one row of facts per part.

Degrees of freedom, reach and mass of the parts that come with morphgen are stored in
``part_facts.json``, so that ``morphgen list`` need not read their URDFs and meshes. A stored entry
counts only as long as the part's files are the same. After a change of a part or of its package,
regenerate the file:

    python -m morphgen.grammar.catalogue
"""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

from morphgen.errors import MorphgenError
from morphgen.grammar.library import Library, default_library, note_left_out, shipped_folders
from morphgen.grammar.manifest import Manifest, PackageSource, PartKind

if TYPE_CHECKING:
    from morphgen.grammar.part import Part

FACTS_FILE = Path(__file__).with_name("part_facts.json")
"""Facts about morphgen's own parts, so that ``catalogue`` need not load them; see ``main``."""


def catalogue(library: Library, kind: str | None = None) -> list[dict[str, object]]:
    """Return facts about every part, or those of one kind, at default parameters.

    The reach [m] is from the mount to a port or the tool. What cannot be loaded is a line.
    """
    stored = stored_facts()
    rows: list[dict[str, object]] = []
    for manifest in library.manifests(cast(PartKind, kind)):
        try:
            facts = known_facts(manifest, stored) or compute_facts(manifest)
        except MorphgenError as error:
            place = "" if str(manifest.path) in str(error) else f"{manifest.path}: "
            note_left_out(f"{place}{error}")
            continue
        rows.append(
            {
                "name": manifest.name,
                "kind": manifest.kind,
                **{key: facts[key] for key in ("dof", "reach", "mass")},
                "source": _source_name(manifest),
                "licence": manifest.licence,
                "manufacturer": manifest.manufacturer,
                "summary": manifest.summary,
            }
        )
    return rows


def _source_name(manifest: Manifest) -> str:
    """Return the package of a part's files; ``own`` for those of a user."""
    if isinstance(manifest.source, PackageSource):
        return manifest.source.package
    is_shipped = any(manifest.path.is_relative_to(folder) for folder in shipped_folders())
    return "template" if is_shipped else "own"


def stored_facts() -> dict[str, dict[str, Any]]:
    """Return the stored facts by part, with the digest of the files that they are of."""
    return cast(dict[str, dict[str, Any]], json.loads(FACTS_FILE.read_text(encoding="utf-8")))


def known_facts(manifest: Manifest, stored: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the stored facts of a part without loading it; empty if its files are others."""
    facts = stored.get(manifest.name, {})
    return facts if facts.get("digest") == source_digest(manifest) else {}


def compute_facts(manifest: Manifest) -> dict[str, Any]:
    """Load a part and return its dof, reach [m], mass [kg] and the digest of its sources."""
    from morphgen.grammar.part import load_part  # slow: reads URDFs and meshes

    part = load_part(manifest)
    return {
        "digest": source_digest(manifest),
        "dof": part.fragment.dof,
        "reach": round(_reach(part), 3),
        "mass": round(part.fragment.mass, 3),
    }


def source_digest(manifest: Manifest) -> str:
    """Return a hash of a part's manifest and of its xacros or the version of its package."""
    digest = hashlib.sha256(manifest.path.read_bytes())
    if isinstance(manifest.source, PackageSource):
        digest.update(_version(manifest.source.package).encode())
    else:
        for path in sorted(manifest.source.parent.glob("*.xacro")):  # includes lie in the folder
            digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


@lru_cache(maxsize=16)
def _version(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"  # load_part explains what to install


def _reach(part: Part) -> float:
    """Return the largest distance from the mount to a port or tool over all configurations [m]."""
    from morphgen.model.kinematics import reach_from_root
    from morphgen.model.robot import Frame, Joint, Link

    ends = [*part.ports.values(), *([part.tool] if part.tool else [])]
    fragment = part.fragment
    T_mount_root = part.T_root_mount.inverse()
    mount_joint = Joint("mount_joint", "fixed", "mount_frame", fragment.root.name, T_mount_root)
    rooted_at_mount = replace(
        fragment,
        links=(Link("mount_frame"), *fragment.links),
        joints=(mount_joint, *fragment.joints),
        frames=tuple(Frame(f"end{i}", e.link, e.T_link_frame) for i, e in enumerate(ends)),
    )
    names = [frame.name for frame in rooted_at_mount.frames]
    return max((reach_from_root(rooted_at_mount, name) for name in names), default=0.0)


def main() -> None:
    """Compute the facts about morphgen's own parts and write ``part_facts.json``."""
    manifests = sorted(default_library().manifests(), key=lambda manifest: manifest.name)
    entries = [f"{json.dumps(m.name)}: {json.dumps(compute_facts(m))}" for m in manifests]
    FACTS_FILE.write_text("{\n" + ",\n".join(entries) + "\n}\n", encoding="utf-8")


if __name__ == "__main__":
    main()

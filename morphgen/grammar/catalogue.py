"""The catalogue: one row of facts a part."""

from __future__ import annotations

from dataclasses import replace
from typing import cast

from morphgen.grammar.library import Library
from morphgen.grammar.manifest import PackageSource, PartKind
from morphgen.grammar.part import Part, load_part
from morphgen.model.kinematics import reach
from morphgen.model.robot import Frame, Joint, Link


def catalogue(library: Library, kind: str | None = None) -> list[dict[str, object]]:
    """Facts about every part, or those of one kind, at default parameters.

    Returns:
        Rows with name, kind, dof, reach (m, to the farthest port or the tool), mass (kg),
        source, licence and summary.
    """
    return [_row(load_part(manifest)) for manifest in library.manifests(cast(PartKind, kind))]


def _row(part: Part) -> dict[str, object]:
    manifest = part.manifest
    source = manifest.source
    return {
        "name": manifest.name,
        "kind": manifest.kind,
        "dof": part.fragment.dof,
        "reach": round(_reach(part), 3),
        "mass": round(part.fragment.mass, 3),
        "source": source.package if isinstance(source, PackageSource) else "template",
        "licence": manifest.licence,
        "summary": manifest.summary,
    }


def _reach(part: Part) -> float:
    """Distance from the mount to the farthest port or tool, the largest over configurations."""
    ends = [*part.ports.values(), *([part.tool] if part.tool else [])]
    body = part.fragment
    T_mount_root = part.T_root_mount.inverse()
    stand = Joint("mount_joint", "fixed", "mount_frame", body.root.name, T_mount_root)
    stood = replace(
        body,
        links=(Link("mount_frame"), *body.links),
        joints=(stand, *body.joints),
        frames=tuple(Frame(f"end{i}", e.link, e.T_link_frame) for i, e in enumerate(ends)),
    )
    return max((reach(stood, frame.name) for frame in stood.frames), default=0.0)

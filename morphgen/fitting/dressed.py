"""A robot in other clothes: primitives in place of its meshes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.checks.self_collision import survey
from morphgen.errors import FitError
from morphgen.fitting.stored import VERSION, Stored, read_stored, stored_fit
from morphgen.model.geometry import Box, Cylinder, Shape, Sphere
from morphgen.model.robot import Link, Robot


def as_primitives(robot: Robot, folders: Sequence[Path]) -> Robot:
    """The robot with fitted primitives as its collision shapes.

    Links whose fit is stored in the folders take it; others are fitted now, which takes seconds.

    Args:
        robot: The body.
        folders: Folders of parts.

    Raises:
        FitError: If no primitive can stand for a link.
        MeshError: If a mesh cannot be read.
    """
    found, missing = stored_primitives(robot, read_stored(folders))
    if missing:
        # The search needs torch, which takes seconds to load.
        from morphgen.fitting.parts import COLLISION
        from morphgen.fitting.robot import fit_links

        report = fit_links(robot, COLLISION, only=missing)
        for finding in report.findings:
            if finding.severity != "info":
                raise FitError(f"{finding.where}: {finding.why}")
        found |= {row.link: row.fit.primitives for row in report.links}
    made = with_primitives(robot, found)
    return replace(made, provenance={**made.provenance, "primitives": {"fitter": VERSION}})


def with_primitives(
    robot: Robot, primitives: Mapping[str, Sequence[Shape]], *, visual: bool = False
) -> Robot:
    """The robot with primitives in place of its collision shapes.

    Masses and inertias stay; which pairs of links are not tested for collision is surveyed anew.

    Args:
        robot: The body.
        primitives: By link. Links without an entry lose their collision shapes if these are meshes.
        visual: Whether visuals are replaced, too.
    """
    links = tuple(_dressed(link, primitives.get(link.name, ()), visual) for link in robot.links)
    made = replace(robot, links=links, ignore_pairs=())
    return replace(made, ignore_pairs=survey(made).ignored)


def stored_primitives(
    robot: Robot, stored: Stored
) -> tuple[dict[str, tuple[Shape, ...]], list[str]]:
    """Primitives by link as they were fitted before, and the links of which nothing is stored."""
    found: dict[str, tuple[Shape, ...]] = {}
    missing = []
    for link in robot.links:
        if not link.collisions or are_primitives(link.collisions):
            found[link.name] = link.collisions
        elif fit := stored_fit(link.collisions, stored):
            found[link.name] = fit.collision
        else:
            missing.append(link.name)
    return found, missing


def link_shapes(link: Link) -> tuple[Shape, ...]:
    """What is fitted: the collision shapes, or visuals where there are no others."""
    return link.collisions or link.visuals


def _dressed(link: Link, shapes: Sequence[Shape], visual: bool) -> Link:
    shown = link.visuals[0].rgba if link.visuals else None
    coloured = tuple(replace(shape, rgba=shown) for shape in shapes)
    return replace(
        link,
        collisions=tuple(shapes) if link.collisions else (),
        visuals=coloured if visual and link.visuals else link.visuals,
    )


def are_primitives(shapes: Sequence[Shape]) -> bool:
    """Whether all shapes are boxes, cylinders and spheres."""
    return all(isinstance(shape.geometry, Box | Cylinder | Sphere) for shape in shapes)

"""Replace the collision meshes of a robot by fitted primitives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.checks.self_collision import survey_collisions
from morphgen.errors import FitError
from morphgen.formats.fits import FITTER_VERSION, find_fit, has_meshes, read_stored_fits, shapes_key
from morphgen.formats.rounding import as_written
from morphgen.model.geometry import Shape, StoredFit, StoredFits
from morphgen.model.robot import Link, Robot


def as_primitives(robot: Robot, folders: Sequence[Path]) -> Robot:
    """The robot as tasks have it: fitted primitives as its collision shapes, numbers as in a file.

    A fit that the robot brings, or that is stored in the folders, is taken; other links are fitted
    now, which takes seconds. The token of each link comes along. A robot, its bundle, whether with
    meshes or primitives, and what this made of them give the same.

    Args:
        robot: The body.
        folders: Folders of parts.

    Raises:
        FitError: If no primitive can stand for a link.
        FormatError: If a stored fit is malformed.
        MeshError: If a mesh cannot be read.
        RobotError: If an axis is zero.
    """
    fits = _known_fits(robot, read_stored_fits(folders))
    missing = [
        link.name for link in robot.links if link.name not in fits and has_meshes(link.collisions)
    ]
    if missing:
        from morphgen.fitting.part_fits import (  # loads torch, which takes seconds
            COLLISION_OPTIONS,
            fits_of,
        )
        from morphgen.fitting.robot_fit import fit_links

        report = fit_links(robot, COLLISION_OPTIONS, only=missing)
        for finding in report.findings:
            if finding.severity != "info":
                raise FitError(f"{finding.where}: {finding.why}")
        fits |= fits_of(robot, report, {})
    made = with_primitives(robot, {link: fit.collision for link, fit in fits.items()})
    return replace(
        with_fits(made, fits),
        provenance={**made.provenance, "primitives": {"fitter": FITTER_VERSION}},
    )


def with_fits(robot: Robot, fits: Mapping[str, StoredFit]) -> Robot:
    """The robot with fits of what its primitives were made of, for the tokens.

    Args:
        robot: The robot, with primitives as its collision shapes.
        fits: By link, at the scale of the link.
    """
    own = (
        replace(fits[link.name], collision=link.collisions)
        for link in robot.links
        if link.name in fits and link.collisions
    )
    return replace(robot, fits={shapes_key(fit.collision): fit for fit in own})


def with_primitives(
    robot: Robot, primitives: Mapping[str, Sequence[Shape]], *, visual: bool = False
) -> Robot:
    """The robot with primitives in place of its collision shapes, numbers as in a file.

    Masses and inertias stay; which pairs of links are not tested for collision is surveyed anew.

    Args:
        robot: The body.
        primitives: By link. Links without an entry keep their collision shapes if these are
            primitives, and lose them if they are meshes.
        visual: Whether visuals are replaced, too.

    Raises:
        RobotError: If an axis is zero.
    """
    links = tuple(_with_collision(link, primitives.get(link.name), visual) for link in robot.links)
    made = as_written(replace(robot, links=links, ignore_pairs=()))
    return replace(made, ignore_pairs=survey_collisions(made).ignore_pairs)


def stored_primitives(
    robot: Robot, stored: StoredFits
) -> tuple[dict[str, tuple[Shape, ...]], list[str]]:
    """Primitives by link as they were fitted before, and the links of which nothing is stored."""
    fits = _known_fits(robot, stored)
    found: dict[str, tuple[Shape, ...]] = {}
    missing = []
    for link in robot.links:
        if not has_meshes(link.collisions):
            found[link.name] = link.collisions
        elif link.name in fits:
            found[link.name] = fits[link.name].collision
        else:
            missing.append(link.name)
    return found, missing


def _known_fits(robot: Robot, stored: StoredFits) -> dict[str, StoredFit]:
    """Fits of links with collision shapes that the robot brings or that are stored."""
    found = {link.name: find_fit(link.collisions, robot, stored) for link in robot.links}
    return {name: fit for name, fit in found.items() if fit}


def _with_collision(link: Link, shapes: Sequence[Shape] | None, visual: bool) -> Link:
    if shapes is None:
        shapes = () if has_meshes(link.collisions) else link.collisions
    shown = link.visuals[0].rgba if link.visuals else None
    coloured = tuple(replace(shape, rgba=shown) for shape in shapes)
    return replace(
        link,
        collisions=tuple(shapes) if link.collisions else (),
        visuals=coloured if visual and link.visuals and shapes else link.visuals,
    )

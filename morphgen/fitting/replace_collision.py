"""Replace the collision meshes of a robot by fitted primitives."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.checks.self_collision import survey_collisions
from morphgen.fitting.fit_cache import cached_fits, fit_and_keep
from morphgen.formats.fits import (
    FITTER_VERSION,
    find_fit,
    has_meshes,
    read_stored_fits,
    shapes_key,
)
from morphgen.formats.rounding import as_written
from morphgen.model.geometry import Shape, StoredFit, StoredFits
from morphgen.model.robot import Link, Robot
from morphgen.processes import Progress, no_progress

_CACHE = f"fits-{FITTER_VERSION}"
"""Folder of the fits in the user's cache."""


def as_primitives(
    robot: Robot, folders: Sequence[Path], *, progress: Progress = no_progress
) -> Robot:
    """Return the robot as tasks use it: fitted collision primitives, numbers rounded as in a file.

    Fits that the robot carries or that the folders store are used. Other links with meshes are
    fitted once, which takes seconds per link and is logged, and their fits are cached. The result
    carries the token primitive of each link. A robot, its bundle (with meshes or primitives) and
    the result of this function all give the same result.

    Args:
        robot: The robot.
        folders: Folders of parts.
        progress: Receives the number of links that are fitted, and of all that need a fit.

    Raises:
        FitError: If a link has no volume to fit a primitive to.
        FormatError: If a stored fit is malformed.
        MeshError: If a mesh cannot be read.
        RobotError: If a joint axis is zero.
    """
    fits = _known_fits(robot, read_stored_fits(folders))
    if missing := _meshed_links(robot, fits):
        fits |= cached_fits(missing, _CACHE)
    if missing := _meshed_links(robot, fits):
        from morphgen.fitting.part_fits import COLLISION_OPTIONS  # imports torch, which takes long

        fits |= fit_and_keep(robot, missing, COLLISION_OPTIONS, _CACHE, {}, progress=progress)
    fitted = with_primitives(robot, {link: fit.collision for link, fit in fits.items()})
    return replace(
        with_fits(fitted, fits),
        provenance={**fitted.provenance, "primitives": {"fitter": FITTER_VERSION}},
    )


def _meshed_links(robot: Robot, fits: Mapping[str, StoredFit]) -> list[Link]:
    """Return the links that collide as meshes and have no fit."""
    return [link for link in robot.links if link.name not in fits and has_meshes(link.collisions)]


def with_fits(robot: Robot, fits: Mapping[str, StoredFit]) -> Robot:
    """Return the robot with the fits that its collision primitives come from, for its tokens.

    Args:
        robot: A robot with primitives as collision shapes.
        fits: Fits by link name, at the scale of the link.
    """
    fits_at_scale = (
        replace(fits[link.name], collision=link.collisions)
        for link in robot.links
        if link.name in fits and link.collisions
    )
    return replace(robot, fits={shapes_key(fit.collision): fit for fit in fits_at_scale})


def with_primitives(
    robot: Robot, primitives: Mapping[str, Sequence[Shape]], *, visual: bool = False
) -> Robot:
    """Return the robot with other collision primitives, numbers rounded as in a file.

    Masses and inertias stay. The pairs of links whose contacts are ignored are determined again.

    Args:
        robot: The robot.
        primitives: Collision primitives by link name. A link without an entry keeps its collision
            shapes if they are primitives, and loses them if they are meshes.
        visual: Replace the visuals, too.

    Raises:
        RobotError: If a joint axis is zero.
    """
    links = tuple(_with_collision(link, primitives.get(link.name), visual) for link in robot.links)
    fitted = as_written(replace(robot, links=links, ignore_pairs=()))
    return replace(fitted, ignore_pairs=survey_collisions(fitted).ignore_pairs)


def stored_primitives(
    robot: Robot, stored: StoredFits
) -> tuple[dict[str, tuple[Shape, ...]], list[str]]:
    """Return the known collision primitives by link name, and the links that have no known fit."""
    fits = _known_fits(robot, stored)
    primitives: dict[str, tuple[Shape, ...]] = {}
    missing = []
    for link in robot.links:
        if not has_meshes(link.collisions):
            primitives[link.name] = link.collisions
        elif link.name in fits:
            primitives[link.name] = fits[link.name].collision
        else:
            missing.append(link.name)
    return primitives, missing


def _known_fits(robot: Robot, stored: StoredFits) -> dict[str, StoredFit]:
    """Return the fits that the robot carries or that are stored, by link name."""
    fits = {link.name: find_fit(link.collisions, robot, stored) for link in robot.links}
    return {name: fit for name, fit in fits.items() if fit}


def _with_collision(link: Link, shapes: Sequence[Shape] | None, visual: bool) -> Link:
    if shapes is None:
        shapes = () if has_meshes(link.collisions) else link.collisions
    rgba = link.visuals[0].rgba if link.visuals else None
    coloured = tuple(replace(shape, rgba=rgba) for shape in shapes)
    return replace(
        link,
        collisions=tuple(shapes) if link.collisions else (),
        visuals=coloured if visual and link.visuals and shapes else link.visuals,
    )

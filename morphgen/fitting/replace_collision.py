"""Replace the collision meshes of a robot by fitted primitives."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from platformdirs import user_cache_path

from morphgen.checks.self_collision import survey_collisions
from morphgen.errors import FitError, FormatError
from morphgen.formats.fits import (
    FITTER_VERSION,
    find_fit,
    fits_text,
    has_meshes,
    keep_fit,
    read_fits,
    read_stored_fits,
    shapes_key,
    shapes_scale,
)
from morphgen.formats.rounding import as_written
from morphgen.model.geometry import Shape, StoredFit, StoredFits
from morphgen.model.robot import Link, Robot

if TYPE_CHECKING:
    from morphgen.fitting.link_fit import FitOptions


_LOGGER = logging.getLogger(__name__)


def cached_fits(links: Iterable[Link], kind: str) -> dict[str, StoredFit]:
    """Return the fits of links that are in the cache, by link name.

    links: Links with collision shapes.
    """
    fits = {}
    for link in links:
        key = shapes_key(link.collisions)
        path = _path(kind, key)
        if not path.is_file():
            continue
        try:
            fit = read_fits(path).get(key)
        except FormatError as error:
            raise FormatError(f"{error}; delete the file") from error
        if fit is not None:
            fits[link.name] = replace(fit.scaled(shapes_scale(link.collisions)), link=link.name)
    return fits


def fit_and_keep(
    robot: Robot,
    links: Sequence[Link],
    options: FitOptions,
    kind: str,
    stored: StoredFits,
    *,
    jobs: int = 1,
) -> dict[str, StoredFit]:
    """Fit primitives to links, say so, and keep the fits in the cache.

    links: Its links with collision shapes to fit.

    Returns:
        Fits by link name.
    """
    # These import torch, which takes seconds to load.
    from morphgen.fitting.part_fits import fits_of
    from morphgen.fitting.robot_fit import fit_links

    _LOGGER.warning(
        "fitting primitives to %d links of robot %r, seconds for each; the fits are kept",
        len(links),
        robot.name,
    )
    names = [link.name for link in links]
    report = fit_links(robot, options, only=names, jobs=jobs)
    for finding in report.findings:
        if finding.severity != "info":
            raise FitError(f"{finding.where}: {finding.why}")
    fits = fits_of(robot, report, stored)
    for name, fit in fits.items():
        shapes = robot.link(name).collisions
        key = shapes_key(shapes)
        keep_fit(_path(kind, key), fits_text({key: fit.scaled(1 / shapes_scale(shapes))}))
    return fits


def _path(kind: str, key: str) -> Path:
    return user_cache_path("morphgen") / kind / f"{key}.json"


_CACHE = f"fits-{FITTER_VERSION}"
"""Folder of the fits in the user's cache."""


def as_primitives(robot: Robot, folders: Sequence[Path]) -> Robot:
    """Return the robot as tasks use it: fitted collision primitives, numbers rounded as in a file.

    Fits that the robot carries or that the folders store are used. Other links with meshes are
    fitted once, which takes seconds per link and is logged, and their fits are cached. The result
    carries the token primitive of each link. A robot, its bundle (with meshes or primitives) and
    the result of this function all give the same result.
    """
    fits = _known_fits(robot, read_stored_fits(folders))
    if missing := _meshed_links(robot, fits):
        fits |= cached_fits(missing, _CACHE)
    if missing := _meshed_links(robot, fits):
        from morphgen.fitting.part_fits import COLLISION_OPTIONS  # imports torch, which takes long

        fits |= fit_and_keep(robot, missing, COLLISION_OPTIONS, _CACHE, {})
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

    robot: A robot with primitives as collision shapes.
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

    primitives: Collision primitives by link name. A link without an entry keeps its collision
        shapes if they are primitives, and loses them if they are meshes.
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

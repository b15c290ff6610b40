"""Replace the collision shapes of a robot: by fitted primitives, or by spheres alone."""

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
from morphgen.formats.srdf import LinkSpheres
from morphgen.model.geometry import Shape, Sphere, StoredFit, StoredFits
from morphgen.model.robot import Link, Robot

if TYPE_CHECKING:
    from morphgen.fitting.link_fit import FitOptions

SPHERES = 8  # default number of spheres per link
_SPHERE_CACHE = "spheres-1"
"""Folders in the cache begin so; the number rises when the same shapes get other spheres."""
_CACHE = f"fits-{FITTER_VERSION}"  # folder of the fits in the user's cache
_LOGGER = logging.getLogger(__name__)


def as_primitives(robot: Robot, folders: Sequence[Path]) -> Robot:
    """Return the robot as tasks use it: fitted collision primitives, numbers rounded as in a file.

    Fits that the robot carries or that the folders store are used. Other links with meshes are
    fitted once, which takes seconds per link and is logged, and their fits are cached. The result
    carries the token primitive of each link. A robot, its bundle (with meshes or primitives) and
    the result of this function all give the same result.
    """
    fits = _known_fits(robot, read_stored_fits(folders))
    if missing := _meshed_links(robot, fits):
        fits |= _cached_fits(missing, _CACHE)
    if missing := _meshed_links(robot, fits):
        from morphgen.fitting.robot_fit import COLLISION_OPTIONS  # imports torch, which takes long

        fits |= _fit_and_keep(robot, missing, COLLISION_OPTIONS, _CACHE, {})
    return _with_provenance(robot, fits, {"fitter": FITTER_VERSION})


def as_spheres(
    robot: Robot,
    folders: Sequence[Path] = (),
    *,
    spheres: int = SPHERES,
    cover: float | None = None,
    jobs: int = 1,
) -> Robot:
    """Return the robot with spheres as its collision shapes.

    A link whose collision shapes are spheres already keeps them. The spheres of the others come
    from the user's cache or from a new fit, about two seconds per link, which is then cached.
    Masses, inertias and visuals stay; the pairs of links whose contacts are ignored are determined
    again.
    """
    from morphgen.fitting.link_fit import FitOptions  # imports torch, which takes seconds

    options = FitOptions(spheres=spheres, cover=cover)
    stored = read_stored_fits(folders)
    links = [link for link in robot.links if link.collisions]
    others = [link for link in links if not has_only_spheres(link.collisions)]
    kind = f"{_SPHERE_CACHE}-{spheres}" + (f"-{cover!r}" if cover is not None else "")
    fits = _cached_fits(others, kind)
    if missing := [link for link in others if link.name not in fits]:
        fits |= _fit_and_keep(robot, missing, options, kind, stored, jobs=jobs)
    for link in links:
        if has_only_spheres(link.collisions) and (fit := find_fit(link.collisions, robot, stored)):
            fits[link.name] = fit
    settings = {"fitter": FITTER_VERSION, "spheres": spheres, "cover": cover}
    return _with_provenance(robot, fits, settings)


def _with_provenance(
    robot: Robot, fits: Mapping[str, StoredFit], settings: Mapping[str, object]
) -> Robot:
    """Return the robot with the collision shapes of fits, which it carries, and says how."""
    fitted = with_primitives(robot, {link: fit.collision for link, fit in fits.items()})
    provenance = {**fitted.provenance, "primitives": settings}
    return replace(with_fits(fitted, fits), provenance=provenance)


def has_only_spheres(shapes: Sequence[Shape]) -> bool:
    """Return whether there are shapes, and all are spheres."""
    return bool(shapes) and all(isinstance(shape.geometry, Sphere) for shape in shapes)


def link_spheres(robot: Robot) -> tuple[LinkSpheres, ...]:
    """Return the spheres of the links whose collision shapes are all spheres."""
    return tuple(
        LinkSpheres(
            link.name,
            tuple(
                (shape.T_link_shape.position, shape.geometry.radius)
                for shape in link.collisions
                if isinstance(shape.geometry, Sphere)
            ),
        )
        for link in robot.links
        if has_only_spheres(link.collisions)
    )


def _cached_fits(links: Iterable[Link], kind: str) -> dict[str, StoredFit]:
    """Return the fits of links with collision shapes that are in the cache, by link name."""
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


def _fit_and_keep(
    robot: Robot,
    links: Sequence[Link],
    options: FitOptions,
    kind: str,
    stored: StoredFits,
    *,
    jobs: int = 1,
) -> dict[str, StoredFit]:
    """Fit links with collision shapes, say so, keep the fits in the cache, and return them."""
    from morphgen.fitting.robot_fit import fit_links, fits_of  # imports torch, which takes long

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


def _meshed_links(robot: Robot, fits: Mapping[str, StoredFit]) -> list[Link]:
    """Return the links that collide as meshes and have no fit."""
    return [link for link in robot.links if link.name not in fits and has_meshes(link.collisions)]


def with_fits(robot: Robot, fits: Mapping[str, StoredFit]) -> Robot:
    """Return a robot with collision primitives with the fits that they are of, for its tokens."""
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


def stored_primitives(
    robot: Robot, stored: StoredFits
) -> tuple[dict[str, tuple[Shape, ...]], list[str]]:
    """Return the known collision primitives by link name, and the links that have no known fit."""
    fits = _known_fits(robot, stored)
    primitives = {
        link.name: fits[link.name].collision if has_meshes(link.collisions) else link.collisions
        for link in robot.links
        if link.name in fits or not has_meshes(link.collisions)
    }
    return primitives, [link.name for link in robot.links if link.name not in primitives]


def _known_fits(robot: Robot, stored: StoredFits) -> dict[str, StoredFit]:
    """Return the fits that the robot carries or that are stored, by link name."""
    fits = {link.name: find_fit(link.collisions, robot, stored) for link in robot.links}
    return {name: fit for name, fit in fits.items() if fit}

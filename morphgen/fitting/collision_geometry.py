"""The geometries that a robot's collision shapes can be replaced by, by name."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, get_args

from morphgen.errors import FitError, nearest
from morphgen.fitting.replace_collision import (
    as_primitives,
    cached_fits,
    fit_and_keep,
    with_fits,
    with_primitives,
)
from morphgen.formats.fits import FITTER_VERSION, MAX_PRIMITIVES, find_fit, read_stored_fits
from morphgen.formats.srdf import BoundingSphere, LinkSpheres
from morphgen.model.geometry import Shape, Sphere
from morphgen.model.robot import Link, Robot

SPHERES = 8
"""Default number of spheres per link."""
MAX_SPHERES = MAX_PRIMITIVES
"""Largest number of spheres per link."""
_CACHE = "spheres-1"
"""Folders in the cache begin so; the number rises when the same shapes get other spheres."""


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
    kind = f"{_CACHE}-{spheres}" if cover is None else f"{_CACHE}-{spheres}-{cover!r}"
    fits = cached_fits(others, kind)
    if missing := [link for link in others if link.name not in fits]:
        fits |= fit_and_keep(robot, missing, options, kind, stored, jobs=jobs)
    for link in links:
        if has_only_spheres(link.collisions) and (fit := find_fit(link.collisions, robot, stored)):
            fits[link.name] = fit
    fitted = with_primitives(robot, {name: fit.collision for name, fit in fits.items()})
    settings = {"fitter": FITTER_VERSION, "spheres": spheres, "cover": cover}
    return replace(
        with_fits(fitted, fits), provenance={**fitted.provenance, "primitives": settings}
    )


def has_only_spheres(shapes: Sequence[Shape]) -> bool:
    """Return whether there are shapes, and all are spheres."""
    return bool(shapes) and all(isinstance(shape.geometry, Sphere) for shape in shapes)


def link_spheres(robot: Robot) -> tuple[LinkSpheres, ...]:
    """Return the spheres of the links whose collision shapes are all spheres."""
    return tuple(
        LinkSpheres(link.name, tuple(_bounding_spheres(link)))
        for link in robot.links
        if has_only_spheres(link.collisions)
    )


def _bounding_spheres(link: Link) -> Iterator[BoundingSphere]:
    for shape in link.collisions:
        if isinstance(shape.geometry, Sphere):
            yield BoundingSphere(shape.T_link_shape.position, shape.geometry.radius)


Geometry = Literal["mesh", "primitive", "convex", "sphere"]
"""Collision shapes of a robot. ``mesh``: those of its parts, with meshes whose hulls simulators
collide. In place of meshes, ``primitive``: fitted boxes, cylinders and spheres; ``convex``: convex
pieces. ``sphere``: spheres in place of all shapes."""
GEOMETRIES: tuple[Geometry, ...] = get_args(Geometry)


def with_geometry(robot: Robot, geometry: str, folders: Sequence[Path]) -> Robot:
    """Return the robot with the collision shapes of a geometry."""
    if geometry not in GEOMETRIES:
        raise FitError(f"unknown geometry {geometry!r}{nearest(geometry, GEOMETRIES)}")
    if geometry == "primitive":
        return as_primitives(robot, folders)
    if geometry == "convex":
        from morphgen.fitting.convex_pieces import as_convex  # imports trimesh

        return as_convex(robot, folders)
    if geometry == "sphere":
        return as_spheres(robot, folders)
    return robot

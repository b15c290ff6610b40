"""Fit the parts of a library that have meshes, and store the fits beside their manifests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.fitting.link_fit import FitOptions, LinkFit, fit_shapes
from morphgen.fitting.quality import quality
from morphgen.fitting.robot_fit import FitReport, fit_links
from morphgen.fitting.solid import solid_of
from morphgen.fitting.token_shapes import token_of_primitives
from morphgen.formats.files import write_file
from morphgen.formats.fits import (
    SUFFIX,
    are_primitives,
    find_fit,
    fits_text,
    has_meshes,
    read_stored_fits,
    shapes_key,
    shapes_scale,
    shapes_to_fit,
)
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest
from morphgen.grammar.part import load_part
from morphgen.model.geometry import Shape, StoredFit, StoredFits
from morphgen.model.robot import Robot
from morphgen.processes import parallel_map

TOKEN_OPTIONS = FitOptions(max_primitives=1)
"""Options of the primitive in a link's token."""
COLLISION_OPTIONS = FitOptions(max_primitives=4, iou=0.9)
"""Options of the primitives that replace a link's collision meshes."""


def parts_with_meshes(library: Library, *, missing: bool = False) -> list[Manifest]:
    """Return the parts that have meshes, except those that are another part at another scale."""
    stored = read_stored_fits(library.folders) if missing else {}
    return [
        manifest
        for manifest in library.manifests()
        if not manifest.scaling and _mesh_keys(manifest) - stored.keys()
    ]


def store_parts(manifests: Sequence[Manifest], *, jobs: int = 1) -> Iterator[Path]:
    """Fit and store several parts; yield the path of each file when it is written."""
    yield from parallel_map(store_part, manifests, jobs, chunk=1)


def store_part(manifest: Manifest) -> Path:
    """Fit the links of a part, write the fits beside its manifest, and return the path."""
    fragment = load_part(manifest).fragment
    fits = {}
    for report in fit_links(fragment, COLLISION_OPTIONS).links:
        shapes = shapes_to_fit(fragment.link(report.link))
        fit = _with_token(report.link, shapes, report.fit)
        fits[shapes_key(shapes)] = fit.scaled(1 / shapes_scale(shapes))
    path = manifest.path.with_name(manifest.path.stem + SUFFIX)
    write_file(path, fits_text(fits))
    return path


def fits_of(robot: Robot, report: FitReport, stored: StoredFits) -> dict[str, StoredFit]:
    """Return the fits of a report by link name, each with the primitive of the link's token.

    The token's primitive is the known one if the robot carries it or it is stored.
    """
    fits = {}
    for row in report.links:
        shapes = shapes_to_fit(robot.link(row.link))
        if known := find_fit(shapes, robot, stored):
            fits[row.link] = replace(
                known, collision=row.fit.primitives, collision_iou=row.fit.quality.iou
            )
        else:
            fits[row.link] = _with_token(row.link, shapes, row.fit)
    return fits


def _with_token(link: str, shapes: Sequence[Shape], fit: LinkFit) -> StoredFit:
    """Return a link's fit with the primitive of its token, which is fitted if it is missing."""
    solid = solid_of(shapes)
    single = fit.single
    if single is None and are_primitives(shapes):
        single = token_of_primitives(shapes)
    if single is None:
        (single,) = fit_shapes(shapes, TOKEN_OPTIONS, solid=solid).primitives
    token_iou = quality(solid, [single]).iou
    return StoredFit(link, single, fit.primitives, token_iou, fit.quality.iou)


def _mesh_keys(manifest: Manifest) -> set[str]:
    """Return the keys of the shapes of links with meshes."""
    links = (shapes_to_fit(link) for link in load_part(manifest).fragment.links)
    return {shapes_key(shapes) for shapes in links if has_meshes(shapes)}

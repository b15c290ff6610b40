"""Fit the real parts of a library and store the result beside their manifests."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from morphgen.fitting.link_fit import FitOptions, LinkFit, fit_shapes
from morphgen.fitting.quality import quality
from morphgen.fitting.robot_fit import FitReport, fit_links
from morphgen.fitting.solid import solid_of
from morphgen.formats.files import write_file
from morphgen.formats.fits import (
    SUFFIX,
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
COLLISION_OPTIONS = FitOptions(max_primitives=4, iou=0.9)


def parts_with_meshes(library: Library, *, missing: bool = False) -> list[Manifest]:
    """Parts that have meshes, templates among them, but for those that are scaled ones of another.

    Args:
        library: Where they are.
        missing: Leave out those of which every link is stored.
    """
    stored = read_stored_fits(library.folders) if missing else {}
    return [
        manifest
        for manifest in library.manifests()
        if not manifest.scaling and _keys(manifest) - stored.keys()
    ]


def store_parts(manifests: Sequence[Manifest], *, jobs: int = 1) -> Iterator[Path]:
    """Fit and store several parts; gives every file that is done.

    Args:
        manifests: The parts.
        jobs: Processes, each of which takes a part at a time.

    Raises:
        FormatError: If a file cannot be written.
        MeshError: If a mesh cannot be read.
        MorphgenError: If a process died.
    """
    yield from parallel_map(store_part, manifests, jobs, chunk=1)


def store_part(manifest: Manifest) -> Path:
    """Fit a part's links and write them beside its manifest.

    Raises:
        FormatError: If the file cannot be written.
        MeshError: If a mesh cannot be read.
    """
    body = load_part(manifest).fragment
    fits = {}
    for row in fit_links(body, COLLISION_OPTIONS).links:
        shapes = shapes_to_fit(body.link(row.link))
        fits[shapes_key(shapes)] = stored_of(row.link, shapes, row.fit).scaled(
            1 / shapes_scale(shapes)
        )
    path = manifest.path.with_name(manifest.path.stem + SUFFIX)
    write_file(path, fits_text(fits))
    return path


def fits_of(robot: Robot, report: FitReport, stored: StoredFits) -> dict[str, StoredFit]:
    """The fits of a report by link; tokens are those of the robot, if fits of it are known.

    Args:
        robot: The robot that was fitted.
        report: Its fits.
        stored: What folders of parts store.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    found = {}
    for row in report.links:
        shapes, worth = shapes_to_fit(robot.link(row.link)), row.fit.quality.iou
        known = find_fit(shapes, robot, stored)
        found[row.link] = (
            replace(known, collision=row.fit.primitives, collision_iou=worth)
            if known
            else stored_of(row.link, shapes, row.fit)
        )
    return found


def stored_of(link: str, shapes: Sequence[Shape], fit: LinkFit) -> StoredFit:
    """A link's fit with the one primitive for its token, which is sought if the fit has none.

    Args:
        link: The link.
        shapes: What was fitted.
        fit: The fit.
    """
    solid = solid_of(shapes)
    single = fit.single or fit_shapes(shapes, TOKEN_OPTIONS, solid=solid).primitives[0]
    token_iou = quality(solid, [single]).iou
    return StoredFit(link, single, fit.primitives, token_iou, fit.quality.iou)


def _keys(manifest: Manifest) -> set[str]:
    """Keys of links with meshes."""
    links = (shapes_to_fit(link) for link in load_part(manifest).fragment.links)
    return {shapes_key(shapes) for shapes in links if has_meshes(shapes)}

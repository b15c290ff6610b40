"""Fit primitives to every link of a robot, and store the fits of parts beside their manifests."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from morphgen.errors import FitError
from morphgen.fitting.link_fit import FitOptions, LinkFit, Quality, fit_shapes, quality
from morphgen.fitting.solid import Solid, solid_of
from morphgen.fitting.token_shapes import token_of_primitives
from morphgen.formats import fits as fit_files
from morphgen.formats.files import write_file
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import Manifest
from morphgen.grammar.part import load_part
from morphgen.model.findings import Finding
from morphgen.model.geometry import Shape, StoredFit, StoredFits
from morphgen.model.robot import Link, Robot
from morphgen.processes import parallel_map

TOKEN_OPTIONS = FitOptions(max_primitives=1)  # options of the primitive in a link's token
COLLISION_OPTIONS = FitOptions(max_primitives=4, iou=0.9)
"""Options of the primitives that replace a link's collision meshes."""


@dataclass(frozen=True)
class LinkReport:
    """The fit of one link."""

    link: str
    fit: LinkFit
    same_as: str | None = None  # the link of the same shapes whose fit this link shares


@dataclass(frozen=True)
class FitReport:
    """The fits of the links of a robot."""

    robot: str
    options: FitOptions
    links: tuple[LinkReport, ...]  # links with shapes, in the robot's order
    findings: tuple[Finding, ...]  # links without a primitive, and meshes that were decimated

    @property
    def mean(self) -> Quality | None:
        """Means over the links, of Hausdorff distances the largest; None without links."""
        if not self.links:
            return None
        values = {
            name: [getattr(report.fit.quality, name) for report in self.links]
            for name in Quality.__dataclass_fields__
        }
        means = {name: float(np.mean(column)) for name, column in values.items()}
        return Quality(**means | {"hausdorff": max(values["hausdorff"])})

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON: equal for the same robot, options and seed."""
        options = self.options
        of_spheres, of_primitives = ("spheres", "cover"), ("max_primitives", "iou")
        names = of_primitives if options.spheres is None else of_spheres
        return {
            "robot": self.robot,
            **{name: getattr(options, name) for name in names},
            "seed": options.seed,
            "links": [
                {"link": report.link, "same_as": report.same_as, **report.fit.as_dict()}
                for report in self.links
            ],
            "findings": [finding.as_dict() for finding in self.findings],
        }


def fit_links(
    robot: Robot, options: FitOptions, *, only: Collection[str] | None = None, jobs: int = 1
) -> FitReport:
    """Fit the collision shapes, or visuals, of every link or of some; equal links share one."""
    solids: dict[str, Solid] = {}
    failures: dict[str, FitError] = {}
    links = [
        link for link in robot.links if link.solid_shapes and (only is None or link.name in only)
    ]
    for link in links:
        try:
            solids[link.name] = solid_of(link.solid_shapes)
        except FitError as error:
            failures[link.name] = error
    firsts: dict[tuple[str, float], Link] = {}
    shared = []
    for link in (link for link in links if link.name in solids):
        shapes = link.solid_shapes
        key = (fit_files.shapes_key(shapes), fit_files.shapes_scale(shapes))
        shared.append((link, firsts.setdefault(key, link)))
    unique = list(firsts.values())
    inputs = [(link.solid_shapes, solids[link.name]) for link in unique]
    # A fit takes seconds: one item a worker at a time.
    attempts = parallel_map(partial(_try_fit, options), inputs, jobs, chunk=1)
    fits = {link.name: fit for link, fit in zip(unique, attempts, strict=True)}
    reports = []
    for link, first in shared:
        fit = fits[first.name]
        if isinstance(fit, FitError):
            failures[link.name] = fit
        elif link is first:
            reports.append(LinkReport(link.name, fit))
        else:
            reports.append(LinkReport(link.name, fit, first.name))
    findings = []
    for link in links:
        where, solid = f"link {link.name}", solids.get(link.name)
        if link.name in failures:
            why = f"no primitive can stand for its shapes: {failures[link.name]}"
            fix = "give the link a collision shape with a volume, or none"
            findings.append(Finding("no-primitive", "warning", where, why, fix))
        elif solid and solid.decimated_from:
            counts = f"{solid.decimated_from} triangles were decimated to {len(solid.mesh.faces)}"
            fix = "give the link a lighter collision mesh"
            findings.append(Finding("mesh-decimated", "info", where, f"its {counts}", fix))
    return FitReport(robot.name, options, tuple(reports), tuple(findings))


def _try_fit(options: FitOptions, work: tuple[tuple[Shape, ...], Solid]) -> LinkFit | FitError:
    """Return the error instead: a link without a fit does not end the fits of the others."""
    shapes, solid = work
    try:
        return fit_shapes(shapes, options, solid=solid)
    except FitError as error:
        return error


def parts_without_fits(library: Library) -> list[Manifest]:
    """Return unscaled parts with meshes whose fits are not all stored."""
    stored = fit_files.read_stored_fits(library.folders)
    return [
        manifest
        for manifest in library.manifests()
        if not manifest.scaling and _mesh_keys(manifest) - stored.keys()
    ]


def _mesh_keys(manifest: Manifest) -> set[str]:
    shapes = (link.solid_shapes for link in load_part(manifest).fragment.links)
    return {fit_files.shapes_key(each) for each in shapes if fit_files.has_meshes(each)}


def store_part(manifest: Manifest) -> Path:
    """Fit the links of a part, write the fits beside its manifest, and return the path."""
    fragment = load_part(manifest).fragment
    fits = {}
    for report in fit_links(fragment, COLLISION_OPTIONS).links:
        shapes = fragment.link(report.link).solid_shapes
        fit = _with_token(report.link, shapes, report.fit)
        fits[fit_files.shapes_key(shapes)] = fit.scaled(1 / fit_files.shapes_scale(shapes))
    path = manifest.path.with_name(manifest.path.stem + fit_files.SUFFIX)
    write_file(path, fit_files.fits_text(fits))
    return path


def fits_of(robot: Robot, report: FitReport, stored: StoredFits) -> dict[str, StoredFit]:
    """Return a report's fits by link, each with the link's token, by preference the known one."""
    fits = {}
    for row in report.links:
        shapes = robot.link(row.link).solid_shapes
        if known := fit_files.find_fit(shapes, robot, stored):
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
    if single is None and fit_files.are_primitives(shapes):
        single = token_of_primitives(shapes)
    if single is None:
        fitted = fit_shapes(shapes, TOKEN_OPTIONS, solid=solid)
        (single,), token_iou = fitted.primitives, fitted.quality.iou
    elif fit.primitives == (single,):
        token_iou = fit.quality.iou
    else:
        token_iou = quality(solid, [single]).iou
    return StoredFit(link, single, fit.primitives, token_iou, fit.quality.iou)

"""Fit primitives to every link of a robot."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import numpy as np

from morphgen.errors import FitError
from morphgen.fitting.congruence import moved, representatives
from morphgen.fitting.link_fit import FitOptions, LinkFit, fit_shapes
from morphgen.fitting.quality import Quality, quality
from morphgen.fitting.solid import Solid, solid_of
from morphgen.formats.fits import shapes_to_fit
from morphgen.model.findings import Finding
from morphgen.model.geometry import Shape
from morphgen.model.robot import Link, Robot
from morphgen.processes import parallel_map


@dataclass(frozen=True)
class LinkReport:
    """The fit of one link."""

    link: str
    fit: LinkFit
    same_as: str | None = None
    """The congruent link whose fit this link shares."""


@dataclass(frozen=True)
class FitReport:
    """The fits of the links of a robot."""

    robot: str
    options: FitOptions
    links: tuple[LinkReport, ...]
    """Links with shapes, in the robot's order."""
    findings: tuple[Finding, ...]
    """Links without a primitive, and meshes that were decimated."""

    @property
    def mean(self) -> Quality | None:
        """Mean quality over the links, but the largest Hausdorff distance; None without links."""
        if not self.links:
            return None
        qualities = [report.fit.quality for report in self.links]
        means = {
            name: float(np.mean([getattr(quality, name) for quality in qualities]))
            for name in Quality.__dataclass_fields__
        }
        return Quality(**means | {"hausdorff": max(quality.hausdorff for quality in qualities)})

    def without_times(self) -> dict[str, object]:
        """Return plain data for a bundle's card: equal for the same robot, options and seed."""
        data = self.as_dict()
        for link in cast(list[dict[str, object]], data["links"]):
            del link["seconds"]
        return data

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON."""
        options = self.options
        settings: dict[str, object]
        if options.spheres is not None:
            settings = {"spheres": options.spheres, "cover": options.cover}
        else:
            settings = {
                "max_primitives": options.max_primitives,
                "iou": options.iou,
                "enclose": options.enclose,
            }
        return {
            "robot": self.robot,
            **settings,
            "seed": options.seed,
            "links": [
                {"link": report.link, "same_as": report.same_as, **report.fit.as_dict()}
                for report in self.links
            ],
            "findings": [finding.as_dict() for finding in self.findings],
        }


def fit_links(
    robot: Robot,
    options: FitOptions,
    *,
    only: Collection[str] | None = None,
    jobs: int = 1,
) -> FitReport:
    """Fit the collision shapes of every link, or its visuals if it has no collision shapes.

    Congruent links, mirrored ones included, share one fit.

    only: Names of the links to fit; by default all that have shapes.
    """
    solids: dict[str, Solid] = {}
    failures: dict[str, FitError] = {}
    links = [
        link for link in robot.links if shapes_to_fit(link) and (only is None or link.name in only)
    ]
    for link in links:
        try:
            solids[link.name] = solid_of(shapes_to_fit(link))
        except FitError as error:
            failures[link.name] = error
    solid_links = [link for link in links if link.name in solids]
    shared = representatives([solids[link.name].mesh for link in solid_links])
    unique = [link for i, link in enumerate(solid_links) if shared[i][0] == i]
    inputs = [(shapes_to_fit(link), solids[link.name]) for link in unique]
    attempts = parallel_map(partial(_try_fit, options), inputs, jobs, chunk=1)
    fits = {link.name: fit for link, fit in zip(unique, attempts, strict=True)}
    reports = []
    for i, link in enumerate(solid_links):
        first, T_link_first = shared[i]
        fit = fits[solid_links[first].name]
        if isinstance(fit, FitError):
            failures[link.name] = fit
        elif i == first:
            reports.append(LinkReport(link.name, fit))
        else:
            primitives = tuple(moved(shape, T_link_first) for shape in fit.primitives)
            single = fit.single and moved(fit.single, T_link_first)
            measured = quality(solids[link.name], primitives)
            copy = replace(fit, primitives=primitives, single=single, quality=measured, seconds=0.0)
            reports.append(LinkReport(link.name, copy, solid_links[first].name))
    findings = [
        _no_primitive(link, failures[link.name])
        if link.name in failures
        else _decimated(link, solids[link.name])
        for link in links
        if link.name in failures or solids[link.name].decimated_from
    ]
    return FitReport(robot.name, options, tuple(reports), tuple(findings))


def _try_fit(options: FitOptions, work: tuple[tuple[Shape, ...], Solid]) -> LinkFit | FitError:
    shapes, solid = work
    try:
        return fit_shapes(shapes, options, solid=solid)
    except FitError as error:
        return error


def _no_primitive(link: Link, error: FitError) -> Finding:
    return Finding(
        "no-primitive",
        "warning",
        f"link {link.name}",
        f"no primitive can stand for its shapes: {error}",
        "give the link a collision shape with a volume, or none",
    )


def _decimated(link: Link, solid: Solid) -> Finding:
    return Finding(
        "mesh-decimated",
        "info",
        f"link {link.name}",
        f"its {solid.decimated_from} triangles were decimated to {len(solid.mesh.faces)}",
        "give the link a lighter collision mesh",
    )

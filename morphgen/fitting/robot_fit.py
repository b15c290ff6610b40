"""Fit every link of a robot."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
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

Progress = Callable[[str], object]
"""Told the name of every link that is done."""
Attempt = LinkFit | FitError


@dataclass(frozen=True)
class LinkReport:
    """A link's fit."""

    link: str
    fit: LinkFit
    same_as: str | None = None
    """The link whose fit was taken over, because the two are congruent."""


@dataclass(frozen=True)
class FitReport:
    """The fits of a robot's links."""

    robot: str
    options: FitOptions
    links: tuple[LinkReport, ...]
    """Links with shapes, in the robot's order."""
    findings: tuple[Finding, ...]
    """Links that no primitive can stand for, and meshes that were decimated."""

    @property
    def mean(self) -> Quality | None:
        """Mean over the links; the largest of Hausdorff distances. None without links."""
        if not self.links:
            return None
        each = [report.fit.quality for report in self.links]
        means = {
            name: float(np.mean([getattr(q, name) for q in each]))
            for name in Quality.__dataclass_fields__
        }
        return Quality(**means | {"hausdorff": max(q.hausdorff for q in each)})

    def without_times(self) -> dict[str, object]:
        """Plain data for a card: the same for the same robot and seed."""
        data = self.as_dict()
        for link in cast(list[dict[str, object]], data["links"]):
            del link["seconds"]
        return data

    def as_dict(self) -> dict[str, object]:
        """Plain data for JSON."""
        return {
            "robot": self.robot,
            "max_primitives": self.options.max_primitives,
            "iou": self.options.iou,
            "enclose": self.options.enclose,
            "seed": self.options.seed,
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
    progress: Progress = lambda link: None,
) -> FitReport:
    """Fit the collision shapes of every link, or its visuals where it has no others.

    Links that are congruent, also by mirroring, are fitted once.

    Args:
        robot: The body.
        options: What is wanted.
        only: Names of links; by default all that have shapes.
        jobs: Processes; the result does not depend on them.
        progress: Told of every link that is done.

    Raises:
        MeshError: If a mesh cannot be read.
        MorphgenError: If a process died.
    """
    links = [
        link for link in robot.links if shapes_to_fit(link) and (only is None or link.name in only)
    ]
    solids = {link.name: _try_solid(link) for link in links}
    found = [link for link in links if isinstance(solids[link.name], Solid)]
    first = representatives([_solid(solids[link.name]).mesh for link in found])
    unique = [link for i, link in enumerate(found) if first[i][0] == i]
    fits = _fit_all(unique, solids, options, jobs, progress)
    reports, findings = [], []
    for i, link in enumerate(found):
        j, T_link_first = first[i]
        fit = fits[found[j].name]
        if isinstance(fit, FitError):
            solids[link.name] = fit
            continue
        if i == j:
            reports.append(LinkReport(link.name, fit))
            continue
        shapes = tuple(moved(shape, T_link_first) for shape in fit.primitives)
        worth = quality(_solid(solids[link.name]), shapes)
        single = fit.single and moved(fit.single, T_link_first)
        taken = replace(fit, primitives=shapes, single=single, quality=worth, seconds=0.0)
        reports.append(LinkReport(link.name, taken, found[j].name))
    for link in links:
        solid = solids[link.name]
        if isinstance(solid, FitError):
            findings.append(_no_primitive(link.name, solid))
        elif solid.decimated_from:
            findings.append(_decimated(link.name, solid))
    return FitReport(robot.name, options, tuple(reports), tuple(findings))


def _fit_all(
    links: Sequence[Link],
    solids: Mapping[str, Solid | FitError],
    options: FitOptions,
    jobs: int,
    progress: Progress,
) -> dict[str, Attempt]:
    work = [(shapes_to_fit(link), _solid(solids[link.name])) for link in links]
    attempts = parallel_map(partial(_try_fit, options), work, jobs, chunk=1)
    fits: dict[str, Attempt] = {}
    for link, fit in zip(links, attempts, strict=True):
        fits[link.name] = fit
        progress(link.name)
    return fits


def _try_fit(options: FitOptions, work: tuple[tuple[Shape, ...], Solid]) -> Attempt:
    shapes, solid = work
    try:
        return fit_shapes(shapes, options, solid=solid)
    except FitError as error:
        return error


def _try_solid(link: Link) -> Solid | FitError:
    try:
        return solid_of(shapes_to_fit(link))
    except FitError as error:
        return error


def _solid(solid: Solid | FitError) -> Solid:
    if isinstance(solid, FitError):
        raise solid
    return solid


def _no_primitive(link: str, error: FitError) -> Finding:
    return Finding(
        "no-primitive",
        "warning",
        f"link {link}",
        f"no primitive can stand for its shapes: {error}",
        "give the link a collision shape with a volume, or none",
    )


def _decimated(link: str, solid: Solid) -> Finding:
    return Finding(
        "mesh-decimated",
        "info",
        f"link {link}",
        f"its {solid.decimated_from} triangles were decimated to {len(solid.mesh.faces)}",
        "give the link a lighter collision mesh",
    )

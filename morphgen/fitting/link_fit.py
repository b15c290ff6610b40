"""Fit one or several primitives to the shapes of one link, and measure the fit."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from morphgen.errors import FitError
from morphgen.fitting import search
from morphgen.fitting.quality import Quality, quality
from morphgen.fitting.solid import Solid, solid_of
from morphgen.formats.fits import MAX_PRIMITIVES, are_primitives, shape_to_data
from morphgen.model.geometry import Shape, Sphere

MAX_COVER = 0.9999
"""Largest share that spheres can be required to cover: more cannot be counted on sample points."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit."""

    max_primitives: int = 1  # largest number of primitives per link
    iou: float = 0.9  # intersection over union at which no further primitive is added
    seed: int = 0  # seed of the sample points and of the clusterings
    spheres: int | None = None
    """Number of spheres per link, of a fit with spheres alone; None for a fit with primitives."""
    cover: float | None = None
    """Share of a link's volume that its spheres must cover; None for the largest IoU."""

    def __post_init__(self) -> None:
        """Check the values."""
        if self.spheres is not None:
            if not 1 <= self.spheres <= MAX_PRIMITIVES:
                raise FitError(f"{self.spheres} spheres: expected 1 to {MAX_PRIMITIVES} per link")
            if self.max_primitives != 1:
                raise FitError("a fit of spheres takes no max_primitives")
        if self.cover is not None:
            if self.spheres is None:
                raise FitError(f"cover {self.cover:g}: expected a number of spheres, too")
            if not 0 < self.cover <= MAX_COVER:
                raise FitError(f"cover {self.cover:g}: expected more than 0, at most {MAX_COVER}")
        if not 1 <= self.max_primitives <= MAX_PRIMITIVES:
            raise FitError(f"{self.max_primitives} primitives: expected 1 to {MAX_PRIMITIVES}")
        if not 0 < self.iou <= 1:
            raise FitError(f"IoU {self.iou}: expected more than 0, at most 1")
        if self.seed < 0:
            raise FitError(f"seed {self.seed}: expected 0 or more")


@dataclass(frozen=True)
class LinkFit:
    """Primitives that replace the shapes of a link, with their measured quality."""

    primitives: tuple[Shape, ...]  # boxes, cylinders and spheres in the link frame
    single: Shape | None  # the single primitive of largest overlap; None if it was not searched for
    solid: str  # how the solid was made, see `solid.Method`; `primitives` if the shapes were kept
    quality: Quality
    seconds: float  # duration of the fit [s]; 0 for a link that shares the fit of another
    decimated_from: int | None = None
    """Number of triangles before decimation; None if the mesh was not decimated."""

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON: metres, (x, y, z) and (w, x, y, z)."""
        return {
            "primitives": [shape_to_data(shape) for shape in self.primitives],
            "solid": self.solid,
            "decimated_from": self.decimated_from,
            "quality": {name: float(f"{v:.6g}") for name, v in asdict(self.quality).items()},
            "seconds": round(self.seconds, 2),
        }


def fit_shapes(
    shapes: Sequence[Shape], options: FitOptions, *, solid: Solid | None = None
) -> LinkFit:
    """Fit the shapes of one link in its frame, or keep few primitives of the wanted kinds."""
    start = time.perf_counter()
    solid = solid or solid_of(shapes)
    is_kept = are_primitives(shapes) and len(shapes) <= options.max_primitives
    if options.spheres is not None:
        is_kept = all(isinstance(shape.geometry, Sphere) for shape in shapes)
    if is_kept:
        kept = tuple(replace(shape, rgba=None) for shape in shapes)
        single = kept[0] if len(kept) == 1 else None
        return replace(_measure(kept, single, solid, start), solid="primitives")
    return fit_solid(solid, options)


def fit_solid(solid: Solid, options: FitOptions) -> LinkFit:
    """Fit a solid; see ``fit_shapes``."""
    start = time.perf_counter()
    target = search.sample_solid(solid, options.seed)
    if options.spheres is not None:
        found = search.best_spheres(target, options.spheres, options.cover, options.seed)
        return _measure(found.shapes, None, solid, start)
    best = latest = search.best_single(target)
    (single,) = best.shapes
    for _ in range(1, options.max_primitives):
        if best.iou >= options.iou:
            break
        more = search.best_several(target, latest, options.seed)
        if more is None:
            break
        latest = more
        best = max(best, latest, key=lambda result: result.iou)
    return _measure(best.shapes, single, solid, start)


def _measure(
    primitives: tuple[Shape, ...], single: Shape | None, solid: Solid, start: float
) -> LinkFit:
    seconds = time.perf_counter() - start  # of the fit, without the measurement
    measured = quality(solid, primitives)
    return LinkFit(primitives, single, solid.method, measured, seconds, solid.decimated_from)

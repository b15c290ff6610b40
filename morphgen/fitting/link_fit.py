"""Fit the shapes of one link: one primitive or a few, and what they are worth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from morphgen.fitting.enclose_pieces import enclose_solid
from morphgen.fitting.quality import Quality, quality
from morphgen.fitting.search import best_several, best_single, sampled
from morphgen.fitting.solid import Solid, solid_of
from morphgen.formats.fits import MAX_PRIMITIVES, are_primitives, shape_to_data
from morphgen.model.geometry import Shape


@dataclass(frozen=True)
class FitOptions:
    """What is wanted of a fit."""

    max_primitives: int = 1
    """The most primitives of a link."""
    iou: float = 0.9
    """The number of primitives is the smallest that reaches this intersection over union."""
    enclose: bool = False
    """Whether every point of the solid must be inside; otherwise the overlap is largest."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.max_primitives <= MAX_PRIMITIVES:
            raise ValueError(f"{self.max_primitives} primitives: expected 1 to {MAX_PRIMITIVES}")
        if not 0 < self.iou <= 1:
            raise ValueError(f"IoU {self.iou}: expected more than 0, at most 1")
        if self.seed < 0:
            raise ValueError(f"seed {self.seed}: expected 0 or more")


@dataclass(frozen=True)
class LinkFit:
    """Primitives that stand for a link's shapes."""

    primitives: tuple[Shape, ...]
    """Boxes, cylinders and spheres, in the link frame."""
    single: Shape | None
    """The one that overlaps most; None if it was not looked for."""
    solid: str
    """How the solid was made, see ``solid.Method``; ``primitives`` if the shapes were that."""
    quality: Quality
    seconds: float
    """Time it took; 0 where another link's fit was taken over."""
    decimated_from: int | None = None
    """Triangles before decimation, None if there was none."""

    def as_dict(self) -> dict[str, object]:
        """Plain data for JSON: metres, (x, y, z) and (w, x, y, z)."""
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
    """Fit the shapes of one link.

    Args:
        shapes: In the link frame. Boxes, cylinders and spheres that are not too many stay as they
            are.
        options: What is wanted.
        solid: The solid of the shapes, if it is known.

    Raises:
        FitError: If the shapes have no volume.
        MeshError: If a mesh cannot be read.
    """
    start = time.perf_counter()
    solid = solid or solid_of(shapes)
    if are_primitives(shapes) and len(shapes) <= options.max_primitives:
        plain = tuple(replace(shape, rgba=None) for shape in shapes)
        single = plain[0] if len(plain) == 1 else None
        return _measured(plain, single, solid, start, method="primitives")
    return fit_solid(solid, options)


def fit_solid(solid: Solid, options: FitOptions) -> LinkFit:
    """Fit a solid; see ``fit_shapes``."""
    start = time.perf_counter()
    target = sampled(solid, options.seed)
    if options.enclose:
        shapes, _ = enclose_solid(target, options.max_primitives, options.iou, options.seed)
        return _measured(shapes, None, solid, start)
    best = latest = best_single(target)
    (single,) = best.shapes
    for _ in range(1, options.max_primitives):
        if best.iou >= options.iou:
            break
        more = best_several(target, latest, options.seed)
        if more is None:
            break
        latest = more
        best = max(best, latest, key=lambda found: found.iou)
    return _measured(best.shapes, single, solid, start)


def _measured(
    primitives: tuple[Shape, ...],
    single: Shape | None,
    solid: Solid,
    start: float,
    method: str | None = None,
) -> LinkFit:
    seconds = time.perf_counter() - start
    worth = quality(solid, primitives)
    return LinkFit(primitives, single, method or solid.method, worth, seconds, solid.decimated_from)

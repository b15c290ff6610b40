"""Fit the shapes of one link: one primitive or a few, and what they are worth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace

from morphgen.fitting.dressed import are_primitives
from morphgen.fitting.enclose_pieces import enclose_solid
from morphgen.fitting.quality import Quality, quality
from morphgen.fitting.search import best_several, best_single, sampled
from morphgen.fitting.solid import Solid, solid_of
from morphgen.fitting.stored import shape_data
from morphgen.model.geometry import Shape

MOST_PRIMITIVES = 32
"""The most primitives that a link may be given."""


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
        if not 1 <= self.max_primitives <= MOST_PRIMITIVES:
            raise ValueError(f"{self.max_primitives} primitives: expected 1 to {MOST_PRIMITIVES}")
        if not 0 < self.iou <= 1:
            raise ValueError(f"IoU {self.iou}: expected more than 0, at most 1")
        if self.seed < 0:
            raise ValueError(f"seed {self.seed}: expected 0 or more")


@dataclass(frozen=True)
class LinkFit:
    """Primitives that stand for a link's shapes."""

    primitives: tuple[Shape, ...]
    """Boxes, cylinders and spheres, in the link frame."""
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
            "primitives": [shape_data(shape) for shape in self.primitives],
            "solid": self.solid,
            "decimated_from": self.decimated_from,
            "quality": {name: float(f"{v:.6g}") for name, v in asdict(self.quality).items()},
            "seconds": round(self.seconds, 2),
        }


def fit_shapes(shapes: Sequence[Shape], options: FitOptions) -> LinkFit:
    """Fit the shapes of one link.

    Args:
        shapes: In the link frame. Boxes, cylinders and spheres that are not too many stay as they
            are.
        options: What is wanted.

    Raises:
        FitError: If the shapes have no volume.
        MeshError: If a mesh cannot be read.
    """
    start = time.perf_counter()
    solid = solid_of(shapes)
    if are_primitives(shapes) and len(shapes) <= options.max_primitives:
        plain = tuple(replace(shape, rgba=None) for shape in shapes)
        return _measured(plain, solid, "primitives", start)
    return fit_solid(solid, options, start)


def fit_solid(solid: Solid, options: FitOptions, start: float | None = None) -> LinkFit:
    """Fit a solid; see ``fit_shapes``."""
    start = time.perf_counter() if start is None else start
    target = sampled(solid, options.seed)
    if options.enclose:
        best, _ = enclose_solid(target, options.max_primitives, options.iou, options.seed)
        return _measured(best, solid, solid.method, start)
    best, score = best_single(target)
    for k in range(2, options.max_primitives + 1):
        if score >= options.iou:
            break
        more, its_score = best_several(target, k, options.seed)
        if its_score > score:
            best, score = more, its_score
    return _measured(best, solid, solid.method, start)


def _measured(primitives: tuple[Shape, ...], solid: Solid, method: str, start: float) -> LinkFit:
    seconds = time.perf_counter() - start
    return LinkFit(primitives, method, quality(solid, primitives), seconds, solid.decimated_from)

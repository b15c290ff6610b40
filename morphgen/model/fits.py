"""Primitives that were fitted to a link's shapes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from morphgen.model.geometry import Shape, scaled_shape


@dataclass(frozen=True)
class StoredFit:
    """The fit of a link's collision shapes, in the link frame."""

    link: str
    token: Shape
    """The one primitive that overlaps most."""
    collision: tuple[Shape, ...]
    """A few, for physics."""
    token_iou: float
    collision_iou: float

    def scaled(self, factor: float) -> StoredFit:
        """The fit of the shapes, larger or smaller."""
        return replace(
            self,
            token=scaled_shape(self.token, factor),
            collision=tuple(scaled_shape(shape, factor) for shape in self.collision),
        )


Stored = Mapping[str, StoredFit]
"""Fits by ``morphgen.formats.fits.shapes_key``: a hash of the shapes that were fitted."""

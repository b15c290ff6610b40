"""Capsules in URDF, which lacks them: a cylinder and two spheres, joined again when read."""

from __future__ import annotations

from collections.abc import Iterable
from math import dist

from morphgen.model.geometry import Capsule, Cylinder, Pose, Shape, Sphere

CAPSULE_SUFFIX = "_capsule"
"""End of the names of a capsule's three elements."""
_TOLERANCE = 1e-9
"""Largest difference of a sphere from an end of its cylinder [m]."""


def urdf_pieces(shape: Shape) -> tuple[Shape, ...]:
    """Return the cylinder and the two spheres of a capsule, and other shapes unchanged."""
    if not isinstance(shape.geometry, Capsule):
        return (shape,)
    radius, length = shape.geometry.radius, shape.geometry.length
    T = shape.T_link_shape
    return (
        Shape(Cylinder(radius, length), T, shape.rgba),
        Shape(Sphere(radius), T @ Pose((0.0, 0.0, length / 2)), shape.rgba),
        Shape(Sphere(radius), T @ Pose((0.0, 0.0, -length / 2)), shape.rgba),
    )


def joined_capsules(shapes: Iterable[tuple[str, Shape]]) -> tuple[Shape, ...]:
    """Return the shapes of a link, with the pieces of capsules joined.

    Three shapes in a row are joined if their names say so, and if they still are a capsule: a user
    may have changed one.

    Args:
        shapes: The shapes in their order, with the names of their elements.
    """
    rows = list(shapes)
    joined = []
    while rows:
        capsule = _capsule([shape for name, shape in rows[:3] if name.endswith(CAPSULE_SUFFIX)])
        joined.append(capsule or rows[0][1])
        del rows[: 3 if capsule else 1]
    return tuple(joined)


def _capsule(pieces: list[Shape]) -> Shape | None:
    """Return the capsule that the pieces of ``urdf_pieces`` are of; None if they are not."""
    if len(pieces) != 3 or not isinstance(pieces[0].geometry, Cylinder):
        return None
    cylinder = pieces[0].geometry
    capsule = Shape(
        Capsule(cylinder.radius, cylinder.length), pieces[0].T_link_shape, pieces[0].rgba
    )
    are_same = all(
        piece.geometry == whole.geometry
        and dist(piece.T_link_shape.position, whole.T_link_shape.position) <= _TOLERANCE
        for piece, whole in zip(pieces[1:], urdf_pieces(capsule)[1:], strict=True)
    )
    return capsule if are_same else None

"""Which geometry is sound, and what a link would weigh if it were filled with it."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

from morphgen.errors import MeshError
from morphgen.model.geometry import Geometry, Mesh, Shape, dimensions
from morphgen.model.inertia import bounding_box, inertial_from_density
from morphgen.model.mesh import convex_hull, load_mesh
from morphgen.model.robot import Inertial, Link

FLATNESS = 1e-9
"""Volume, as a fraction of the extent cubed, below which shapes enclose only rounding errors."""


def is_sound(geometry: Geometry) -> bool:
    """Whether a geometry can be measured: positive dimensions, or a mesh that has a hull."""
    if not isinstance(geometry, Mesh):
        return all(math.isfinite(size) and size > 0 for size in dimensions(geometry))
    return is_scale_valid(geometry) and mesh_fault(geometry, reader=convex_hull) is None


def is_scale_valid(mesh: Mesh) -> bool:
    """Whether every scale factor is finite and not zero."""
    return all(math.isfinite(factor) and factor != 0 for factor in mesh.scale)


def mesh_fault(mesh: Mesh, reader: Callable[[Mesh], object] = load_mesh) -> str | None:
    """Why a mesh cannot be read (or hulled, if that is the reader); None if it can."""
    try:
        reader(mesh)
    except MeshError as error:
        return str(error)
    return None


def body_shapes(link: Link) -> tuple[Shape, ...]:
    """The shapes that say where a link's mass may be: collision, or visual without any."""
    return link.collisions or link.visuals


def solid_of(link: Link) -> Inertial | None:
    """Mass properties of a link's shapes at 1 kg/m^3; None without sound shapes, or if flat."""
    shapes = body_shapes(link)
    if not shapes or not all(is_sound(shape.geometry) for shape in shapes):
        return None
    solid = inertial_from_density(shapes, density=1.0)
    extent = float(np.ptp(bounding_box(shapes), axis=0).max())
    return solid if solid.mass > FLATNESS * extent**3 else None

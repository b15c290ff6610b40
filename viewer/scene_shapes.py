"""Surfaces and colours of shapes, as the browser gets them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import ArrayLike, NDArray

from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Shape, Sphere
from morphgen.model.inertia import solid_mesh
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Inertial
from morphgen.typing import Array

Rgb = tuple[int, int, int]
Triangles = tuple[NDArray[np.float32], NDArray[np.uint32]]
"""Vertices (n, 3) [m] and faces (m, 3)."""

GREY: Rgb = (176, 182, 190)
"""Colour of shapes without their own."""
SHARP_ANGLE = np.radians(35.0)
"""Edges between faces that meet at a larger angle are drawn sharp. Tuned by eye on real arms."""
_MAX_SMOOTHED_FACES = 150_000
"""Largest mesh whose sharp edges are searched; larger ones would take seconds [faces]."""


def shape_colour(shape: Shape) -> Rgb:
    """Return the colour of a shape, grey if it has none."""
    if shape.rgba is None:
        return GREY
    red, green, blue = (round(255 * channel) for channel in shape.rgba[:3])
    return (red, green, blue)


def batch_colours(colours: ArrayLike) -> NDArray[np.uint8]:
    """Return colours (n, 3) for batched meshes, which viser takes as linear, not as sRGB.

    The transfer function is that of IEC 61966-2-1.
    """
    share = np.asarray(colours, dtype=np.float64) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(255 * linear), dtype=np.uint8)


def triangles(geometry: Geometry) -> Triangles:
    """Return the surface of a geometry in its own frame.

    Vertices at sharp edges are doubled, so that the browser shades them as edges.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    if isinstance(geometry, Mesh):
        return _mesh_triangles(geometry, load_mesh(geometry))
    return _primitive_triangles(geometry)


def grown_triangles(geometry: Geometry, thickness: float) -> Triangles:
    """Return the surface of a geometry, moved outwards by a thickness [m]; its edges are closed.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    if mesh.volume < 0:  # its faces are inside out
        mesh.invert()
    return _triangles(mesh.vertices + thickness * mesh.vertex_normals, mesh.faces)


def inertia_box(inertial: Inertial) -> tuple[Array, Array] | None:
    """Return the solid box with a link's mass and inertia.

    A box with sides a, b, c has I_a = m (b^2 + c^2) / 12, and likewise I_b and I_c; the sum of all
    three gives a^2 = 6 / m (I_a + I_b + I_c - 2 I_a).

    Returns:
        Sides (3,) [m], and their directions in the link frame as columns (3, 3). None for a
        massless link, or if no rigid body has such an inertia.
    """
    if inertial.mass <= 0:
        return None
    moments, axes = np.linalg.eigh(inertial.matrix)
    squares = 6 / inertial.mass * (moments.sum() - 2 * moments)
    if (squares < -1e-9).any() or not (squares > 0).any():
        return None
    if np.linalg.det(axes) < 0:  # a reflection is not a rotation
        axes[:, 0] *= -1
    return np.sqrt(np.maximum(squares, 1e-8)), axes


@lru_cache(maxsize=512)
def _mesh_triangles(mesh: Mesh, loaded: trimesh.Trimesh) -> Triangles:
    """Cached by the loaded mesh, too, which is another object once the file has changed."""
    del mesh
    if len(loaded.faces) <= _MAX_SMOOTHED_FACES:
        loaded = trimesh.graph.smooth_shade(loaded, angle=SHARP_ANGLE)
    return _triangles(loaded.vertices, loaded.faces)


@lru_cache(maxsize=1024)
def _primitive_triangles(geometry: Box | Sphere | Cylinder | Capsule) -> Triangles:
    """Return the surface of a primitive; cached by its kind and size."""
    mesh = solid_mesh(geometry)
    if isinstance(geometry, Box | Cylinder):
        mesh = trimesh.graph.smooth_shade(mesh, angle=SHARP_ANGLE)
    return _triangles(mesh.vertices, mesh.faces)


def _triangles(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Triangles:
    return np.asarray(vertices, dtype=np.float32), np.asarray(faces, dtype=np.uint32)

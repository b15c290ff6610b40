"""Triangles of shapes, as a page shows them."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Sphere
from morphgen.model.mesh import load_mesh

Triangles = tuple[NDArray[np.float32], NDArray[np.uint32]]
"""Vertices (n, 3), metres, and faces (m, 3)."""

SHARP = np.radians(35.0)
"""Edges between faces that meet at a larger angle are shown as edges."""
SMOOTHED = 150_000
"""Faces of the largest mesh whose sharp edges are looked for."""
_SECTIONS = 48


def triangles(geometry: Geometry) -> Triangles:
    """The surface of a geometry in its own frame; vertices are shared only across smooth edges.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    if isinstance(geometry, Mesh):
        return _of_mesh(geometry, load_mesh(geometry))
    return _of_primitive(geometry)


def ellipsoid(semi_axes: tuple[float, float, float]) -> Triangles:
    """An ellipsoid along the axes of its frame."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    return _arrays(ball.vertices * np.array(semi_axes), ball.faces)


@lru_cache(maxsize=512)
def _of_mesh(mesh: Mesh, loaded: trimesh.Trimesh) -> Triangles:
    """By the loaded mesh, which is another object once the file has changed."""
    del mesh
    return _split_edges(loaded) if len(loaded.faces) <= SMOOTHED else _plain(loaded)


@lru_cache(maxsize=1024)
def _of_primitive(geometry: Box | Sphere | Cylinder | Capsule) -> Triangles:
    match geometry:
        case Box(size):
            return _split_edges(trimesh.creation.box(size))
        case Sphere(radius):
            return _plain(trimesh.creation.icosphere(subdivisions=3, radius=radius))
        case Cylinder(radius, length):
            return _split_edges(
                trimesh.creation.cylinder(radius=radius, height=length, sections=_SECTIONS)
            )
        case Capsule(radius, length):
            made = trimesh.creation.capsule(radius=radius, height=length)
            made.apply_translation(-made.bounds.mean(axis=0))
            return _plain(made)


def _split_edges(mesh: trimesh.Trimesh) -> Triangles:
    return _plain(trimesh.graph.smooth_shade(mesh, angle=SHARP))


def _plain(mesh: trimesh.Trimesh) -> Triangles:
    return _arrays(mesh.vertices, mesh.faces)


def _arrays(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Triangles:
    return np.asarray(vertices, dtype=np.float32), np.asarray(faces, dtype=np.uint32)

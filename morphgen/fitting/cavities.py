"""How open to the outside a point is: tells the inside of a hollow shell from its surroundings."""

from __future__ import annotations

import numpy as np
import trimesh
from trimesh.ray.ray_pyembree import RayMeshIntersector

from morphgen.typing import Array

DIRECTIONS = 64
"""Rays from every point."""


class Cavities:
    """Triangles, and which points around them are mostly surrounded by them."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._rays = RayMeshIntersector(mesh)

    def openness(self, points: Array) -> Array:
        """Share of all directions in which no triangle is met.

        It is at least one half outside of the convex hull.

        Args:
            points: Shape (n, 3), in the frame of the mesh.

        Returns:
            Shape (n,), in steps of ``1 / DIRECTIONS``.
        """
        if not len(points):
            return np.zeros(0)
        directions = _directions()
        meets = self._rays.intersects_any(
            np.repeat(points, DIRECTIONS, axis=0), np.tile(directions, (len(points), 1))
        )
        return np.asarray(1 - meets.reshape(len(points), DIRECTIONS).mean(axis=1))


def _directions() -> Array:
    """Directions spread evenly, shape (DIRECTIONS, 3): the Fibonacci lattice on the sphere.

    Equal steps along the axis cut zones of equal area; the golden angle spreads them around it.
    """
    step = np.arange(DIRECTIONS) + 0.5
    z = 1 - 2 * step / DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * step
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)

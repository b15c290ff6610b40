"""Read meshes in MuJoCo's binary format ``.msh`` from untrusted sources.

The format, little-endian: four 32-bit integers, which count the vertices, the normals, the texture
coordinates and the triangles; then the vertices and normals as 3, the texture coordinates as 2
32-bit floats each; then the triangles as 3 32-bit integers each. The format is documented at
https://mujoco.readthedocs.io/en/stable/XMLreference.html#asset-mesh.
"""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray

from morphgen.typing import Array

MAX_HULL_VERTICES = 500_000
"""Number of vertices of the largest file without triangles that is read: its hull takes seconds."""
_FLAT = 1e-6
"""Thickness of a flat point cloud, relative to its size: the precision of 32-bit floats."""
_HEADER = 16
"""Size of the four counts [bytes]."""
_ROW_SIZES = (12, 12, 8, 12)
"""Size of a vertex, a normal, a texture coordinate and a triangle [bytes]."""


def read_msh(data: bytes) -> tuple[Array, NDArray[np.int64]]:
    """Return the vertices (n, 3) [m] and faces (m, 3) of a ``.msh`` file.

    Nothing is allocated before the counts agree with the file's size. Normals and texture
    coordinates are left out. Without triangles, the faces are those of the convex hull, as in
    MuJoCo.

    Args:
        data: Content of the file.

    Raises:
        ValueError: If the counts are invalid or disagree with the file's size, a triangle has a
            vertex that does not exist, a vertex is not finite, or there are no triangles and the
            vertices are flat or too many.
        scipy.spatial.QhullError: If there are no triangles, and the hull cannot be computed.
    """
    if len(data) < _HEADER:
        raise ValueError(f"{len(data)} bytes; expected a header of {_HEADER}")
    counts = [int(count) for count in np.frombuffer(data, "<i4", 4)]
    vertices, normals, coordinates, triangles = counts
    if vertices < 4 or min(counts) < 0 or not {normals, coordinates} <= {0, vertices}:
        raise ValueError(
            f"its header counts {vertices} vertices, {normals} normals, {coordinates} texture "
            f"coordinates and {triangles} triangles; expected at least 4 vertices, and as many "
            "normals and texture coordinates as vertices or none"
        )
    sizes = [count * size for count, size in zip(counts, _ROW_SIZES, strict=True)]
    if len(data) != _HEADER + sum(sizes):
        raise ValueError(
            f"{len(data)} bytes; its header counts {vertices} vertices and {triangles} triangles, "
            f"which take {_HEADER + sum(sizes)}"
        )
    points = np.frombuffer(data, "<f4", 3 * vertices, _HEADER).reshape(-1, 3).astype(np.float64)
    if not np.isfinite(points).all():
        raise ValueError("a vertex is not finite")
    if not triangles:
        if vertices > MAX_HULL_VERTICES:
            raise ValueError(
                f"{vertices} vertices without triangles; at most {MAX_HULL_VERTICES} are read"
            )
        if np.linalg.matrix_rank(points - points.mean(axis=0), rtol=_FLAT) < 3:
            raise ValueError("has no triangles, and its vertices are flat")
        hull = trimesh.convex.convex_hull(points)
        return np.asarray(hull.vertices, np.float64), np.asarray(hull.faces, np.int64)
    faces = np.frombuffer(data, "<i4", 3 * triangles, len(data) - sizes[-1]).reshape(-1, 3)
    if faces.min() < 0 or faces.max() >= vertices:
        raise ValueError(
            f"a triangle has the vertex {faces.min() if faces.min() < 0 else faces.max()}; "
            f"expected 0 to {vertices - 1}"
        )
    return points, faces.astype(np.int64)

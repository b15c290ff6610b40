"""Meshes that are the same up to a rigid motion or a mirroring, so that one fit serves all of them.

Two vertices that stand out by their distance from the mean of all are looked for in the other mesh.
Every pair there that lies alike gives a rotation and a mirroring, which all vertices then refine
and confirm. Unlike principal axes such landmarks settle bodies of revolution too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import igl
import numpy as np
import trimesh
from numpy.typing import NDArray

from morphgen.fitting.canonical import canonical
from morphgen.model.geometry import Mesh, Pose, Shape
from morphgen.typing import Array

_TRIES = 2000
"""Pairs of landmarks that are tried, each as a rotation and as a mirroring."""
_SAMPLE = 32
"""Vertices that a pair is tried on before all are."""
_ROUGH = 30.0
"""Error that a pair may leave before it is refined, in tolerances."""


def congruence(a: trimesh.Trimesh, b: trimesh.Trimesh, tolerance: float = 1e-4) -> Array | None:
    """Find the motion or mirroring that turns a mesh into another one.

    Both must have as many vertices and faces. A body of very high symmetry, such as a sphere, may
    be missed if it is also turned.

    Args:
        a: Triangles, coincident vertices merged.
        b: Triangles, coincident vertices merged.
        tolerance: How far a vertex may be from its partner, relative to the size, which is twice
            the distance of the farthest vertex from the mean of all.

    Returns:
        ``T_b_a``, shape (4, 4), which maps coordinates of ``a`` to ``b``: the identity for equal
        arrays, of determinant 1 rather than -1 where both would do; None if none was found.
    """
    if a.vertices.shape != b.vertices.shape or a.faces.shape != b.faces.shape:
        return None
    if np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces):
        return np.eye(4)
    ours, theirs = _centred(a), _centred(b)
    radii, others = (np.linalg.norm(points, axis=1) for points in (ours, theirs))
    error = tolerance * 2 * float(radii.max())
    # A mean of vertices moves at most as far as they do, so distances from it by twice as much.
    if np.abs(np.sort(radii) - np.sort(others)).max() > 2 * error:
        return None
    for R in _rotations(ours, theirs, 2 * error):
        some = ours[:: max(len(ours) // _SAMPLE, 1)] @ R.T + b.vertices.mean(axis=0)
        if b.kdtree.query(some)[0].max() > _ROUGH * error:
            continue
        for T_b_a in (_transform(a, b, R), _refined(a, b, R)):
            if _maps(a, b, T_b_a, error):
                return T_b_a
    return None


def moved(shape: Shape, T_b_a: Array) -> Shape:
    """A primitive after a rigid motion or a mirroring.

    Every primitive is its own mirror image, so a mirrored one is the same in another pose.

    Args:
        shape: Placed in frame a.
        T_b_a: Shape (4, 4), its upper left part orthogonal.

    Raises:
        ValueError: If the shape is a mesh, or the transform scales or shears.
    """
    if isinstance(shape.geometry, Mesh):
        raise ValueError(f"{shape.geometry} is no primitive")
    R = T_b_a[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6):
        raise ValueError(f"{R.tolist()} is neither a rotation nor a mirroring")
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(R)), 1.0])
    T_b_shape = T_b_a @ shape.T_link_shape.matrix @ mirror
    return canonical(replace(shape, T_link_shape=Pose.from_matrix(T_b_shape)))


def representatives(meshes: Sequence[trimesh.Trimesh]) -> list[tuple[int, Array]]:
    """Whose fit each mesh can share.

    Returns:
        For every mesh the index of the first one that is congruent to it, its own if there is no
        earlier one, and the transform, shape (4, 4), from that one to it.
    """
    found: list[tuple[int, Array]] = []
    for index, mesh in enumerate(meshes):
        firsts = [first for first in range(index) if found[first][0] == first]
        matches = ((first, congruence(meshes[first], mesh)) for first in firsts)
        shared = next(((first, T) for first, T in matches if T is not None), None)
        found.append(shared or (index, np.eye(4)))
    return found


def _centred(mesh: trimesh.Trimesh) -> Array:
    vertices = np.asarray(mesh.vertices)
    return np.asarray(vertices - vertices.mean(axis=0))


def _rotations(a: Array, b: Array, slack: float) -> Iterator[Array]:
    """Matrices, (3, 3), that may map points about their mean to others: proper ones first."""
    yield np.eye(3)
    radii, others = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    ordered = np.sort(others)
    alike = np.searchsorted(ordered, radii + slack) - np.searchsorted(ordered, radii - slack)
    first = _landmark(alike, radii)
    across = np.linalg.norm(np.cross(a, a[first]), axis=1) / radii[first]
    second = _landmark(alike, across)
    apart = np.linalg.norm(a[first] - a[second])
    firsts, seconds = (
        np.flatnonzero(np.abs(others - radii[landmark]) <= slack) for landmark in (first, second)
    )
    pairs = []
    for i in firsts:
        off = np.abs(np.linalg.norm(b[seconds] - b[i], axis=1) - apart)
        pairs += [(i, j) for j in seconds[off <= slack] if np.cross(b[i], b[j]).any()]
        if len(pairs) >= _TRIES:
            break
    frame = _frame(a[first], a[second])
    for hand in (1.0, -1.0):
        for i, j in pairs[:_TRIES]:
            yield _frame(b[i], b[j]) @ np.diag([1.0, 1.0, hand]) @ frame.T


def _landmark(alike: NDArray[np.intp], distance: Array) -> int:
    """The point with the fewest that are alike; not a near one, which would fix angles badly."""
    score = np.where(distance >= distance.max() / 2, alike, len(alike) + 1)
    return int(np.lexsort((-distance, score))[0])


def _frame(first: Array, second: Array) -> Array:
    """A right-handed frame, columns its axes: x to the first point, z normal to both."""
    x = first / np.linalg.norm(first)
    z = np.cross(first, second)
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _transform(a: trimesh.Trimesh, b: trimesh.Trimesh, R: Array) -> Array:
    """The transform that rotates and takes the mean of the vertices to the mean."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = R
    T_b_a[:3, 3] = b.vertices.mean(axis=0) - R @ a.vertices.mean(axis=0)
    return T_b_a


def _refined(a: trimesh.Trimesh, b: trimesh.Trimesh, R: Array) -> Array:
    """The transform of least squares between nearest vertices, of the same handedness.

    Orthogonal Procrustes: Umeyama, "Least-squares estimation of transformation parameters between
    two point patterns", 1991.
    """
    ours, theirs = _centred(a), _centred(b)
    _, nearest = b.kdtree.query(ours @ R.T + b.vertices.mean(axis=0))
    U, _, Vt = np.linalg.svd(theirs[nearest].T @ ours)
    hand = np.sign(np.linalg.det(R) * np.linalg.det(U @ Vt))
    return _transform(a, b, U @ np.diag([1.0, 1.0, hand]) @ Vt)


def _maps(a: trimesh.Trimesh, b: trimesh.Trimesh, T_b_a: Array, error: float) -> bool:
    """Whether vertices meet vertices both ways, and the triangles' centres the other triangles."""
    onto = trimesh.transform_points(a.vertices, T_b_a)
    if b.kdtree.query(onto)[0].max() > error:
        return False
    back = trimesh.transform_points(b.vertices, np.linalg.inv(T_b_a))
    if a.kdtree.query(back)[0].max() > error:
        return False
    centres = trimesh.transform_points(a.triangles_center, T_b_a)
    squared, _, _ = igl.point_mesh_squared_distance(
        centres, np.asarray(b.vertices, np.float64), np.asarray(b.faces, np.int64)
    )
    return bool(squared.max() <= error**2)

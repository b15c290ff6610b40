"""Find meshes that are equal up to a rigid motion or a mirroring, so that they can share one fit.

Two landmarks are chosen among the vertices of a mesh: vertices whose distance from the mean is
rare. Each pair of vertices of the other mesh at the same distances gives a candidate rotation and a
candidate mirroring, which all vertices then refine and confirm. Unlike principal axes, landmarks
determine the pose of bodies of revolution, too.
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

_MAX_PAIRS = 2000
"""Largest number of landmark pairs that are tried, each as a rotation and as a mirroring."""
_NUM_SAMPLES = 32  # number of vertices that a candidate is tested on before all are
_ROUGH_TOLERANCE = 30.0
"""Largest error of a candidate before it is refined, relative to the tolerance."""


def congruence(a: trimesh.Trimesh, b: trimesh.Trimesh, tolerance: float = 1e-4) -> Array | None:
    """Return ``T_b_a`` (4, 4), the rigid motion or mirroring that maps mesh a to b; None if none.

    Both must have the same numbers of vertices and faces. A motion is preferred to a mirroring. The
    transform of a rotated body of very high symmetry, such as a sphere, may not be found.
    """
    if a.vertices.shape != b.vertices.shape or a.faces.shape != b.faces.shape:
        return None
    if np.array_equal(a.vertices, b.vertices) and np.array_equal(a.faces, b.faces):
        return np.eye(4)
    centred_a, centred_b = _centred(a), _centred(b)
    radii, other_radii = (np.linalg.norm(points, axis=1) for points in (centred_a, centred_b))
    error = tolerance * 2 * float(radii.max())
    # If vertices move by the error, their mean moves by at most as much, and distances by twice.
    if np.abs(np.sort(radii) - np.sort(other_radii)).max() > 2 * error:
        return None
    for R in _candidate_rotations(centred_a, centred_b, 2 * error):
        sample = centred_a[:: max(len(centred_a) // _NUM_SAMPLES, 1)] @ R.T
        if b.kdtree.query(sample + b.vertices.mean(axis=0))[0].max() > _ROUGH_TOLERANCE * error:
            continue
        for T_b_a in (_transform(a, b, R), _refine(a, b, R)):
            if _maps(a, b, T_b_a, error):
                return T_b_a
    return None


def moved(shape: Shape, T_b_a: Array) -> Shape:
    """Return a primitive of frame a in frame b, after a rigid motion or a mirroring (4, 4).

    Every primitive is its own mirror image, so mirroring only changes its pose.
    """
    if isinstance(shape.geometry, Mesh):
        raise ValueError(f"{shape.geometry} is not a primitive")
    R = T_b_a[:3, :3]
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-6):
        raise ValueError(f"{R.tolist()} is neither a rotation nor a mirroring")
    mirror = np.diag([1.0, 1.0, np.sign(np.linalg.det(R)), 1.0])
    T_b_shape = T_b_a @ shape.T_link_shape.matrix @ mirror
    return canonical(replace(shape, T_link_shape=Pose.from_matrix(T_b_shape)))


def representatives(meshes: Sequence[trimesh.Trimesh]) -> list[tuple[int, Array]]:
    """Return for each mesh the index of the first congruent one, and the transform (4, 4) from it.

    It is its own index and the identity if no earlier mesh is congruent to it.
    """
    shared: list[tuple[int, Array]] = []
    for index, mesh in enumerate(meshes):
        firsts = (first for first in range(index) if shared[first][0] == first)
        matches = ((first, congruence(meshes[first], mesh)) for first in firsts)
        match = next(((first, T) for first, T in matches if T is not None), None)
        shared.append(match or (index, np.eye(4)))
    return shared


def _centred(mesh: trimesh.Trimesh) -> Array:
    vertices = np.asarray(mesh.vertices)
    return np.asarray(vertices - vertices.mean(axis=0))


def _candidate_rotations(a: Array, b: Array, slack: float) -> Iterator[Array]:
    """Yield matrices (3, 3) that may map centred points to others: rotations, then mirrorings."""
    yield np.eye(3)
    radii, other_radii = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    ordered = np.sort(other_radii)
    # Number of points of b at the distance of each point of a.
    alike = np.searchsorted(ordered, radii + slack) - np.searchsorted(ordered, radii - slack)
    first = _landmark(alike, radii)
    off_axis = np.linalg.norm(np.cross(a, a[first]), axis=1) / radii[first]
    second = _landmark(alike, off_axis)
    apart = np.linalg.norm(a[first] - a[second])
    firsts, seconds = (
        np.flatnonzero(np.abs(other_radii - radii[landmark]) <= slack)
        for landmark in (first, second)
    )
    pairs = []
    for i in firsts:
        errors = np.abs(np.linalg.norm(b[seconds] - b[i], axis=1) - apart)
        pairs += [(i, j) for j in seconds[errors <= slack] if np.cross(b[i], b[j]).any()]
        if len(pairs) >= _MAX_PAIRS:
            break
    frame = _frame(a[first], a[second])
    for handedness in (1.0, -1.0):
        for i, j in pairs[:_MAX_PAIRS]:
            yield _frame(b[i], b[j]) @ np.diag([1.0, 1.0, handedness]) @ frame.T


def _landmark(alike: NDArray[np.intp], distance: Array) -> int:
    """Return the point with the fewest counterparts; near points would fix angles badly."""
    score = np.where(distance >= distance.max() / 2, alike, len(alike) + 1)
    return int(np.lexsort((-distance, score))[0])


def _frame(first: Array, second: Array) -> Array:
    """Return a right-handed frame, axes as columns: x to the first point, z normal to both."""
    x = first / np.linalg.norm(first)
    z = np.cross(first, second)
    z = z / np.linalg.norm(z)
    return np.stack([x, np.cross(z, x), z], axis=1)


def _transform(a: trimesh.Trimesh, b: trimesh.Trimesh, R: Array) -> Array:
    """Return the transform that rotates and maps the mean of the vertices to the mean."""
    T_b_a = np.eye(4)
    T_b_a[:3, :3] = R
    T_b_a[:3, 3] = b.vertices.mean(axis=0) - R @ a.vertices.mean(axis=0)
    return T_b_a


def _refine(a: trimesh.Trimesh, b: trimesh.Trimesh, R: Array) -> Array:
    """Return the least-squares transform between nearest vertices, of the same handedness.

    Orthogonal Procrustes: Umeyama, "Least-squares estimation of transformation parameters between
    two point patterns", 1991.
    """
    centred_a, centred_b = _centred(a), _centred(b)
    _, nearest = b.kdtree.query(centred_a @ R.T + b.vertices.mean(axis=0))
    U, _, Vt = np.linalg.svd(centred_b[nearest].T @ centred_a)
    handedness = np.sign(np.linalg.det(R) * np.linalg.det(U @ Vt))
    return _transform(a, b, U @ np.diag([1.0, 1.0, handedness]) @ Vt)


def _maps(a: trimesh.Trimesh, b: trimesh.Trimesh, T_b_a: Array, error: float) -> bool:
    """Test that vertices map to vertices, both ways, and triangle centres to triangles."""
    for mesh, other, T in ((a, b, T_b_a), (b, a, np.linalg.inv(T_b_a))):
        if other.kdtree.query(trimesh.transform_points(mesh.vertices, T))[0].max() > error:
            return False
    centres = trimesh.transform_points(a.triangles_center, T_b_a)
    squared, _, _ = igl.point_mesh_squared_distance(
        centres, np.asarray(b.vertices, np.float64), np.asarray(b.faces, np.int64)
    )
    return bool(squared.max() <= error**2)

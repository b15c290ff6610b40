"""Enclose a solid in one or several primitives."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.cluster.vq import kmeans2

from morphgen.errors import FitError
from morphgen.fitting.enclose import enclose
from morphgen.fitting.quality import signed_distance
from morphgen.fitting.search import SampledSolid
from morphgen.model.geometry import Shape
from morphgen.typing import Array

NUM_CLUSTERINGS = 3
"""Number of partitions of a solid that are tried for each number of primitives."""
_MAX_GROWTHS = 20
"""Largest number of times that primitives are enlarged to contain the points left outside."""


def enclose_solid(
    target: SampledSolid, max_primitives: int, iou: float, seed: int
) -> tuple[Shape, ...]:
    """Return primitives that contain a solid with little excess volume.

    One primitive is the one of least volume. For several, the solid is cut along the bisecting
    planes between cluster centres, and each piece is enclosed; the best of ``NUM_CLUSTERINGS``
    partitions is kept. The number of primitives is the smallest that reaches ``iou``, or the best.
    """
    best: tuple[Shape, ...] = (enclose(np.asarray(target.solid.mesh.vertices)),)
    best_iou = _iou(best, target)
    for k in range(2, max_primitives + 1):
        if best_iou >= iou:
            break
        for child in np.random.SeedSequence([seed, k]).generate_state(NUM_CLUSTERINGS):
            shapes = _enclose_clusters(target, k, int(child))
            if shapes and (shapes_iou := _iou(shapes, target)) > best_iou:
                best, best_iou = shapes, shapes_iou
    return best


def _enclose_clusters(target: SampledSolid, k: int, seed: int) -> tuple[Shape, ...]:
    """Return a primitive around each of ``k`` pieces; empty if a piece is flat or empty."""
    inside = target.link_points[target.inside]
    centres, _ = kmeans2(inside, k, minit="++", seed=seed, iter=10)
    pieces = [_cut(target.solid.mesh, centres, i) for i in range(k)]
    try:
        shapes = [enclose(piece) for piece in pieces]
        for _ in range(_MAX_GROWTHS):
            # The surface of each piece is enclosed, but its interior may reach beyond the cuts.
            missed = inside[signed_distance(shapes, inside) > 0]
            if not len(missed):
                return tuple(shapes)
            nearest = np.argmin(np.linalg.norm(missed[:, None] - centres, axis=2), axis=1)
            for i in np.unique(nearest).tolist():
                pieces[i] = np.concatenate([pieces[i], missed[nearest == i]])
                shapes[i] = enclose(pieces[i])
    except FitError:
        return ()
    return ()


def _cut(mesh: trimesh.Trimesh, centres: Array, i: int) -> Array:
    """Return the vertices of the part of a mesh that is nearest to centre ``i``."""
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    for j in range(len(centres)):
        if j == i or not len(faces):
            continue
        vertices, faces, _ = trimesh.intersections.slice_faces_plane(
            vertices,
            faces,
            plane_normal=centres[i] - centres[j],
            plane_origin=(centres[i] + centres[j]) / 2,
        )
    return np.asarray(vertices[np.unique(faces)]) if len(faces) else np.zeros((0, 3))


def _iou(shapes: tuple[Shape, ...], target: SampledSolid) -> float:
    held, inside = signed_distance(shapes, target.link_points) <= 0, target.inside
    return float(target.weights[held & inside].sum() / target.weights[held | inside].sum())

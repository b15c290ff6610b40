"""Primitives that hold every point of a solid."""

from __future__ import annotations

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from morphgen.errors import FitError
from morphgen.fitting.enclose import enclose
from morphgen.fitting.quality import signed_distance
from morphgen.fitting.search import Sampled
from morphgen.model.geometry import Shape
from morphgen.typing import Array

CLUSTERINGS = 3
"""Ways of cutting a solid that are tried."""
_ROUNDS = 20
"""Times that a primitive may grow to hold what was missed."""


def enclose_solid(
    target: Sampled, max_primitives: int, iou: float, seed: int
) -> tuple[tuple[Shape, ...], float]:
    """Primitives that hold a solid with little excess, and their intersection over union.

    One primitive is the one of least volume. For several the solid is cut along planes half way
    between the centres of clusters, and every piece gets its own; of ``CLUSTERINGS`` cuts the best
    is taken. The number is the smallest that reaches ``iou``, or the best.
    """
    points = target.link_points
    vertices = np.asarray(target.solid.mesh.vertices)
    best: tuple[Shape, ...] = (enclose(vertices),)
    score = _overlap(best, points, target)
    for k in range(2, max_primitives + 1):
        if score >= iou:
            break
        for child in np.random.SeedSequence([seed, k]).generate_state(CLUSTERINGS):
            found = _in_pieces(target, points, k, int(child))
            if found and (its_score := _overlap(found, points, target)) > score:
                best, score = found, its_score
    return best, score


def _in_pieces(target: Sampled, points: Array, k: int, seed: int) -> tuple[Shape, ...]:
    """A primitive around each of ``k`` pieces; none if a piece is flat or empty."""
    solid = target.solid
    within = points[target.inside]
    centres, _ = kmeans2(within, k, minit="++", seed=seed, iter=10)
    clouds = [_cut(solid.mesh, centres, i) for i in range(k)]
    try:
        found = [enclose(cloud) for cloud in clouds]
        for _ in range(_ROUNDS):
            missed = within[signed_distance(found, within) > 0]
            if not len(missed):
                return tuple(found)
            owner = _nearest(missed, centres)
            for i in np.unique(owner).tolist():
                clouds[i] = np.concatenate([clouds[i], missed[owner == i]])
                found[i] = enclose(clouds[i])
    except FitError:
        return ()
    return ()


def _cut(mesh: trimesh.Trimesh, centres: Array, i: int) -> Array:
    """Vertices of the part of a mesh that is nearest to centre ``i``."""
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


def _nearest(points: Array, centres: Array) -> NDArray[np.intp]:
    return np.asarray(np.argmin(np.linalg.norm(points[:, None] - centres, axis=2), axis=1))


def _overlap(shapes: tuple[Shape, ...], points: Array, target: Sampled) -> float:
    """Intersection over union."""
    held, inside = signed_distance(shapes, points) <= 0, target.inside
    return float(target.weights[held & inside].sum() / target.weights[held | inside].sum())

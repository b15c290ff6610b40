"""The primitives that overlap a solid best: guesses, gradient ascent, and a choice by counting."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, canonical
from morphgen.fitting.initial_guess import FEWEST, around, by_growth, by_pieces
from morphgen.fitting.soft_iou import Candidates, ascend, overlaps
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import normalize
from morphgen.typing import Array

COARSE_POINTS = 2**11
NEAR_POINTS, FAR_POINTS = 2**14, 2**12
NEAR, FAR = 0.02, 0.35
"""How far beyond the bounding box these points are drawn, in sizes of it."""
CLUSTERINGS = 4
"""Ways of cutting a solid from which several primitives start."""
KEPT = 2
"""Candidates that are refined."""
DIGITS = 6
"""Decimals of dimensions and positions, metres; quaternions have three more."""


@dataclass(frozen=True)
class Sampled:
    """A solid as points in a frame of its own: that of its smallest bounding box, in sizes of it.

    So a thin solid at an angle is met by as many points as one along the axes of the link.
    """

    solid: Solid
    points: Array
    """Shape (n, 3), spread over the solid and its surroundings, in no order."""
    inside: NDArray[np.bool_]
    weights: Array
    """The volume that each stands for, shape (n,); points far from the solid are sparse."""

    R_link_box: Array
    """Axes of the smallest bounding box, shape (3, 3)."""
    middle: Array
    """Its middle, in the link frame, metres."""

    @cached_property
    def link_points(self) -> Array:
        """The points in the link frame, metres."""
        return np.asarray(self.points * self.solid.size @ self.R_link_box.T + self.middle)

    def shapes(self, candidates: Candidates, row: int) -> tuple[Shape, ...]:
        """One of the candidates as shapes in the link frame, rounded."""
        size = self.solid.size
        R_box_primitive = Rotation.from_quat(candidates.quaternions[row], scalar_first=True)
        R_link_primitive = Rotation.from_matrix(self.R_link_box) * R_box_primitive
        found = []
        for kind, centre, quaternion, halves in zip(
            candidates.kinds[row],
            candidates.centres[row] * size @ self.R_link_box.T + self.middle,
            R_link_primitive.as_quat(scalar_first=True),
            np.round(candidates.halves[row] * size, DIGITS),
            strict=True,
        ):
            x, y, z = np.maximum(halves, 10.0**-DIGITS).tolist()
            geometry: Box | Cylinder | Sphere
            match KINDS[kind]:
                case "box":
                    geometry = Box((2 * x, 2 * y, 2 * z))
                case "cylinder":
                    geometry = Cylinder(x, 2 * z)
                case "sphere":
                    geometry = Sphere(x)
            a, b, c = np.round(centre, DIGITS).tolist()
            w, i, j, k = np.round(quaternion, DIGITS + 3).tolist()
            pose = Pose((a, b, c), normalize((w, i, j, k)))
            found.append(canonical(Shape(geometry, pose)))
        return tuple(found)


@dataclass(frozen=True)
class Found:
    """The end of a search."""

    shapes: tuple[Shape, ...]
    """In the link frame."""
    iou: float
    """As the search saw it."""
    candidate: Candidates
    """The same in the frame of the search, one row."""


def sampled(solid: Solid, seed: int) -> Sampled:
    """Draw the points that a search looks at.

    Raises:
        FitError: If next to none of them lie inside: the solid is too thin.
    """
    T_box_link, extents = trimesh.bounds.oriented_bounds(solid.hull)
    T_link_box = np.linalg.inv(T_box_link)
    R_link_box, middle, extents = T_link_box[:3, :3], T_link_box[:3, 3], extents / solid.size
    near, far = extents / 2 + NEAR, extents / 2 + FAR
    rng = np.random.default_rng(seed)
    close = near * (2 * qmc.Sobol(3, rng=rng).random(NEAR_POINTS) - 1)
    beyond = far * (2 * qmc.Sobol(3, rng=rng).random(FAR_POINTS) - 1)
    beyond = beyond[np.any(np.abs(beyond) > near, axis=1)]
    points = np.concatenate([close, beyond])
    counts = np.repeat(
        [np.prod(near) / NEAR_POINTS, np.prod(far) / FAR_POINTS], [len(close), len(beyond)]
    )
    order = rng.permutation(len(points))
    points, counts = points[order], counts[order]
    inside = solid.contains(points * solid.size @ R_link_box.T + middle)
    if inside[:COARSE_POINTS].sum() < 2 * FEWEST:
        raise FitError(f"the solid is too thin: it fills {inside.mean():.2%} of its bounding box")
    return Sampled(solid, points, inside, counts / counts.mean(), R_link_box, middle)


def best_single(target: Sampled) -> Found:
    """The one primitive that overlaps most."""
    with _one_thread():
        cloud = target.points[target.inside]
        start = around(cloud, [np.eye(3), target.R_link_box.T], sphere=True)
        return _climb(target, start, (0.03, 0.008))


def best_several(target: Sampled, fewer: Found, seed: int) -> Found | None:
    """The primitives that overlap most together, one more than found before.

    None if the solid has too few points for them.
    """
    seeds = [int(child) for child in np.random.SeedSequence(seed).generate_state(CLUSTERINGS)]
    some = slice(4 * COARSE_POINTS)
    cloud = target.points[some], target.inside[some], target.weights[some]
    k = len(fewer.shapes) + 1
    with _one_thread():
        starts = by_pieces(*cloud, k, seeds), by_growth(fewer.candidate, *cloud, seeds[0])
        start = [guesses for guesses in starts if guesses is not None]
        return _climb(target, Candidates.stack(start), (0.02, 0.006)) if start else None


def _climb(target: Sampled, start: Candidates, tau: tuple[float, float]) -> Found:
    points, inside, weights = target.points, target.inside, target.weights
    rough = ascend(
        start,
        points[:COARSE_POINTS],
        inside[:COARSE_POINTS],
        weights=weights[:COARSE_POINTS],
        steps=100,
        tau=tau,
        rate=(0.01, 0.003),
    )
    kept = np.argsort(-overlaps(rough, points, inside, weights), kind="stable")[:KEPT]
    fine = ascend(
        rough.take(kept),
        points,
        inside,
        weights=weights,
        steps=60,
        tau=(0.006, 0.0015),
        rate=(0.004, 0.0004),
    )
    score = overlaps(fine, points, inside, weights)
    best = int(np.argmax(score))
    return Found(target.shapes(fine, best), float(score[best]), fine.take(np.array([best])))


@contextmanager
def _one_thread() -> Iterator[None]:
    """The order of a sum depends on the number of threads, and the result on the order."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)

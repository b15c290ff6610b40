"""Search for the primitives of largest intersection over union (IoU) with a solid.

Initial guesses are improved by gradient ascent on a soft IoU; counted sample points decide.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from scipy.stats import qmc

from morphgen.errors import FitError
from morphgen.fitting.canonical import KINDS, canonical
from morphgen.fitting.initial_guess import MIN_POINTS, around, by_growth, by_pieces
from morphgen.fitting.soft_iou import Candidates, ascend, overlaps
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import normalize
from morphgen.processes import one_torch_thread
from morphgen.typing import Array

COARSE_POINTS = 2**11
"""Number of sample points of the first ascent."""
NEAR_POINTS, FAR_POINTS = 2**14, 2**12
"""Numbers of sample points close to the solid and further away."""
NEAR, FAR = 0.02, 0.35
"""Margins of their boxes around the bounding box, relative to the solid's size."""
NUM_CLUSTERINGS = 4
"""Number of clusterings from which the search for several primitives starts."""
NUM_REFINED = 2
"""Number of candidates that are refined on all sample points."""
DIGITS = 6
"""Decimals of dimensions and positions in metres; quaternions have three more."""


@dataclass(frozen=True)
class SampledSolid:
    """A solid as sample points in the frame and units of its smallest bounding box.

    In that frame a thin oblique solid is hit by as many points as one along the link's axes.
    """

    solid: Solid
    points: Array
    """Points over the solid and its surroundings [sizes of the solid], shape (n, 3), shuffled."""
    inside: NDArray[np.bool_]
    """Points that are inside the solid, shape (n,)."""
    weights: Array
    """Volume that each point represents, mean 1, shape (n,); sparse points weigh more."""

    R_link_box: Array
    """Axes of the smallest bounding box in the link frame, shape (3, 3)."""
    centre: Array
    """Centre of the smallest bounding box in the link frame [m], shape (3,)."""

    @cached_property
    def link_points(self) -> Array:
        """The points in the link frame [m]."""
        return np.asarray(self.points * self.solid.size @ self.R_link_box.T + self.centre)

    def shapes(self, candidates: Candidates, row: int) -> tuple[Shape, ...]:
        """Return one candidate as rounded shapes in the link frame."""
        size = self.solid.size
        R_box_primitive = Rotation.from_quat(candidates.quaternions[row], scalar_first=True)
        R_link_primitive = Rotation.from_matrix(self.R_link_box) * R_box_primitive
        shapes = []
        for kind, centre, quaternion, halves in zip(
            candidates.kinds[row],
            candidates.centres[row] * size @ self.R_link_box.T + self.centre,
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
            shapes.append(canonical(Shape(geometry, pose)))
        return tuple(shapes)


@dataclass(frozen=True)
class SearchResult:
    """The best primitives of a search."""

    shapes: tuple[Shape, ...]
    """Primitives in the link frame."""
    iou: float
    """Intersection over union on the sample points of the search."""
    candidate: Candidates
    """The same primitives in the frame of the search, one row."""


def sample_solid(solid: Solid, seed: int) -> SampledSolid:
    """Draw the sample points of a search.

    Raises:
        FitError: If almost no point is inside, because the solid is too thin.
    """
    T_box_link, extents = trimesh.bounds.oriented_bounds(solid.hull)
    T_link_box = np.linalg.inv(T_box_link)
    R_link_box, centre, extents = T_link_box[:3, :3], T_link_box[:3, 3], extents / solid.size
    near, far = extents / 2 + NEAR, extents / 2 + FAR
    rng = np.random.default_rng(seed)
    near_points = near * (2 * qmc.Sobol(3, rng=rng).random(NEAR_POINTS) - 1)
    far_points = far * (2 * qmc.Sobol(3, rng=rng).random(FAR_POINTS) - 1)
    far_points = far_points[np.any(np.abs(far_points) > near, axis=1)]
    points = np.concatenate([near_points, far_points])
    volumes = np.repeat(
        [np.prod(near) / NEAR_POINTS, np.prod(far) / FAR_POINTS],
        [len(near_points), len(far_points)],
    )
    order = rng.permutation(len(points))
    points, volumes = points[order], volumes[order]
    inside = solid.contains(points * solid.size @ R_link_box.T + centre)
    if inside[:COARSE_POINTS].sum() < 2 * MIN_POINTS:
        raise FitError(f"the solid is too thin: it fills {inside.mean():.2%} of its bounding box")
    return SampledSolid(solid, points, inside, volumes / volumes.mean(), R_link_box, centre)


def best_single(target: SampledSolid) -> SearchResult:
    """Return the single primitive of largest IoU."""
    with one_torch_thread():
        cloud = target.points[target.inside]
        start = around(cloud, [np.eye(3), target.R_link_box.T], sphere=True)
        return _climb(target, start, (0.03, 0.008))


def best_several(target: SampledSolid, fewer: SearchResult, seed: int) -> SearchResult | None:
    """Return the primitives of largest IoU, one more than in an earlier result.

    None if the solid has too few sample points for them.
    """
    seeds = [int(child) for child in np.random.SeedSequence(seed).generate_state(NUM_CLUSTERINGS)]
    subset = slice(4 * COARSE_POINTS)
    cloud = target.points[subset], target.inside[subset], target.weights[subset]
    k = len(fewer.shapes) + 1
    with one_torch_thread():
        starts = by_pieces(*cloud, k, seeds), by_growth(fewer.candidate, *cloud, seeds[0])
        start = [guesses for guesses in starts if guesses is not None]
        return _climb(target, Candidates.stack(start), (0.02, 0.006)) if start else None


def _climb(target: SampledSolid, start: Candidates, tau: tuple[float, float]) -> SearchResult:
    """Improve all candidates on few points, then the best ones on all points."""
    points, inside, weights = target.points, target.inside, target.weights
    coarse = ascend_coarsely(target, start, weights, tau)
    best = np.argsort(-overlaps(coarse, points, inside, weights), kind="stable")[:NUM_REFINED]
    fine = ascend_finely(target, coarse.take(best), weights)
    ious = overlaps(fine, points, inside, weights)
    row = int(np.argmax(ious))
    return SearchResult(target.shapes(fine, row), float(ious[row]), fine.take(np.array([row])))


def ascend_coarsely(
    target: SampledSolid, start: Candidates, weights: Array, tau: tuple[float, float]
) -> Candidates:
    """Improve candidates on few sample points; see ``soft_iou.ascend`` for the arguments."""
    return ascend(
        start,
        target.points[:COARSE_POINTS],
        target.inside[:COARSE_POINTS],
        weights=weights[..., :COARSE_POINTS],
        num_steps=100,
        tau=tau,
        rate=(0.01, 0.003),
    )


def ascend_finely(target: SampledSolid, coarse: Candidates, weights: Array) -> Candidates:
    """Improve candidates on all sample points; see ``soft_iou.ascend`` for the arguments."""
    return ascend(
        coarse,
        target.points,
        target.inside,
        weights=weights,
        num_steps=60,
        tau=(0.006, 0.0015),
        rate=(0.004, 0.0004),
    )

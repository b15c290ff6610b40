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
from morphgen.fitting.canonical import canonical
from morphgen.fitting.initial_guess import (
    MIN_POINTS,
    around,
    by_growth,
    by_pieces,
    by_replacement,
)
from morphgen.fitting.soft_iou import SEARCH_KINDS, Candidates, ascend, overlaps
from morphgen.fitting.solid import Solid
from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape, Sphere
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
REPLACEMENT_POINTS = 2**12
"""Number of sample points on which replacements of primitives are screened and improved."""
NUM_REPLACEMENTS = 16
"""Number of replacements that are improved in a round; 24 take longer and bring nothing."""
MAX_ROUNDS = 6
"""Largest number of rounds of replacements."""
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
            geometry: Box | Cylinder | Sphere | Capsule
            match SEARCH_KINDS[kind]:
                case "box":
                    geometry = Box((2 * x, 2 * y, 2 * z))
                case "cylinder":
                    geometry = Cylinder(x, 2 * z)
                case "sphere":
                    geometry = Sphere(x)
                case "capsule":
                    geometry = Capsule(x, 2 * z)
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
        return _refine(target, ascend_coarsely(target, start, target.weights, (0.03, 0.008)))


def best_several(
    target: SampledSolid, fewer: SearchResult, seed: int, *, residual: bool = False
) -> SearchResult | None:
    """Return the primitives of largest IoU, one more than in an earlier result.

    Args:
        target: The solid.
        fewer: The earlier result.
        seed: Seed of the clusterings.
        residual: Use capsules, too, and replace primitives one at a time by others where the rest
            leaves the solid uncovered.

    Returns:
        The primitives; None if the solid has too few sample points for them.
    """
    seeds = [int(child) for child in np.random.SeedSequence(seed).generate_state(NUM_CLUSTERINGS)]
    subset = slice(4 * COARSE_POINTS)
    cloud = target.points[subset], target.inside[subset], target.weights[subset]
    k = len(fewer.shapes) + 1
    with one_torch_thread():
        starts = (
            by_pieces(*cloud, k, seeds, capsules=residual),
            by_growth(fewer.candidate, *cloud, seeds[0], capsules=residual),
        )
        guesses = [start for start in starts if start is not None]
        if not guesses:
            return None
        start = Candidates.stack(guesses)
        coarse = ascend_coarsely(target, start, target.weights, (0.02, 0.006))
        return _refine(target, _with_replacements(target, coarse, seed) if residual else coarse)


def _with_replacements(target: SampledSolid, candidates: Candidates, seed: int) -> Candidates:
    """Replace primitives of the best candidates, one at a time, as long as it helps."""
    subset = slice(REPLACEMENT_POINTS)
    cloud = target.points[subset], target.inside[subset], target.weights[subset]
    best, iou = _best_candidates(target, candidates)
    for round_seed in np.random.SeedSequence(seed).generate_state(MAX_ROUNDS):
        guesses = by_replacement(best, *cloud, int(round_seed))
        if guesses is None:
            break
        # Equal guesses have equal overlaps, of which ``unique`` keeps one.
        _, order = np.unique(-overlaps(guesses, *cloud), return_index=True)
        replaced = ascend(
            guesses.take(order[:NUM_REPLACEMENTS]),
            *cloud[:2],
            weights=cloud[2],
            num_steps=60,
            tau=(0.015, 0.004),
            rate=(0.01, 0.002),
        )
        previous = iou
        best, iou = _best_candidates(target, Candidates.stack([best, replaced]))
        if iou == previous:
            break
    return best


def _best_candidates(target: SampledSolid, candidates: Candidates) -> tuple[Candidates, float]:
    """Return the candidates of largest IoU, and that of the best one."""
    ious = overlaps(candidates, target.points, target.inside, target.weights)
    order = np.argsort(-ious, kind="stable")[:NUM_REFINED]
    return candidates.take(order), float(ious[order[0]])


def _refine(target: SampledSolid, coarse: Candidates) -> SearchResult:
    """Improve the best candidates on all points, and return the best one."""
    points, inside, weights = target.points, target.inside, target.weights
    best, _ = _best_candidates(target, coarse)
    fine = ascend_finely(target, best, weights)
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

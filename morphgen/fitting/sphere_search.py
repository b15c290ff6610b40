"""Search for the spheres that approximate a solid best, or that cover it with the least excess.

Clusters of the solid's sample points give the initial guesses; gradient ascent on the soft IoU
(``soft_iou``) improves them. If the spheres must cover a share of the solid, points inside weigh
more than those outside, and the radii change by one length after the ascent: the one at which they
cover that share of sample points that the ascent has not seen.
"""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2

from morphgen.fitting.canonical import KINDS
from morphgen.fitting.search import (
    COARSE_POINTS,
    SampledSolid,
    SearchResult,
    ascend_coarsely,
    ascend_finely,
    sample_solid,
)
from morphgen.fitting.soft_iou import Candidates, distances, overlaps
from morphgen.model.rotation import IDENTITY
from morphgen.processes import one_torch_thread
from morphgen.typing import Array

NUM_CLUSTERINGS = 2
"""Number of clusterings from which the search starts; more bring next to nothing."""
EMPHASES = (6.0, 20.0, 100.0)
"""Weights of points inside, relative to points outside, of fits that must cover the solid; tuned on
the Panda and the UR5. The best one is larger the thinner the solid and the fewer the spheres."""
RESERVE = 0.2
"""Share of the volume that may stay uncovered by which a fit covers more than it must, because the
cover is counted on sample points."""
_TAU = (0.02, 0.006)
"""Softness of the membership in the first ascent [sizes of the solid]."""
_MIN_RADIUS = 1e-3
"""Smallest radius of a guess and after a change of all radii [sizes of the solid]."""


def best_spheres(target: SampledSolid, n: int, cover: float | None, seed: int) -> SearchResult:
    """Return the spheres of largest IoU.

    Args:
        target: The solid.
        n: Number of spheres.
        cover: Share of the solid's volume that the spheres must cover; None for no such condition.
        seed: Seed of the clusterings, and of the points on which the cover is counted.
    """
    seeds = np.random.SeedSequence(seed).generate_state(NUM_CLUSTERINGS + 1).tolist()
    emphases = (1.0,) if cover is None else EMPHASES
    judge = target if cover is None else sample_solid(target.solid, seeds[-1])
    with one_torch_thread():
        start, weights = _starts(target, n, seeds[:NUM_CLUSTERINGS], emphases)
        coarse = ascend_coarsely(target, start, weights, _TAU)
        ious = overlaps(*_judged(target, coarse, cover))
        best = np.array([np.argmax(ious)])
        fine = ascend_finely(target, coarse.take(best), weights[best])
        judged = _judged(judge, fine, cover)
        (iou,) = overlaps(*judged)
    final = judged[0]
    return SearchResult(target.shapes(final, 0), float(iou), final)


def _starts(
    target: SampledSolid, n: int, seeds: list[int], emphases: tuple[float, ...]
) -> tuple[Candidates, Array]:
    """Return guesses from every clustering for every emphasis, and their weights of the points."""
    cloud = target.points[target.inside][: 2 * COARSE_POINTS]
    centres = np.zeros((len(seeds), n, 3))
    radii = np.zeros((len(seeds), n))
    for row, seed in enumerate(seeds):
        with warnings.catch_warnings():
            # A cluster without points is a guess as good as any.
            warnings.filterwarnings("ignore", "One of the clusters is empty")
            centres[row], label = kmeans2(cloud, n, minit="++", seed=seed, iter=10)
        squares = np.square(cloud - centres[row][label]).sum(axis=1)
        counts = np.maximum(np.bincount(label, minlength=n), 1)
        # The mean squared distance from the centre of a ball is 3/5 of its squared radius.
        radii[row] = np.sqrt(5 / 3 * np.bincount(label, squares, minlength=n) / counts)
    candidates = _spheres(centres, np.maximum(radii, _MIN_RADIUS))
    emphasis = np.repeat(emphases, len(seeds))[:, None]
    weights = np.where(target.inside, emphasis, 1.0) * target.weights
    return Candidates.stack([candidates] * len(emphases)), weights


def _spheres(centres: Array, radii: Array) -> Candidates:
    """Return candidates from centres (n, k, 3) and radii (n, k)."""
    shape = radii.shape
    return Candidates(
        np.full(shape, KINDS.index("sphere")),
        centres,
        np.broadcast_to(IDENTITY, (*shape, 4)).copy(),
        np.repeat(radii[..., None], 3, axis=2),
    )


def _judged(
    sample: SampledSolid, candidates: Candidates, cover: float | None
) -> tuple[Candidates, Array, NDArray[np.bool_], Array]:
    """Return candidates that cover a share of the sample's inside, and the sample's points.

    The radii of each candidate change by one length, up or down.

    Returns:
        The arguments of ``overlaps``.
    """
    points, inside, weights = sample.points, sample.inside, sample.weights
    if cover is not None:
        share = 1 - (1 - cover) * (1 - RESERVE)
        away = distances(candidates, points[inside])
        order = np.argsort(away, axis=1)
        covered = np.cumsum(weights[inside][order], axis=1) / weights[inside].sum()
        last = np.argmax(covered >= share, axis=1)
        change = np.take_along_axis(away, order, axis=1)[np.arange(len(away)), last]
        halves = np.maximum(candidates.halves + change[:, None, None], _MIN_RADIUS)
        candidates = replace(candidates, halves=halves)
    return candidates, points, inside, weights

"""Three measures of the similarity of two robots, and maps of robots from their distances."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import ArrayLike

from morphgen.benchmark.token_layout import MAX_LINKS, POSITION
from morphgen.benchmark.tokens import tokens
from morphgen.benchmark.tree_distance import LabelledTree, labelled_tree, normalised_distance
from morphgen.benchmark.workspace import Workspace, density_overlap, workspace
from morphgen.errors import BenchmarkError, nearest
from morphgen.model.geometry import Shape
from morphgen.model.robot import Robot
from morphgen.typing import Array


@dataclass(frozen=True, eq=False)
class Features:
    """The properties of a robot that the measures compare."""

    name: str
    """Name of the robot."""
    tokens: Array
    """Tokens without the joint positions, shape (n_links, 32)."""
    tree: LabelledTree
    workspace: Workspace


@dataclass(frozen=True)
class Measure:
    """A measure of the similarity of two robots."""

    name: str
    """Name in ``MEASURES``."""
    function: Callable[[Features, Features], float]
    """Symmetric function of two robots."""
    larger_is_more_alike: bool
    """True for a similarity, False for a distance."""
    meaning: str
    """Description for users."""


def features(robot: Robot, shapes: Mapping[str, Shape], *, max_links: int = MAX_LINKS) -> Features:
    """Compute the properties of a robot that the measures compare.

    Args:
        robot: The robot.
        shapes: One primitive per link with geometry, by link name, as from ``token_shapes``.
        max_links: Normalization of link indices in tokens, the same for all compared robots.

    Raises:
        BenchmarkError: If the robot has no movable tool, no tokens, or more than ``max_links``
            links.
        RobotError: If a joint axis is zero.
    """
    table = compared_tokens(robot, shapes, max_links=max_links)
    space = workspace(robot)
    return Features(robot.name, table, labelled_tree(robot, shapes, space.reach), space)


def compared_tokens(
    robot: Robot, shapes: Mapping[str, Shape], *, max_links: int = MAX_LINKS
) -> Array:
    """Return the tokens that ``cosine`` compares, without joint positions, shape (n_links, 32).

    Arguments and errors are those of ``features``.
    """
    return tokens(robot, shapes, max_links=max_links)[:, : POSITION.start]


def cosine(a: Features, b: Features) -> float:
    """Return the cosine similarity of the concatenated tokens, in [-1, 1]; 1 for equal robots.

    As in AnyBody (arXiv 2505.14986, section 4), joint positions are left out and the smaller robot
    is padded with zeros.
    """
    n = min(len(a.tokens), len(b.tokens))
    product = float((a.tokens[:n] * b.tokens[:n]).sum())
    norms = np.linalg.norm(a.tokens) * np.linalg.norm(b.tokens)
    return float(np.clip(product / norms, -1.0, 1.0))


def tree_distance(a: Features, b: Features) -> float:
    """Return the normalised edit distance of the kinematic trees, in [0, 1]; 0 for equal robots."""
    return normalised_distance(a.tree, b.tree)


def workspace_overlap(a: Features, b: Features) -> float:
    """Return the overlap of the tool position densities, in [0, 1]; 1 for equal robots.

    Tool positions are relative to the shoulder and in units of reach.
    """
    return density_overlap(a.workspace, b.workspace)


MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        measure.name: measure
        for measure in (
            Measure("cosine", cosine, True, "cosine of the concatenated tokens"),
            Measure("tree", tree_distance, False, "edit distance of the kinematic trees"),
            Measure("workspace", workspace_overlap, True, "overlap of the tool positions"),
        )
    }
)
"""The measures by name."""


def similarity_matrix(
    robots: Sequence[Features],
    measure: str,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Array:
    """Compare all pairs of robots.

    Args:
        robots: Features of n robots.
        measure: A name in ``MEASURES``.
        progress: Called with the number of pairs compared since the last call.

    Returns:
        Symmetric matrix, shape (n, n).

    Raises:
        BenchmarkError: If the measure is unknown.
    """
    function = get_measure(measure).function
    values = np.empty((len(robots), len(robots)))
    for i, robot in enumerate(robots):
        for j in range(i + 1):
            values[i, j] = values[j, i] = function(robot, robots[j])
        progress(i + 1)
    return values


def to_distances(values: Array, measure: str) -> Array:
    """Convert a matrix of a measure to distances, shape (n, n): 1 - x for similarities.

    Raises:
        BenchmarkError: If the measure is unknown.
    """
    distances = 1 - values if get_measure(measure).larger_is_more_alike else values.copy()
    np.fill_diagonal(distances, 0.0)
    return np.asarray(np.maximum(distances, 0.0))


def most_alike(values: Array, measure: str) -> int | None:
    """Return the index of the most similar robot, the first of several equal ones.

    Args:
        values: A measure of the similarity to n robots, NaN where it is not known, shape (n,).
        measure: A name in ``MEASURES``.

    Returns:
        The index; None if no value is known.

    Raises:
        BenchmarkError: If the measure is unknown.
    """
    best = np.nanargmax if get_measure(measure).larger_is_more_alike else np.nanargmin
    return None if np.isnan(values).all() else int(best(values))


def get_measure(name: str) -> Measure:
    """Return a measure by name.

    Raises:
        BenchmarkError: If the measure is unknown.
    """
    if name not in MEASURES:
        raise BenchmarkError(f"no measure {name!r}{nearest(name, MEASURES)}")
    return MEASURES[name]


_ZERO_EIGENVALUE = 1e-12
"""Sum of eigenvalues, relative to the largest squared distance, that counts as zero."""
_TIE_TOLERANCE = 1e-9
"""Relative difference within which two points count as equally far from the centre."""


@dataclass(frozen=True, eq=False)
class MdsMap:
    """A map of robots in the plane whose distances approximate given ones."""

    points: Array
    """Centred points in units of the distances, shape (n, 2); the first axis varies most."""
    kept: float
    """Share of the total variation that the two dimensions show, in [0, 1]."""


def classical_mds(distances: ArrayLike) -> MdsMap:
    """Embed distances in the plane by classical multidimensional scaling (Torgerson, 1952).

    The axes are the two largest eigenvectors of the doubly centred squared distances. ``kept`` is
    their share of the sum of all eigenvalues' magnitudes (Mardia, Kent and Bibby, Multivariate
    analysis, 1979, section 14.4), because non-Euclidean distances give negative eigenvalues. The
    sign of each axis is chosen so that the farthest point, or the first of several, is positive.

    Args:
        distances: Symmetric distances with a zero diagonal, shape (n, n).

    Raises:
        ValueError: If the matrix is not one of distances.
    """
    d = np.asarray(distances, dtype=np.float64)
    if d.ndim != 2 or d.shape[0] != d.shape[1] or not len(d):
        raise ValueError(f"distances have shape {d.shape}; expected (n, n)")
    if not np.isfinite(d).all() or (d < 0).any() or d.diagonal().any() or (d != d.T).any():
        raise ValueError("distances must be finite, symmetric, not negative, and 0 to oneself")
    squared = d * d
    rows = squared.mean(axis=0)
    values, vectors = np.linalg.eigh(-(squared - rows - rows[:, None] + rows.mean()) / 2)
    total = np.abs(values).sum()
    largest = np.maximum(values[::-1][:2], 0.0)
    points = np.zeros((len(d), 2))
    points[:, : len(largest)] = vectors[:, ::-1][:, :2] * np.sqrt(largest)
    if total <= _ZERO_EIGENVALUE * len(d) * squared.max(initial=0.0):
        return MdsMap(np.zeros_like(points), 1.0)
    size = np.abs(points)
    farthest = (size >= size.max(axis=0) * (1 - _TIE_TOLERANCE)).argmax(axis=0)
    sign = np.where(points[farthest, [0, 1]] < 0, -1.0, 1.0)
    # Adding 0.0 turns -0.0 into 0.0.
    return MdsMap(points * sign + 0.0, float(largest.sum() / total))

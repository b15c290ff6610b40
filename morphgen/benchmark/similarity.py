"""How alike two bodies are, measured in three ways."""

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
    """All of a robot that comparing needs."""

    name: str
    tokens: Array
    """Without the encoding of q, shape (n_links, 32)."""
    tree: LabelledTree
    workspace: Workspace


@dataclass(frozen=True)
class Measure:
    """A way to compare two robots."""

    name: str
    function: Callable[[Features, Features], float]
    """Symmetric."""
    larger_is_more_alike: bool
    meaning: str


def features(robot: Robot, shapes: Mapping[str, Shape], *, max_links: int = MAX_LINKS) -> Features:
    """What comparing needs of a robot.

    Args:
        robot: The body.
        shapes: The primitive of every link that has geometry, as ``token_shapes`` gives them.
        max_links: What indices of tokens are divided by, less one: the same for all robots that are
            compared.

    Raises:
        BenchmarkError: If the robot has no tool or no joint that moves it, no tokens, or more links
            than ``max_links``.
        RobotError: If an axis is zero.
    """
    table = tokens(robot, shapes, max_links=max_links)[:, : POSITION.start]
    space = workspace(robot)
    return Features(robot.name, table, labelled_tree(robot, shapes, space.reach), space)


def cosine(a: Features, b: Features) -> float:
    """Cosine of the angle between the tokens, laid end to end, in [-1, 1]; 1 is the same body.

    As in AnyBody (arXiv 2505.14986, section 4): the encoding of q left out, the smaller body
    filled up with zeros.
    """
    n = min(len(a.tokens), len(b.tokens))
    product = float((a.tokens[:n] * b.tokens[:n]).sum())
    norms = np.linalg.norm(a.tokens) * np.linalg.norm(b.tokens)
    return float(np.clip(product / norms, -1.0, 1.0))


def tree_distance(a: Features, b: Features) -> float:
    """Normalised edit distance of the kinematic trees, in [0, 1]; 0 is the same body."""
    return normalised_distance(a.tree, b.tree)


def workspace_overlap(a: Features, b: Features) -> float:
    """Share of configurations whose tools are in the same place, in [0, 1]; 1 is the same body.

    Places are about the shoulder and in units of reach.
    """
    return density_overlap(a.workspace, b.workspace)


MEASURES: Mapping[str, Measure] = MappingProxyType(
    {
        measure.name: measure
        for measure in (
            Measure("cosine", cosine, True, "how parallel the tokens are, laid end to end"),
            Measure("tree", tree_distance, False, "edit distance of the kinematic trees"),
            Measure("workspace", workspace_overlap, True, "overlap of where the tools can go"),
        )
    }
)
"""Every measure by its name."""


def similarity_matrix(
    robots: Sequence[Features],
    measure: str,
    progress: Callable[[int], None] = lambda pairs: None,
) -> Array:
    """Compare all robots with each other, every pair once.

    Args:
        robots: Their features.
        measure: A name in ``MEASURES``.
        progress: Told how many pairs were compared since it was last told.

    Returns:
        Symmetric, shape (n, n).

    Raises:
        BenchmarkError: If there is no such measure.
    """
    function = get_measure(measure).function
    values = np.empty((len(robots), len(robots)))
    for i, robot in enumerate(robots):
        for j in range(i + 1):
            values[i, j] = values[j, i] = function(robot, robots[j])
        progress(i + 1)
    return values


def to_distances(values: Array, measure: str) -> Array:
    """A matrix of a measure as distances: 1 minus it where larger is more alike, (n, n).

    Raises:
        BenchmarkError: If there is no such measure.
    """
    apart = 1 - values if get_measure(measure).larger_is_more_alike else values.copy()
    np.fill_diagonal(apart, 0.0)
    return np.asarray(np.maximum(apart, 0.0))


def get_measure(name: str) -> Measure:
    """The measure of that name.

    Raises:
        BenchmarkError: If there is none.
    """
    if name not in MEASURES:
        raise BenchmarkError(f"no measure {name!r}{nearest(name, MEASURES)}")
    return MEASURES[name]


_NOTHING = 1e-12
"""Eigenvalues are nothing below this share of the largest squared distance."""
_EQUAL = 1e-9
"""Relative difference within which points are equally far."""


@dataclass(frozen=True, eq=False)
class MdsMap:
    """Points in the plane."""

    points: Array
    """Shape (n, 2), in units of the distances, centred; the first axis varies most."""
    kept: float
    """Share of the variation that two dimensions show, in [0, 1]."""


def classical_mds(distances: ArrayLike) -> MdsMap:
    """Classical multidimensional scaling: Torgerson, Multidimensional scaling, 1952.

    The two largest eigenvectors of the squared distances, centred twice. Their share is that of
    the sum of all eigenvalues' magnitudes (Mardia, Kent and Bibby, Multivariate analysis, 1979,
    section 14.4), because distances that fit into no Euclidean space give negative ones, too. Each
    axis is turned so that the point farthest from its middle, the first of equals, is on the right.

    Args:
        distances: Symmetric, zeros on the diagonal, shape (n, n).

    Raises:
        ValueError: If they are no distances.
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
    if total <= _NOTHING * len(d) * squared.max(initial=0.0):
        return MdsMap(np.zeros_like(points), 1.0)
    return MdsMap(_turned(points), float(largest.sum() / total))


def _turned(points: Array) -> Array:
    """Points with the sign of each axis settled; adds 0.0 so that there is no -0."""
    size = np.abs(points)
    farthest = (size >= size.max(axis=0) * (1 - _EQUAL)).argmax(axis=0)
    sign = np.where(points[farthest, [0, 1]] < 0, -1.0, 1.0)
    return np.asarray(points * sign + 0.0)

"""Layouts of a population on the ground: grids, scatters of facts, and maps of similarity."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from morphgen.typing import Array
from morphgen.viewer.robot_rows import Row, sort_rows

ASPECT = 0.7
"""Width of an arrangement divided by its depth: seen from above the front, it fills a window."""
UNITS = {"reach": "m", "mass": "kg", "dof": "DoF", "links": "links"}
"""Facts by which robots can be arranged, and their units."""
_NUM_TICKS, _MAX_LABELS = 5, 16
"""Labels along an axis of a scatter, and beside rows: more would cover each other."""
_LOOSENESS = 1.6
"""Area of a scatter per robot, in cells: points that are spread evenly do not have to move."""
_MAX_ROUNDS = 200
_WORD_GAP, _LABEL_GAP = 0.2, 0.3
"""Gap between neighbours in a row, in median widths, and between labels and rows [m]."""
_QUANTILE, _GAP = 0.8, 1.1
"""Distance of neighbours in a grid: a factor on the size of a quantile of the robots. Tuned by
eye; the largest robots cover their neighbours a little."""


@dataclass(frozen=True, eq=False)
class Layout:
    """Positions of n robots on the ground, with labels."""

    positions: Array
    """Positions of the roots, shape (n, 2) [m]: x to the right, y away from the reader."""
    labels: tuple[tuple[str, tuple[float, float]], ...] = ()
    """Texts on the ground and their positions [m]."""


def cell_size(home_bounds: Array) -> Array:
    """Return distances of neighbours at which most robots do not overlap, for scatters and maps.

    home_bounds: Bounding boxes of the robots at home, shape (n, 2, 3) [m].

    Returns:
        Distance to the right and away from the reader, shape (2,) [m].
    """
    x, y, z = np.quantile(home_bounds[:, 1] - home_bounds[:, 0], _QUANTILE, axis=0)
    # Rows also need room for their height, by which they hide what is behind them.
    return np.maximum(_GAP * np.array([x, max(1.2 * y, 0.45 * x, 0.8 * z)]), 0.05)


def grid(home_bounds: Array) -> Layout:
    """Arrange robots in rows from the far left to the near right, in their order.

    home_bounds: Bounding boxes of the robots at home, shape (n, 2, 3) [m].
    """
    return Layout(_rows_of(home_bounds)[0])


def sorted_grid(rows: Sequence[Row], fact: str, home_bounds: Array) -> Layout:
    """Arrange robots in rows by a fact, smallest first, with values of rows' first robots.

    home_bounds: Bounding boxes of the robots at home, shape (n, 2, 3) [m].
    """
    index = {row.uri: i for i, row in enumerate(rows)}
    order = [index[row.uri] for row in sort_rows(rows, fact)]
    places, firsts = _rows_of(home_bounds[order])
    positions = np.zeros((len(rows), 2))
    positions[order] = places
    edge = float((places[:, 0] + home_bounds[order, 0, 0]).min()) - _LABEL_GAP
    labels = []
    for i in firsts[:: math.ceil(len(firsts) / _MAX_LABELS)]:
        value = getattr(rows[order[i]], fact)
        text = "unknown" if value is None else f"{value:.3g} {UNITS[fact]}"
        labels.append((text, (edge, float(places[i, 1]))))
    return Layout(positions, tuple(labels))


def scatter(rows: Sequence[Row], x_fact: str, y_fact: str, cell: Array) -> Layout:
    """Arrange robots by two facts, moved apart where they would cover each other.

    Robots of which one of the facts is unknown stand in rows in front of the others.
    """
    points = np.array(
        [
            [math.nan if (value := getattr(row, fact)) is None else value for fact in pair]
            for row in rows
            for pair in [(x_fact, y_fact)]
        ],
        dtype=np.float64,
    ).reshape(len(rows), 2)
    known = np.asarray(~np.isnan(points).any(axis=1))
    if not known.any():
        return Layout(_cells(len(rows), cell))
    low, high = points[known].min(axis=0), points[known].max(axis=0)
    size = _area(int(known.sum()), cell)
    labels = []
    for axis, fact in enumerate((x_fact, y_fact)):
        for share in np.linspace(0, 1, _NUM_TICKS):
            value = low[axis] + share * (high[axis] - low[axis])
            along = float((share - 0.5) * size[axis])
            across = float(-0.5 * size[1 - axis] - cell[1 - axis])
            at = (along, across) if axis == 0 else (across, along)
            labels.append((f"{value:.3g} {UNITS[fact]}", at))
    span = np.where(high > low, high - low, 1.0)
    shares = np.where(high > low, (points - low) / span, 0.5)
    return Layout(_place(shares - 0.5, known, size, cell), tuple(labels))


def similarity_map(points: Array, cell: Array) -> Layout:
    """Arrange robots by their points on a map, in the proportions of the map.

    points: Shape (n, 2); NaN for robots that cannot be compared, which stand in front.
    cell: Distances of neighbours in a grid, shape (2,) [m].
    """
    known = np.asarray(~np.isnan(points).any(axis=1))
    if not known.any():
        return Layout(_cells(len(points), cell))
    low, high = points[known].min(axis=0), points[known].max(axis=0)
    span = max(float((high - low).max()), 1e-9)
    side = math.sqrt(_LOOSENESS * ASPECT * float(known.sum() * cell.prod()))
    shares = (points - (low + high) / 2) / span
    return Layout(_place(shares, known, np.array([side, side]), cell))


def spread(points: Array) -> Array:
    """Move points (n, 2) apart until neighbours have about the distance 1; far ones stay."""
    # A seeded offset, because points at the same place have no direction to part.
    rng = np.random.default_rng(0)
    points = points + rng.uniform(-0.05, 0.05, points.shape)
    for _ in range(_MAX_ROUNDS):
        pairs = cKDTree(points).query_pairs(0.98, output_type="ndarray")
        if not len(pairs):
            break
        i, j = pairs.T
        offset = points[i] - points[j]
        length = np.linalg.norm(offset, axis=1, keepdims=True)
        step = 0.5 * (1 - length) * offset / np.maximum(length, 1e-12)
        shift, count = np.zeros_like(points), np.bincount(pairs.ravel(), minlength=len(points))
        np.add.at(shift, i, step)
        np.add.at(shift, j, -step)
        # The square root keeps crowds from exploding, and is faster than the mean.
        points = points + shift / np.sqrt(np.maximum(count, 1))[:, None]
    return np.asarray(points)


def _place(shares: Array, known: NDArray[np.bool_], size: Array, cell: Array) -> Array:
    """Return positions of known points, spread, and of the others in rows in front of them."""
    positions = np.zeros((len(shares), 2))
    positions[known] = cell * spread(shares[known] * size / cell)
    if not known.all():
        front = _cells(int((~known).sum()), cell)
        front -= [0.0, front[:, 1].max() - positions[known, 1].min() + 2 * cell[1]]
        positions[~known] = front
    return positions


def _rows_of(bounds: Array) -> tuple[Array, list[int]]:
    """Return a place for each robot, row by row like words of a text, and each row's first robot.

    A robot takes its own width, and a row the depth of most of its robots, so that few large
    robots do not make the others small.

    bounds: Bounding boxes of the robots around their roots, shape (n, 2, 3) [m].

    Returns:
        Positions of the roots, shape (n, 2) [m], and indices into them.
    """
    size = np.maximum(bounds[:, 1] - bounds[:, 0], 0.01)
    slot = size[:, 0] + _WORD_GAP * np.median(size[:, 0])
    # Rows also need room for their height, by which they hide what is behind them.
    depth = np.maximum(1.2 * size[:, 1], np.maximum(0.35 * size[:, 0], 0.75 * size[:, 2]))
    ends = np.cumsum(slot)
    num_rows = max(round(ends[-1] / math.sqrt(ASPECT * float((slot * depth).sum()))), 1)
    row = np.minimum((ends - slot / 2) / ends[-1] * num_rows, num_rows - 1e-9).astype(int)
    positions, firsts, y = np.zeros((len(bounds), 2)), [], 0.0
    for k in np.unique(row):
        members = np.flatnonzero(row == k)
        firsts.append(int(members[0]))
        right = np.cumsum(slot[members])
        left = right - slot[members] - right[-1] / 2
        y -= float(np.quantile(depth[members], _QUANTILE))
        positions[members] = np.stack([left - bounds[members, 0, 0], np.full(len(left), y)], axis=1)
    positions[:, 1] -= y / 2
    return positions, firsts


def _area(n: int, cell: Array) -> Array:
    """Return the width and depth of a scatter of n robots [m]."""
    depth = math.sqrt(_LOOSENESS * n * float(cell.prod()) / ASPECT)
    return np.array([ASPECT * depth, depth])


def _columns(n: int, cell: Array) -> int:
    return max(math.ceil(math.sqrt(ASPECT * n * cell[1] / cell[0])), 1)


def _cells(n: int, cell: Array) -> Array:
    """Return the first n cells of a centred grid, row by row from the far left, shape (n, 2)."""
    columns = min(_columns(n, cell), n)
    row, column = np.divmod(np.arange(n), columns)
    rows = math.ceil(n / columns)
    return cell * np.stack([column - (columns - 1) / 2, (rows - 1) / 2 - row], axis=1)

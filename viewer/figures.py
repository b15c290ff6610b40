"""Similarities of robots on pages: a table, and a map as SVG."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from itertools import combinations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from morphgen.encoding.similarity import MEASURES
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address

SIDE_COLOURS = {"train": "#1c7ed6", "test": "#f76707"}
_MAP_WIDTH, _MAP_CELL, _MAP_LABEL = 900.0, (100.0, 95.0), 18
"""Width of a map, width and height of a robot with its name, and letters of a name that fit."""
_MIN_COLUMNS, _MAP_ASPECT = 9, 2.5  # columns of a map of few robots, and columns by rows


def map_svg(
    points: Array,
    names: Sequence[str],
    sides: Sequence[str],
    uris: Sequence[str],
    pictures: Mapping[str, str],
) -> str:
    """Return a map of robots at points (n, 2), which show their side; a click opens one."""
    cells = map_cells(points)
    columns, rows = (cells.max(axis=0) + 1).tolist()
    # Many robots make the pictures smaller, never the map larger.
    width = _MAP_WIDTH / max(columns, _MIN_COLUMNS)
    height = width * _MAP_CELL[1] / _MAP_CELL[0]
    inner, label = 0.94 * width, min(13.0, 0.13 * width)
    marks = []
    for (x, y), name, side, uri in zip(cells.tolist(), names, sides, uris, strict=True):
        query, colour = escape(Address("robot", (uri,)).query), SIDE_COLOURS[side]
        box = f'width="{inner:.1f}" height="{0.75 * inner:.1f}"'
        at = f'x="{x * width:.1f}" y="{y * height:.1f}"'
        picture = f'<image {at} {box} href="{pictures[uri]}"/>' if pictures.get(uri) else ""
        marks.append(
            f'<a href="{query}"><g><title>{escape(name)} ({side})</title>'
            f'<rect class="point" {at} {box} rx="4" fill="#fff"/>{picture}'
            f'<rect {at} {box} rx="4" fill="none" stroke="{colour}" stroke-width="2"/>'
            f'<text x="{x * width + inner / 2:.1f}" text-anchor="middle" font-size="{label:.1f}" '
            f'y="{y * height + 0.75 * inner + 1.1 * label:.1f}" fill="{colour}">'
            f"{escape(name[:_MAP_LABEL])}</text></g></a>"
        )
    return (
        f'<svg viewBox="0 0 {_MAP_WIDTH:.0f} {rows * height + label:.0f}" width="100%" '
        f'style="font-family:inherit">{"".join(marks)}</svg>'
    )


def map_cells(points: Array) -> NDArray[np.intp]:
    """Return a cell (column, row) of its own near each point (n, 2); a fifth stay free."""
    n = len(points)
    columns = max(_MIN_COLUMNS, round(math.sqrt(_MAP_ASPECT * n)))
    rows = max(math.ceil(1.25 * n / columns), round(columns / _MAP_ASPECT))
    span = np.maximum(np.ptp(points, axis=0), 1e-9)
    wanted = (points - points.min(axis=0)) / span * (columns - 1, 1 - rows) + (0, rows - 1)
    cells = np.stack(np.divmod(np.arange(rows * columns), columns)[::-1], axis=1)
    _, chosen = linear_sum_assignment(cdist(wanted, cells, "sqeuclidean"))
    return np.asarray(cells[chosen])


def similarity_table(names: Sequence[str], similarity: Mapping[str, Array]) -> str:
    """Return a table with a row for each pair of robots and a column for each measure."""
    header = [""]
    for name, measure in MEASURES.items():
        direction = "larger" if measure.larger_is_more_alike else "smaller"
        header.append(f"{name} ({direction} is more similar)")
    rows = [
        (
            f"{escape(names[i])} and {escape(names[j])}",
            *(f"{similarity[name][i, j]:.3f}" for name in MEASURES),
        )
        for i, j in combinations(range(len(names)), 2)
    ]
    return markup.table(header, rows, range(1, len(header)))

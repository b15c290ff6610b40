"""Figures of pages: tables, maps and heat maps of similarities."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from html import escape
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from morphgen.encoding.similarity import MEASURES
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.app.address import Address

SIDE_COLOURS = {"train": "#1c7ed6", "test": "#f76707"}
_WIDTH = 480  # width of an SVG in its own units
_MAP_WIDTH, _MAP_CELL, _MAP_LABEL = 900.0, (100.0, 95.0), 18
"""Width of a map, width and height of a robot with its name, and letters of a name that fit."""
_MIN_COLUMNS, _MAP_ASPECT = 9, 2.5  # columns of a map of few robots, and columns by rows
_BLUES = ((247, 251, 255), (107, 174, 214), (8, 48, 107))  # white to dark blue


def blend(stops: ArrayLike, share: float) -> tuple[int, int, int]:
    """Return the colour at a share in [0, 1] of a scale of three colours."""
    colours = np.asarray(stops, dtype=float)
    channels = [np.interp(share, (0.0, 0.5, 1.0), colours[:, k]) for k in range(3)]
    red, green, blue = (int(channel) for channel in channels)
    return red, green, blue


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
    return _svg(rows * height + label, "".join(marks), _MAP_WIDTH)


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


def heatmap_svg(values: Array, names: Sequence[str], sides: Sequence[str], *, larger: bool) -> str:
    """Return a square for each pair of robots with its value (n, n), dark if they are similar."""
    n = len(names)
    left, cell = 120.0, (_WIDTH - 120.0) / max(n, 1)
    # Robots compared with themselves would stretch the scale.
    pairs = values[~np.eye(n, dtype=bool)] if n > 1 else values.ravel()
    low, high = float(pairs.min()), float(pairs.max())
    parts = []
    for i, (name, side) in enumerate(zip(names, sides, strict=True)):
        parts.append(
            f'<text x="{left - 4}" y="{(i + 0.65) * cell:.1f}" font-size="{min(10.0, cell):.1f}" '
            f'text-anchor="end" fill="{SIDE_COLOURS[side]}">{escape(name[:22])}</text>'
        )
        for j, other in enumerate(names):
            share = (values[i, j] - low) / (high - low) if high > low else 1.0
            share = min(max(share if larger else 1 - share, 0.0), 1.0)
            parts.append(
                f'<rect x="{left + j * cell:.1f}" y="{i * cell:.1f}" width="{cell:.2f}" '
                f'height="{cell:.2f}" fill="rgb{blend(_BLUES, share)}">'
                f"<title>{escape(name)} and {escape(other)}: {values[i, j]:.3f}</title></rect>"
            )
    return _svg(n * cell + 4, "".join(parts))


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


def _svg(height: float, content: str, width: float = _WIDTH) -> str:
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="100%" '
        f'style="font-family:inherit">{content}</svg>'
    )

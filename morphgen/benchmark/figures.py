"""Pictures of the similarity of robots: heatmaps and maps, with reproducible bytes."""

from __future__ import annotations

import io
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.transforms import Bbox

from morphgen.encoding.similarity import classical_mds, get_measure, to_distances
from morphgen.typing import Array

MAX_NAMED = 60  # largest number of robots whose names are drawn
MAX_WITH_VALUES = 16  # largest number of robots whose values are written into the cells

_DPI = 100
_ROW_HEIGHT = 0.19  # height of a named row of a heatmap [inches]
_LETTER_WIDTH = 0.075  # width of a letter of a name [inches]
_MIN_SIDE, _UNNAMED_SIDE = 3.2, 8.0
"""Smallest side of a heatmap, and side of one without names [inches]."""
_LABEL_DISTANCES = (9, 16, 26, 40, 58, 80)
"""Distances of a name from its point, tried in turn [pixels]."""
_MARKERS = "o^"  # markers of groups of robots: each with all colours, one after another
_ALL_NAMED, _SOME_NAMED, _APART = 20, 30, 16.0
"""Largest number of robots of a map that are all named; of more, number of names, and least
distance of points that are named [pixels]."""
_LABEL_FONT_SIZE = 7.5  # font size of the names in a map [points]
_LABEL_DIRECTIONS = np.array(
    [(1, 0), (-1, 0), (0, 1), (0, -1), (0.8, 0.7), (-0.8, 0.7), (0.8, -0.7), (-0.8, -0.7)]
)


@contextmanager
def _default_style() -> Iterator[None]:
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


@_default_style()
def heatmap_png(names: Sequence[str], matrices: Mapping[str, Array]) -> bytes:
    """Draw matrices by measure side by side, bright where robots are similar; return the PNG."""
    n = len(names)
    side = max(_MIN_SIDE, n * _ROW_HEIGHT) if n <= MAX_NAMED else _UNNAMED_SIDE
    margin = _LETTER_WIDTH * max(map(len, names)) if n <= MAX_NAMED else 0.3
    size = (margin + len(matrices) * (side + 0.9), margin + side + 0.5)
    figure = Figure(figsize=size, dpi=_DPI, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1))
    axes = figure.subplots(1, len(matrices), squeeze=False)[0]
    for (measure, values), ax in zip(matrices.items(), axes, strict=True):
        is_similarity = get_measure(measure).larger_is_more_alike
        apart = values[~np.eye(n, dtype=bool)] if n > 1 else values.ravel()
        low, high = float(apart.min()), float(apart.max())
        image = ax.imshow(values, "viridis" if is_similarity else "viridis_r", vmin=low, vmax=high)
        figure.colorbar(image, ax=ax, fraction=0.045, pad=0.02).ax.tick_params(labelsize=8)
        ax.set_title(get_measure(measure).title, fontsize=10)
        _name_rows(ax, names, first=ax is axes[0])
        if n <= MAX_WITH_VALUES:
            _write_values(ax, values, low, high, is_similarity=is_similarity)
    return _png(figure)


@_default_style()
def map_png(names: Sequence[str], matrices: Mapping[str, Array], groups: Sequence[str]) -> bytes:
    """Draw a map for each matrix by measure, side by side, and return the PNG.

    Colours and markers distinguish the largest groups of robots, which the legend names. Robots are
    named where there is room; of many robots, some that are spread over the map.
    """
    legend_width = 0.9 + 0.8 * _LETTER_WIDTH * max(map(len, groups))
    size = (7.0 * len(matrices) + legend_width, 7)
    figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(matrices), squeeze=False)[0]
    maps = [classical_mds(to_distances(matrix, name)) for name, matrix in matrices.items()]
    for measure, mds_map, ax in zip(matrices, maps, axes, strict=True):
        first, second = mds_map.shares
        ax.set_title(get_measure(measure).title, fontsize=10)
        ax.set_xlabel(f"first dimension of the distances, {first:.0%} of their variation")
        ax.set_ylabel(f"second dimension, {second:.0%}")
        ax.set_aspect("equal", "datalim")
        ax.margins(0.12)
        ax.grid(color="0.92")
        ax.set_axisbelow(True)
        _scatter(ax, mds_map.points, groups)
    handles, labels = axes[0].get_legend_handles_labels()
    legend = figure.legend(handles, labels, fontsize=8, loc="outside right upper")
    for text in legend.get_texts():
        text.set_parse_math(False)
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    for mds_map, ax in zip(maps, axes, strict=True):
        _name_points(ax, mds_map.points, names, canvas)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    """Return the figure as a PNG without date and version, so that its bytes are reproducible."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})  # has a version
    return buffer.getvalue()


def _name_rows(ax: Axes, names: Sequence[str], *, first: bool) -> None:
    if len(names) > MAX_NAMED:
        ax.set_xlabel(f"{len(names)} robots in the order given", fontsize=9)
        return
    size = 8 if len(names) <= 30 else 7
    ticks = range(len(names))
    ax.set_xticks(ticks, names, rotation=90, fontsize=size, parse_math=False)
    ax.set_yticks(ticks, names if first else [""] * len(names), fontsize=size, parse_math=False)
    ax.tick_params(length=0)


def _write_values(ax: Axes, values: Array, low: float, high: float, *, is_similarity: bool) -> None:
    """Write the value into every cell, dark on bright and white on dark."""
    for (row, column), value in np.ndenumerate(values):
        bright = (value - low) / (high - low) if high > low else 0.0
        if not is_similarity:
            bright = 1 - bright
        colour = "black" if bright > 0.6 else "white"
        text = f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 0.995 else f"{value:.0f}"
        ax.text(column, row, text, ha="center", va="center", color=colour, fontsize=5.5)


def _scatter(ax: Axes, points: Array, groups: Sequence[str]) -> None:
    """Draw the points with a colour and marker for each of the largest groups, grey for others."""
    colours = [colour for i, colour in enumerate(matplotlib.color_sequences["tab10"]) if i != 7]
    styles = [(colour, marker) for marker in _MARKERS for colour in colours]
    sizes = Counter(sorted(groups)).most_common()  # of equal size in the order of their names
    named = sizes if len(sizes) <= len(styles) else sizes[: len(styles)]
    left = len(sizes) - len(named)
    if left:
        members = [group not in dict(named) for group in groups]
        label = f"{left} smaller groups ({sum(members)})"
        _draw_points(ax, points[members], "0.6", ".", label)
    for (group, count), (colour, marker) in zip(named, styles, strict=False):
        members = [other == group for other in groups]
        _draw_points(ax, points[members], colour, marker, f"{group} ({count})")


def _draw_points(ax: Axes, points: Array, colour: object, marker: str, label: str) -> None:
    x, y = points.T
    ax.scatter(
        x, y, s=32, color=colour, marker=marker, label=label, edgecolors="white", linewidths=0.4
    )


def _name_points(ax: Axes, points: Array, names: Sequence[str], canvas: FigureCanvasAgg) -> None:
    """Write names beside their points, where they cover neither each other nor a point."""
    renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
    font = FontProperties(size=_LABEL_FONT_SIZE)
    centres = ax.transData.transform(points)
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in centres]
    for i in range(len(names)) if len(names) <= _ALL_NAMED else _spread(centres):
        point, centre, name = points[i], centres[i], names[i]
        width, height, _ = renderer.get_text_width_height_descent(name, font, ismath=False)
        position = _free_position(centre, (width, height), taken, ax.bbox)
        if position is None:
            continue
        offset, box = position
        taken.append(box.padded(1.5))
        ax.annotate(
            name,
            tuple(point),
            xytext=tuple(offset),
            textcoords="offset pixels",
            ha="center",
            va="center",
            fontproperties=font,
            parse_math=False,
            arrowprops={"arrowstyle": "-", "color": "0.6", "linewidth": 0.5, "shrinkB": 3},
        )


def _spread(points: Array) -> Iterator[int]:
    """Yield indices of points, each of which is the farthest from those before it [pixels]."""
    chosen = int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())
    distance = np.full(len(points), np.inf)
    for _ in range(_SOME_NAMED):
        yield chosen
        distance = np.minimum(distance, np.linalg.norm(points - points[chosen], axis=1))
        chosen = int(distance.argmax())
        if distance[chosen] < _APART:
            return


def _free_position(
    point: Array, size: tuple[float, float], taken: Sequence[Bbox], inside: Bbox
) -> tuple[Array, Bbox] | None:
    """Return the offset and box of the nearest free position for a name [pixels], if any."""
    for distance in _LABEL_DISTANCES:
        for direction in _LABEL_DIRECTIONS:
            offset = direction * distance + np.sign(direction) * np.array(size) / 2
            left, bottom = point + offset - np.array(size) / 2
            box = Bbox.from_bounds(left, bottom, *size)
            within = inside.contains(box.x0, box.y0) and inside.contains(box.x1, box.y1)
            if within and not any(box.overlaps(other) for other in taken):
                return offset, box
    return None

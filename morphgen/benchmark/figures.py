"""Maps of the similarity of robots, with reproducible bytes."""

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
from matplotlib.transforms import Bbox

from morphgen.encoding.similarity import classical_mds, get_measure, to_distances
from morphgen.typing import Array

_DPI = 100
_LETTER_WIDTH = 0.075  # width of a letter of a name [inches]
_LABEL_DISTANCES = (9, 16, 26, 40, 58, 80)
"""Distances of a name from its point, tried in turn [pixels]."""
_MARKERS = "o^"  # markers of groups of robots: each with all colours, one after another
_MAX_NAMED = 20  # largest number of robots of a map that are named
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
def map_png(names: Sequence[str], matrices: Mapping[str, Array], groups: Sequence[str]) -> bytes:
    """Draw a map for each matrix by measure, side by side, and return the PNG.

    Colours and markers distinguish the largest groups of robots, which the legend names. Up to 20
    robots are named where there is room.
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
    for mds_map, ax in zip(maps, axes, strict=True) if len(names) <= _MAX_NAMED else ():
        _name_points(ax, mds_map.points, names, canvas)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    """Return the figure as a PNG without date and version, so that its bytes are reproducible."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})  # has a version
    return buffer.getvalue()


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
    for point, centre, name in zip(points, centres, names, strict=True):
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

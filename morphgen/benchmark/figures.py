"""Pictures of the similarity of robots: heatmaps and maps, with reproducible bytes."""

from __future__ import annotations

import io
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.transforms import Bbox

from morphgen.encoding.similarity import MdsMap
from morphgen.typing import Array

MAX_NAMED = 60
"""Largest number of robots whose names are drawn."""
MAX_WITH_VALUES = 16
"""Largest number of robots whose values are written into the cells."""

_DPI = 100
_ROW_HEIGHT = 0.19  # height of a named row of a heatmap [inches]
_LETTER_WIDTH = 0.075  # width of a letter of a name [inches]
_MIN_SIDE, _UNNAMED_SIDE = 3.2, 8.0
"""Smallest side of a heatmap, and side of one without names [inches]."""
_LABEL_DISTANCES = (9, 16, 26, 40, 58, 80)
"""Distances of a name from its point, tried in turn [pixels]."""
_LABEL_FONT_SIZE = 7.5  # font size of the names in a map [points]
_LABEL_DIRECTIONS = np.array(
    [(1, 0), (-1, 0), (0, 1), (0, -1), (0.8, 0.7), (-0.8, 0.7), (0.8, -0.7), (-0.8, -0.7)]
)


@dataclass(frozen=True, eq=False)
class Panel:
    """A similarity matrix to draw."""

    title: str
    values: Array  # the matrix, shape (n, n)
    larger_is_more_alike: bool  # whether the values are similarities; distances otherwise


@dataclass(frozen=True, eq=False)
class MapPanel:
    """A map to draw."""

    title: str
    map: MdsMap  # the map of n points


@contextmanager
def _default_style() -> Iterator[None]:
    """Draw with matplotlib's default settings, whatever the user's."""
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        yield


@_default_style()
def heatmap_png(names: Sequence[str], panels: Sequence[Panel]) -> bytes:
    """Draw matrices side by side, bright where robots are similar, and return the PNG.

    Up to ``MAX_NAMED`` robots are named, and up to ``MAX_WITH_VALUES`` have their values written.
    """
    n = len(names)
    side = max(_MIN_SIDE, n * _ROW_HEIGHT) if n <= MAX_NAMED else _UNNAMED_SIDE
    margin = _LETTER_WIDTH * max(map(len, names)) if n <= MAX_NAMED else 0.3
    size = (margin + len(panels) * (side + 0.9), margin + side + 0.5)
    figure = Figure(figsize=size, dpi=_DPI, layout=ConstrainedLayoutEngine(w_pad=0.1, h_pad=0.1))
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for panel, ax in zip(panels, axes, strict=True):
        colours = "viridis" if panel.larger_is_more_alike else "viridis_r"
        apart = panel.values[~np.eye(n, dtype=bool)] if n > 1 else panel.values.ravel()
        image = ax.imshow(panel.values, colours, vmin=apart.min(), vmax=apart.max())
        figure.colorbar(image, ax=ax, fraction=0.045, pad=0.02).ax.tick_params(labelsize=8)
        ax.set_title(panel.title, fontsize=10)
        _name_rows(ax, names, first=panel is panels[0])
        if n <= MAX_WITH_VALUES:
            _write_values(ax, panel, float(apart.min()), float(apart.max()))
    return _png(figure)


@_default_style()
def map_png(names: Sequence[str], panels: Sequence[MapPanel]) -> bytes:
    """Draw maps side by side and return the PNG.

    Colours distinguish families: robots whose names differ only in the number at their end. Up to
    ``MAX_NAMED`` robots are named where there is room.
    """
    figure = Figure(figsize=(7.5 * len(panels), 7), dpi=_DPI, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    stems = [re.sub(r"-\d+$", "", name) for name in names]
    families = [stem if stems.count(stem) > 1 else "" for stem in stems]
    for panel, ax in zip(panels, axes, strict=True):
        ax.set_title(f"{panel.title}\n{panel.map.kept:.0%} of the variation shown", fontsize=10)
        ax.set_aspect("equal", "datalim")
        ax.margins(0.12)
        ax.grid(color="0.92")
        ax.set_axisbelow(True)
        _scatter(ax, panel.map.points, families)
    if len(set(families)) > 1:
        axes[-1].legend(fontsize=8, loc="best")
    figure.draw_without_rendering()
    figure.set_layout_engine("none")
    if len(names) <= MAX_NAMED:
        for panel, ax in zip(panels, axes, strict=True):
            _name_points(ax, panel.map.points, names, canvas)
    return _png(figure)


def _png(figure: Figure) -> bytes:
    """Return the figure as a PNG without date and version, so that its bytes are reproducible."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})  # has a version
    return buffer.getvalue()


def _name_rows(ax: Axes, names: Sequence[str], *, first: bool) -> None:
    """Write the names along the bottom, and at the left of the first matrix."""
    if len(names) > MAX_NAMED:
        ax.set_xlabel(f"{len(names)} robots in the order given", fontsize=9)
        return
    size = 8 if len(names) <= 30 else 7
    ticks = range(len(names))
    ax.set_xticks(ticks, names, rotation=90, fontsize=size, parse_math=False)
    ax.set_yticks(ticks, names if first else [""] * len(names), fontsize=size, parse_math=False)
    ax.tick_params(length=0)


def _write_values(ax: Axes, panel: Panel, low: float, high: float) -> None:
    """Write the value into every cell, dark on bright and white on dark."""
    for (row, column), value in np.ndenumerate(panel.values):
        bright = (value - low) / (high - low) if high > low else 0.0
        if not panel.larger_is_more_alike:
            bright = 1 - bright
        colour = "black" if bright > 0.6 else "white"
        text = f"{value:.2f}".replace("0.", ".", 1) if abs(value) < 0.995 else f"{value:.0f}"
        ax.text(column, row, text, ha="center", va="center", color=colour, fontsize=5.5)


def _scatter(ax: Axes, points: Array, families: Sequence[str]) -> None:
    """Draw the points with a colour and marker per family; grey for robots without a family."""
    colours = [colour for i, colour in enumerate(matplotlib.color_sequences["tab10"]) if i != 7]
    for i, family in enumerate(sorted(set(families) - {""})):
        members = [other == family for other in families]
        marker = "os^Dvph"[i // len(colours) % 7]
        x, y = points[members].T
        ax.scatter(x, y, s=28, color=colours[i % len(colours)], marker=marker, label=family)
    x, y = points[[family == "" for family in families]].T
    if len(x):
        ax.scatter(x, y, s=28, color="0.4", label="others")


def _name_points(ax: Axes, points: Array, names: Sequence[str], canvas: FigureCanvasAgg) -> None:
    """Write names beside their points, where they cover neither each other nor a point."""
    renderer = canvas.get_renderer()  # type: ignore[no-untyped-call]
    font = FontProperties(size=_LABEL_FONT_SIZE)
    centres = ax.transData.transform(points)
    taken = [Bbox.from_bounds(x - 4, y - 4, 8, 8) for x, y in centres]
    legend = ax.get_legend()
    if legend is not None:
        taken.append(legend.get_window_extent(renderer))
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

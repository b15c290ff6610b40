"""Maps and heatmaps as SVG whose marks lead to robots."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np

from morphgen.typing import Array
from morphgen.viewer.address import Address

_COLOURS = {"train": "#1c7ed6", "test": "#f76707"}
_SIDE = 480
"""Width of a drawing in its own units."""


def map_svg(
    points: Array, names: Sequence[str], sides: Sequence[str], places: Sequence[str]
) -> str:
    """Points of robots in the plane; a click on one opens it.

    Args:
        points: Shape (n, 2).
        names: Of the robots.
        sides: ``train`` or ``test``, which is its colour.
        places: For the links.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    scale = (_SIDE - 130) / max(float((high - low).max()), 1e-9)
    height = float((high - low)[1]) * scale + 60
    marks = []
    taken: list[tuple[float, float, float]] = []
    for (x, y), name, side, place in zip(points.tolist(), names, sides, places, strict=True):
        px, py = 20 + (x - low[0]) * scale, 30 + (high[1] - y) * scale
        query = escape(Address("robot", (place,)).query)
        marks.append(
            f'<a href="{query}"><g><title>{escape(name)} ({side})</title>'
            f'<circle cx="{px:.1f}" cy="{py:.1f}" r="6" fill="{_COLOURS[side]}" '
            f'fill-opacity="0.8" stroke="#fff"/>'
            f"{_label(px, py, name, taken)}</g></a>"
        )
    return _svg(_SIDE, height, "".join(marks))


def heatmap_svg(values: Array, names: Sequence[str], sides: Sequence[str], *, larger: bool) -> str:
    """A square a pair of robots, dark where they are alike; its title says how much.

    Args:
        values: Shape (n, n).
        names: Of the robots.
        sides: ``train`` or ``test``, which is the colour of the name.
        larger: Whether larger values are more alike.
    """
    n = len(names)
    left, cell = 120.0, (_SIDE - 120.0) / max(n, 1)
    apart = values[~np.eye(n, dtype=bool)] if n > 1 else values.ravel()
    low, high = float(apart.min()), float(apart.max())
    parts = []
    for i, (name, side) in enumerate(zip(names, sides, strict=True)):
        y = (i + 0.65) * cell
        size = min(10.0, cell)
        parts.append(
            f'<text x="{left - 4}" y="{y:.1f}" font-size="{size:.1f}" text-anchor="end" '
            f'fill="{_COLOURS[side]}">{escape(name[:22])}</text>'
        )
        for j, other in enumerate(names):
            share = (values[i, j] - low) / (high - low) if high > low else 1.0
            share = min(max(share if larger else 1 - share, 0.0), 1.0)
            parts.append(
                f'<rect x="{left + j * cell:.1f}" y="{i * cell:.1f}" width="{cell:.2f}" '
                f'height="{cell:.2f}" fill="{_shade(share)}">'
                f"<title>{escape(name)} and {escape(other)}: {values[i, j]:.3f}</title></rect>"
            )
    return _svg(_SIDE, n * cell + 4, "".join(parts))


def _label(x: float, y: float, name: str, taken: list[tuple[float, float, float]]) -> str:
    """A name beside its point, at the first of a few heights where it covers no other name."""
    width = 5.6 * len(name)
    for shift in (3.5, 14.5, -7.5, 25.5, -18.5):
        row = y + shift
        if all(abs(row - r) > 10 or x > right or x + width < left for left, right, r in taken):
            taken.append((x, x + width, row))
            return (
                f'<text x="{x + 9:.1f}" y="{row:.1f}" font-size="10" fill="currentColor">'
                f"{escape(name)}</text>"
            )
    return ""


def _shade(share: float) -> str:
    """White to dark blue."""
    stops = np.array([(247, 251, 255), (107, 174, 214), (8, 48, 107)], dtype=float)
    place = 2 * share
    low = min(int(place), 1)
    red, green, blue = (stops[low] + (place - low) * (stops[low + 1] - stops[low])).astype(int)
    return f"rgb({red},{green},{blue})"


def _svg(width: float, height: float, content: str) -> str:
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" width="100%" '
        f'style="font-family:inherit">{content}</svg>'
    )

"""Facts of many robots as parallel coordinates: an axis for each fact, a line for each robot."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape

from matplotlib.ticker import MaxNLocator

from morphgen.viewer.app.address import Address, AddressError
from morphgen.viewer.figures import CHOSEN, NOT_CHOSEN, SIDE_COLOURS
from morphgen.viewer.robot_rows import Row, facts_line

_TOP, _HEIGHT, _MARGIN = 36.0, 400.0, 60.0
"""Top and height of the axes, and their distance from the sides of the picture [pixels]."""
_NUM_TICKS = 6
_BRUSH_WIDTH = 26.0
"""Width at an axis in which the pointer chooses a range."""
_OPAQUE_LINES, _MIN_OPACITY = 60.0, 0.22
"""Number of lines up to which they are opaque, and the smallest opacity of more lines."""


@dataclass(frozen=True)
class Axis:
    """The axis of a fact."""

    label: str
    limits: tuple[float, float]
    """Values at its bottom and top."""
    is_integer: bool = False
    chosen: tuple[float, float] | None = None
    """Range that robots must have to pass the filter; None if all pass."""


def parallel_svg(
    rows: Sequence[Row], axes: Mapping[str, Axis], passing: Collection[str], width: float
) -> str:
    """Draw a line for each robot; robots that do not pass the filter are grey.

    A line opens its robot. An element at each axis has the fact as ``data-brush``: the page's
    script lets the pointer choose a range there.

    width: Width of the picture [pixels].
    """
    step = (width - 2 * _MARGIN) / (len(axes) - 1)
    grey, lines = [], []
    for row in rows:
        heights = []
        for fact, axis in axes.items():
            if (value := getattr(row, fact)) is not None:
                heights.append(_height(axis, value))
        if len(heights) < len(axes):
            continue
        points = [f"{_MARGIN + i * step:.0f} {y:.1f}" for i, y in enumerate(heights)]
        if row.uri in passing:
            lines.append((row, f"M{'L'.join(points)}"))
        else:
            grey.append(f"M{'L'.join(points)}")
    opacity = max(min(_OPAQUE_LINES / max(len(lines), 1), 1.0), _MIN_OPACITY)
    parts = [
        f'<a href="{escape(Address("robot", (row.uri,)).query)}"><title>'
        f"{escape(f'{row.name}: {facts_line(row)}')}</title>"
        f'<path d="{path}" stroke="{SIDE_COLOURS.get(row.role, CHOSEN)}"/></a>'
        for row, path in lines
    ]
    marks = [_axis(fact, axis, _MARGIN + i * step) for i, (fact, axis) in enumerate(axes.items())]
    return (
        f'<svg class="parallel" viewBox="0 0 {width:.0f} {_TOP + _HEIGHT + 24:.0f}" width="100%">'
        f'<path d="{"".join(grey)}" fill="none" stroke="{NOT_CHOSEN}" stroke-width="0.7"/>'
        f'<g class="lines" fill="none" stroke-opacity="{opacity:.2f}">{"".join(parts)}</g>'
        f"{''.join(marks)}</svg>"
    )


def parse_brush(text: str, axes: Mapping[str, Axis]) -> tuple[str, tuple[float, float]]:
    """Return the fact and the range that the pointer has chosen at an axis."""
    fact, _, ends = text.partition(":")
    first, _, last = (ends or "0:1").partition(":")
    try:
        low, high = float(first), float(last)
        is_valid = fact in axes and 0 <= low <= high <= 1
    except ValueError:
        is_valid = False
    if not is_valid:
        raise AddressError(f"{text[:60]!r}: no range of an axis; expected FACT:LOW:HIGH in [0, 1]")
    start, end = axes[fact].limits
    return fact, (start + low * (end - start), start + high * (end - start))


def _height(axis: Axis, value: float) -> float:
    """Return the vertical position of a value in the picture."""
    low, high = axis.limits
    return _TOP + _HEIGHT * (1 - (value - low) / (high - low))


def _axis(fact: str, axis: Axis, x: float) -> str:
    """Draw an axis with its name, its ends, and the chosen range."""
    low, high = axis.limits
    ticks = MaxNLocator(_NUM_TICKS, steps=(1, 2, 5, 10), integer=axis.is_integer)
    texts = "".join(
        f'<text x="{x - 5:.0f}" y="{_height(axis, value) + 4:.1f}" class="tick">{value:.4g}</text>'
        for value in ticks.tick_values(low, high)
        if low <= value <= high
    )
    chosen = ""
    if axis.chosen is not None:
        top, bottom = _height(axis, axis.chosen[1]), _height(axis, axis.chosen[0])
        # A single value still has a height that is visible.
        chosen = _bar(x, top - 2, bottom - top + 4, f'class="chosen" fill="{CHOSEN}"')
        ends = zip((top - 5, bottom + 14), axis.chosen[::-1], strict=True)
        chosen += "".join(
            f'<text x="{x + _BRUSH_WIDTH / 2 + 2:.0f}" y="{y:.0f}">{value:.4g}</text>'
            for y, value in ends
        )
    return (
        f'<text x="{x:.0f}" y="18" class="name">{escape(axis.label)}</text>'
        f'<path d="M{x:.0f} {_TOP:.0f}v{_HEIGHT:.0f}" stroke="currentColor"/>{texts}{chosen}'
        + _bar(x, _TOP, _HEIGHT, f'class="brush" data-brush="{fact}"')
    )


def _bar(x: float, y: float, height: float, attributes: str) -> str:
    return (
        f'<rect x="{x - _BRUSH_WIDTH / 2:.0f}" y="{y:.1f}" width="{_BRUSH_WIDTH:.0f}" '
        f'height="{height:.1f}" {attributes}/>'
    )

"""Pictures of the tokens of robots, for light and dark pages."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import Colormap, LinearSegmentedColormap
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morphgen.benchmark.tokens import LAYOUT
from morphgen.typing import Array
from morphgen.viewer import markup

TOKEN_TOLERANCE = 1e-6
"""Difference up to which two numbers of tokens count as equal."""
_ROW_HEIGHT, _WIDTH, _DPI = 0.14, 5.4, 200
"""Height of a link's row and width of the picture [inches], and its resolution."""


@dataclass(frozen=True)
class _Theme:
    """Colours of a picture."""

    scale: Colormap
    """From -1 to 1; zero is like the page."""
    ink: str
    """Colour of text and dots."""
    line: str
    """Colour of lines between the fields of a token."""


_DARK_SCALE = LinearSegmentedColormap.from_list(
    "dark tokens", ("#4dabf7", "#1c5f99", "#2a2d31", "#9c2f2f", "#ff6b6b")
)
_LIGHT = _Theme(matplotlib.colormaps["RdBu_r"], "black", "0.45")
_DARK = _Theme(_DARK_SCALE, "0.85", "0.55")


def token_differences(tables: Sequence[Array]) -> list[NDArray[np.bool_]]:
    """Return which tokens of each robot differ from those of the first robot.

    tables: Tokens by robot, shape (n_links, 48) each.

    Returns:
        By robot, shape (n_links, 48); links that the first robot does not have differ throughout.
    """
    first = tables[0]
    differences = []
    for table in tables:
        different = np.ones(table.shape, dtype=bool)
        n = min(len(table), len(first))
        different[:n] = np.abs(table[:n] - first[:n]) > TOKEN_TOLERANCE
        differences.append(different)
    return differences


def tokens_png(
    names: Sequence[str],
    links: Sequence[Sequence[str]],
    tables: Sequence[Array],
    *,
    dark: bool = False,
) -> bytes:
    """Draw the tokens of robots below each other; return a PNG with a transparent background.

    Blue is negative, red positive, saturated at -1 and 1. A dot marks a difference from the first
    robot. Vertical lines separate the fields of a token.

    tables: Their tokens, shape (n_links, 48) each.
    """
    theme = _DARK if dark else _LIGHT
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # the same bytes whatever the user has configured
        for key in (
            "text.color",
            "axes.labelcolor",
            "axes.edgecolor",
            "xtick.color",
            "ytick.color",
        ):
            matplotlib.rcParams[key] = theme.ink
        heights = [max(len(table), 3) for table in tables]
        size = (_WIDTH, _ROW_HEIGHT * sum(heights) + 0.45 * len(tables) + 1.0)
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        axes = figure.subplots(len(tables), 1, squeeze=False, height_ratios=heights)[:, 0]
        differences = token_differences(tables)
        for i, ax in enumerate(axes):
            _draw_tokens(ax, theme, names[i], links[i], tables[i], differences[i] if i else None)
        top = axes[0].secondary_xaxis("top")
        centres = [field.start + (field.size - 1) / 2 for field in LAYOUT]
        labels = [field.name for field in LAYOUT]
        top.set_xticks(centres, labels, fontsize=6.5, rotation=55, ha="left")
        top.tick_params(length=2)
        buffer = io.BytesIO()
        figure.savefig(
            buffer, format="png", dpi=_DPI, transparent=True, metadata={"Software": None}
        )
    return buffer.getvalue()


def tokens_html(
    names: Sequence[str],
    links: Sequence[Sequence[str]],
    tables: Sequence[Array],
    *,
    dark: bool = False,
) -> str:
    """Return the picture of ``tokens_png`` with its legend, as HTML."""
    url = base64.b64encode(tokens_png(names, links, tables, dark=dark)).decode()
    legend = "48 numbers per link at home; blue is negative, red positive"
    if len(names) > 1:
        legend += "; a dot marks a difference from the first robot"
    return (
        markup.dim(legend)
        + f'<img alt="tokens" style="width:100%" src="data:image/png;base64,{url}">'
    )


def _draw_tokens(
    ax: Axes,
    theme: _Theme,
    name: str,
    links: Sequence[str],
    table: Array,
    different: NDArray[np.bool_] | None,
) -> None:
    """Draw a robot's tokens, with a dot at each number that differs from the first robot's."""
    ax.imshow(table, theme.scale, vmin=-1, vmax=1, aspect="auto", interpolation="nearest")
    for field in LAYOUT[1:]:
        ax.axvline(field.start - 0.5, color=theme.line, linewidth=0.6)
    if different is not None:
        rows, columns = np.nonzero(different)
        ax.scatter(columns, rows, s=1.2, color=theme.ink, linewidths=0)
        name = f"{name}: {different.sum()} of {different.size} numbers differ"
    ax.set_yticks(range(len(links)), links, fontsize=6, parse_math=False)
    ax.set_xticks([])
    ax.tick_params(length=0)
    ax.set_xlabel(name, fontsize=7.5, loc="left", labelpad=2, parse_math=False)

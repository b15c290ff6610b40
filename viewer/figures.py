"""Token matrices of robots as pictures, with what differs between them."""

from __future__ import annotations

import io
from collections.abc import Sequence

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from morphgen.benchmark.token_layout import LAYOUT
from morphgen.typing import Array

SAME = 1e-6
"""Difference up to which two numbers are the same."""
_ROW, _WIDTH, _DPI = 0.14, 5.4, 200


def differences(tables: Sequence[Array]) -> list[NDArray[np.bool_]]:
    """Where each robot's tokens are not those of the first one.

    Args:
        tables: Tokens by robot, shape (n_links, 48) each.

    Returns:
        By robot, shape (n_links, 48); rows that the first robot does not have are all different.
    """
    first = tables[0]
    found = []
    for table in tables:
        apart = np.ones(table.shape, dtype=bool)
        n = min(len(table), len(first))
        apart[:n] = np.abs(table[:n] - first[:n]) > SAME
        found.append(apart)
    return found


def tokens_png(
    names: Sequence[str], links: Sequence[Sequence[str]], tables: Sequence[Array]
) -> bytes:
    """Draw the tokens of robots below each other; a PNG.

    Blue is negative, red positive, up to 1 in size. A black dot marks what differs from the first
    robot. Lines part the fields of a token.

    Args:
        names: Of the robots.
        links: Names of their links.
        tables: Their tokens, shape (n_links, 48) each.
    """
    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        heights = [max(len(table), 3) for table in tables]
        size = (_WIDTH, _ROW * sum(heights) + 0.45 * len(tables) + 1.0)
        figure = Figure(figsize=size, dpi=_DPI, layout="constrained")
        axes = figure.subplots(len(tables), 1, squeeze=False, height_ratios=heights)[:, 0]
        apart = differences(tables)
        for i, ax in enumerate(axes):
            _draw(ax, names[i], links[i], tables[i], apart[i] if i else None)
        _name_fields(axes[0])
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def _draw(
    ax: Axes, name: str, links: Sequence[str], table: Array, apart: NDArray[np.bool_] | None
) -> None:
    ax.imshow(table, "RdBu_r", vmin=-1, vmax=1, aspect="auto", interpolation="nearest")
    for field in LAYOUT[1:]:
        ax.axvline(field.start - 0.5, color="0.45", linewidth=0.6)
    if apart is not None:
        rows, columns = np.nonzero(apart)
        ax.scatter(columns, rows, s=1.2, color="black", linewidths=0)
        name = f"{name}: {apart.sum()} of {apart.size} numbers differ"
    ax.set_yticks(range(len(links)), links, fontsize=6, parse_math=False)
    ax.set_xticks([])
    ax.tick_params(length=0)
    ax.set_xlabel(name, fontsize=7.5, loc="left", labelpad=2, parse_math=False)


def _name_fields(ax: Axes) -> None:
    top = ax.secondary_xaxis("top")
    centres = [field.start + (field.size - 1) / 2 for field in LAYOUT]
    top.set_xticks(centres, [field.name for field in LAYOUT], fontsize=6.5, rotation=55, ha="left")
    top.tick_params(length=2)

"""Contact sheets: pictures of robots with their names and facts, as one PNG or PDF."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from PIL import Image

from morphgen.viewer.scene_stage import bar_length, length_text

_CELL_WIDTH, _PICTURE_HEIGHT, _TEXT_HEIGHT = 1.5, 1.125, 0.36
"""Size of a cell, its picture above its text [inches]."""
_TITLE_HEIGHT, _BORDER = 0.5, 0.2
"""Height of the line with the title and the scale, and border around the sheet [inches]."""
_DPI = 200
_ASPECT = 1.4
"""Width of a sheet divided by its height, about that of a slide."""
_BOTTOM = 0.04
"""Height within a picture at which robots stand, as a share of the picture."""
_GREY = "0.45"


@dataclass(frozen=True)
class Cell:
    """A robot on a sheet."""

    image: str
    """Picture as a ``data:`` URL; empty if it cannot be drawn."""
    name: str
    facts: str
    share: float = 1.0
    """Size of the picture within its cell, at most 1."""


def contact_sheet(title: str, cells: Sequence[Cell], height: float, suffix: str) -> bytes:
    """Draw a contact sheet.

    Args:
        title: Title of the sheet.
        cells: At least one robot.
        height: Height that a whole picture shows [m]; NaN if the pictures have different scales.
        suffix: ``png`` or ``pdf``.
    """
    columns = max(round(math.sqrt(_ASPECT * len(cells))), 1)
    rows = math.ceil(len(cells) / columns)
    cell_height = _PICTURE_HEIGHT + _TEXT_HEIGHT
    width = columns * _CELL_WIDTH + 2 * _BORDER
    total = rows * cell_height + _TITLE_HEIGHT + 2 * _BORDER
    with matplotlib.rc_context():
        matplotlib.rcdefaults()  # the same bytes whatever the user has configured
        figure = Figure(figsize=(width, total), dpi=_DPI)
        axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0, width), ylim=(0, total))
        axes.set_axis_off()
        top = total - _BORDER
        axes.text(_BORDER, top - 0.1, title, fontsize=11, va="top", weight="bold", parse_math=False)
        if not math.isnan(height):
            length = bar_length(0.6 * height)
            bar = length / height * _PICTURE_HEIGHT
            right, y = width - _BORDER, top - 0.28
            axes.plot((right - bar, right), (y, y), color="black", linewidth=2)
            axes.text(right - bar / 2, y + 0.05, length_text(length), fontsize=7, ha="center")
        for i, cell in enumerate(cells):
            row, column = divmod(i, columns)
            left = _BORDER + column * _CELL_WIDTH
            bottom = top - _TITLE_HEIGHT - (row + 1) * cell_height + _TEXT_HEIGHT
            if cell.image:
                w, h = cell.share * _CELL_WIDTH, cell.share * _PICTURE_HEIGHT
                x = left + (_CELL_WIDTH - w) / 2
                y = bottom + (1 - cell.share) * _BOTTOM * _PICTURE_HEIGHT
                pixels = np.asarray(decode_picture(cell.image))
                axes.imshow(pixels, extent=(x, x + w, y, y + h), interpolation="lanczos")
            middle = left + _CELL_WIDTH / 2
            words: dict[str, Any] = {"ha": "center", "va": "top", "parse_math": False}
            axes.text(middle, bottom - 0.02, cell.name[:28], fontsize=6.5, **words)
            axes.text(middle, bottom - 0.15, cell.facts, fontsize=5.5, color=_GREY, **words)
        axes.set(xlim=(0, width), ylim=(0, total), aspect="auto")
        content = io.BytesIO()
        when = {"png": {"Software": None}, "pdf": {"CreationDate": None, "Producer": None}}
        figure.savefig(content, format=suffix, dpi=_DPI, metadata=when[suffix])
    return content.getvalue()


def decode_picture(url: str) -> Image.Image:
    """Return the picture of a ``data:`` URL."""
    data = base64.b64decode(url.partition(",")[2])
    return Image.open(io.BytesIO(data)).convert("RGB")

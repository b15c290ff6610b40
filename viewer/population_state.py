"""The state of a population's page in its address, and the cards of its robots."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from morphgen.viewer import markup
from morphgen.viewer.address import parse_count
from morphgen.viewer.population_layout import UNITS
from morphgen.viewer.robot_rows import Row, facts_line


def card(row: Row) -> str:
    """Return the card that a browser shows of the robot under the pointer."""
    findings = "no findings" if row.findings == () else ", ".join(row.findings or ["not checked"])
    side = f" · {row.role}" if row.role else ""
    return (
        f"<b>{escape(row.name)}</b>{escape(side)}<br>{escape(facts_line(row))}<br>"
        f'<span style="color:#868e96">{escape(findings)}</span>'
    )


def format_selection(selected: NDArray[np.bool_]) -> str:
    """Return the indices of selected robots as ranges, such as ``0-4,9``."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], selected, [False]]).astype(int)))
    pairs = edges.reshape(-1, 2).tolist()
    return ",".join(f"{a}" if b == a + 1 else f"{a}-{b - 1}" for a, b in pairs)


def parse_selection(text: str, n: int) -> NDArray[np.bool_]:
    """Return the mask of robots that ranges select, shape (n,); what is invalid selects nothing."""
    selected = np.zeros(n, dtype=np.bool_)
    for part in text.split(","):
        first, dash, last = part.partition("-")
        start = parse_count(first, n)
        selected[start : (parse_count(last, -1) if dash else start) + 1] = True
    return selected


def selection_text(rows: Sequence[Row]) -> str:
    """Return the number of selected robots and the ranges of their facts as HTML."""
    if not rows:
        return markup.dim("no robot is selected")
    lines = [", ".join(row.name for row in rows[:3]) + (", ..." if len(rows) > 3 else "")]
    for fact in ("reach", "mass", "dof"):
        values = [value for row in rows if (value := getattr(row, fact)) is not None]
        if values:
            low, high = min(values), max(values)
            numbers = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
            lines.append(f"{'' if fact == 'dof' else fact + ' '}{numbers} {UNITS[fact]}")
    return f"<b>{len(rows)} selected</b>{markup.dim('<br>'.join(map(escape, lines)))}"

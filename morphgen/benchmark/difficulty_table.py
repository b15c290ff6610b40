"""The difficulty of splits as CSV and as a readable table."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence

from tabulate import tabulate

from morphgen.benchmark.difficulty import DIGITS, RobotDifficulty
from morphgen.benchmark.similarity import MEASURES


def nearest_column(measure: str) -> str:
    """Return the column with the nearest train robot by a measure."""
    return f"{measure}_nearest"


STRUCTURAL = (
    *("split", "side", "robot", "task", "obstacles", "movable_to_tool", "links", "reach"),
    *(column for name in MEASURES for column in (nearest_column(name), name)),
)
"""Columns that follow from the split alone; reach is in metres."""


def difficulty_csv(rows: Sequence[RobotDifficulty], baselines: Sequence[str] = ()) -> str:
    """Return a CSV table with a line per robot: ``STRUCTURAL``, then two columns per baseline.

    The same rows give the same text. Cells without a value are empty.

    Args:
        rows: The rows.
        baselines: Names of the baselines in the order of their columns.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    results = (f"{name}_{key}" for name in baselines for key in ("score", "success"))
    writer.writerow((*STRUCTURAL, *results))
    for row in rows:
        cells = [*structural_cells(row)]
        for name in baselines:
            result = row.baselines.get(name)
            cells += ["", ""] if result is None else map(_number, (result.score, result.success))
        writer.writerow(cells)
    return text.getvalue()


def structural_cells(row: RobotDifficulty) -> Iterator[str]:
    """Yield the cells of ``STRUCTURAL`` as they are in the CSV table."""
    yield from (row.split, row.side, row.robot, row.task, str(row.obstacles).lower())
    yield from (str(row.movable_to_tool), str(row.links), _number(row.reach))
    for measure in MEASURES:
        nearest = row.nearest.get(measure)
        yield from ("", "") if nearest is None else (nearest.train, _number(nearest.value))


def _number(value: float) -> str:
    """Return a number with all its decimals, never with an exponent."""
    return f"{value:.{DIGITS}f}"


def difficulty_table(
    rows: Sequence[RobotDifficulty], baselines: Sequence[str] = (), style: str = "simple"
) -> str:
    """Return a table of the robots of one split for readers; ``style`` is one of tabulate's."""
    headers = (
        *("robot", "side", "task", "movable to tool", "links", "reach (m)"),
        *(f"nearest by {name}" for name in MEASURES),
        *baselines,
    )
    cells = [tuple(_cells(row, baselines)) for row in rows]
    return tabulate(cells, headers, tablefmt=style, disable_numparse=True)


def _cells(row: RobotDifficulty, baselines: Sequence[str]) -> Iterator[str]:
    yield from (row.robot, row.side, row.task + (" (obstacles)" if row.obstacles else ""))
    yield from (str(row.movable_to_tool), str(row.links), f"{row.reach:.2f}")
    for measure in MEASURES:
        nearest = row.nearest.get(measure)
        yield "-" if nearest is None else f"{nearest.train} {nearest.value:.3f}"
    for name in baselines:
        result = row.baselines.get(name)
        # Adding 0.0 turns -0.0 into 0.0.
        yield "-" if result is None else f"{round(result.score, 1) + 0.0:.1f}, {result.success:.0%}"

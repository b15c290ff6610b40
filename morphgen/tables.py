"""Tables as text: whole for files and pipes, with the columns that fit for terminals.

The width of the terminal is in a context variable, so that whoever makes a table need not know it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

from tabulate import tabulate

from morphgen.errors import shortened

_width: ContextVar[int | None] = ContextVar("width", default=None)

_GAP = 2  # width of the gap between two columns, and of tabulate's padding of headers [characters]
_LEAST_TEXT = 16  # least width to which the cells of a column are shortened [characters]


@contextmanager
def fitted(width: int | None) -> Iterator[None]:
    """Let the tables of a block have at most a width [characters]; None for any width."""
    token = _width.set(width)
    try:
        yield
    finally:
        _width.reset(token)


def table(
    rows: Sequence[Sequence[object]],
    headers: Sequence[str],
    *,
    style: str = "simple",
    formats: str | Sequence[str] | None = None,
    last: Sequence[str] = (),
) -> str:
    """Return a table, in a block of ``fitted`` with as many columns as its width holds.

    Columns are left out from the right, after those of ``last`` in that order; texts are shortened
    to half of the width, and further where that keeps a column. A line below names the columns that
    are left out. Tables of Markdown are always whole. In style ``plain`` headers are a row like the
    others, without padding; cells are texts unless ``formats`` says otherwise.
    """
    if formats is None or isinstance(formats, str):
        number_formats = [formats or "g"] * len(headers)
    else:
        number_formats = list(formats)

    def text(columns: Sequence[int], most: Mapping[int, int]) -> str:
        titles: list[str] = [headers[i] for i in columns]
        lines: list[Sequence[object]] = [
            [shortened(str(row[i]), most[i]) if i in most else row[i] for i in columns]
            for row in rows
        ]
        if style == "plain":
            lines, titles = [titles, *lines], []
        return tabulate(
            lines,
            titles,
            tablefmt=style,
            floatfmt=[number_formats[i] for i in columns],
            disable_numparse=formats is None,
        )

    everything = range(len(headers))
    result, width = text(everything, {}), _width.get()
    if width is None or style == "github" or _width_of(result) <= width:
        return result
    half = {i: width // 2 for i in everything if any(isinstance(row[i], str) for row in rows)}
    order = [i for i in everything if headers[i] not in last]
    for title in reversed(last):
        order += [i for i in everything if headers[i] == title]
    kept = len(order)
    while kept and _width_of(text(sorted(order[:kept]), half)) > width:
        kept -= 1
    shown = sorted(order[:kept])
    if kept < len(order):
        cut = order[kept]
        room = width - (_width_of(text(shown, half)) + _GAP if shown else 0)
        if not shown or room >= max(_LEAST_TEXT, len(headers[cut]) + _GAP):
            shown, half = sorted([*shown, cut]), {**half, cut: room}
    result = text(shown, half)
    hidden = dict.fromkeys(headers[i] for i in everything if i not in shown)
    return f"{result}\n(--wide shows {', '.join(hidden)})" if hidden else result


def _width_of(text: str) -> int:
    return max(map(len, text.splitlines()), default=0)

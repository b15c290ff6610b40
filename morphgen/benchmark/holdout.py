"""Which of given robots to hold out, so that all their parts are left to train on."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.errors import BenchmarkError

ATTEMPTS = 50
"""Orders in which robots are tried before too few are taken to fit."""


@dataclass(frozen=True)
class Cell:
    """A robot that may be chosen, at a task."""

    name: str
    words: tuple[str, ...]
    """Of ``morphgen compose``."""
    text: str
    """Its derivation."""
    combination: str
    parts: frozenset[str]
    outermost: str
    """The last of its parts, most often the end-effector."""
    task: str

    @property
    def shows(self) -> set[str]:
        """What is trained with it: parts and the task."""
        return {*self.parts, f"task {self.task}"}


def hold_out(
    cells: Sequence[Cell], n: int, left: int, seed: np.random.SeedSequence
) -> tuple[list[Cell], list[Cell]]:
    """Choose cells to test on, of as many combinations as can be.

    No cell of their combinations may be trained on, whatever the task; with several tasks, neither
    may their outermost part at their task. Each part and task of theirs is shown by what is left.

    Args:
        cells: What to choose from.
        n: How many to hold out.
        left: How many must be left, at least.
        seed: Of the order in which they are tried.

    Returns:
        Cells to test on, and cells to train on in an order such that the first few show each part
        and task of those.

    Raises:
        BenchmarkError: If there are not so many; the message says what stands against.
    """
    rng = np.random.default_rng(seed)
    most = 0
    for _ in range(ATTEMPTS):
        pool = _Pool(cells)
        order = [int(i) for i in rng.permutation(len(cells))]
        for fresh in (True, False):
            for i in order:
                if len(pool.held) < n and pool.is_fresh(i) == fresh:
                    pool.hold(i, left)
        if len(pool.held) == n:
            test = [cells[i] for i in pool.held]
            train = [cells[i] for i in order if i in pool.left]
            return test, _covering_first(train, pool.needed)
        most = max(most, len(pool.held))
    raise BenchmarkError(_why_not(cells, n, left, most))


def covering(cells: Sequence[Cell], test: Sequence[Cell]) -> int:
    """How many of the first cells are needed to show each part and task of test cells."""
    needed = {what for cell in test for what in cell.shows}
    n = 0
    while needed:
        needed -= cells[n].shows
        n += 1
    return n


class _Pool:
    """What is left to train on while cells are held out; cells by their index."""

    def __init__(self, cells: Sequence[Cell]) -> None:
        self._cells = cells
        self._mixed = len({cell.task for cell in cells}) > 1
        self._alike: dict[str, list[int]] = defaultdict(list)
        self._pairs: dict[tuple[str, str], list[int]] = defaultdict(list)
        for i, cell in enumerate(cells):
            self._alike[cell.combination].append(i)
            for part in cell.parts:
                self._pairs[part, cell.task].append(i)
        self.left = set(range(len(cells)))
        self._shown = Counter(what for cell in cells for what in cell.shows)
        self.held: list[int] = []
        self.needed: set[str] = set()
        """What must be shown for the cells that are held out."""

    def is_fresh(self, i: int) -> bool:
        """Whether no cell of its combination is held out."""
        return all(self._cells[i].combination != self._cells[j].combination for j in self.held)

    def hold(self, i: int, left: int) -> None:
        """Hold a cell out, if all that it and the others need is left, and enough cells are."""
        cell = self._cells[i]
        barred = set(self._alike[cell.combination])
        if self._mixed:
            barred.update(self._pairs[cell.outermost, cell.task])
        barred &= self.left
        lost = Counter(what for j in barred for what in self._cells[j].shows)
        needed = self.needed | cell.shows
        is_shown = all(self._shown[what] > lost[what] for what in needed)
        if i in self.held or not is_shown or len(self.left) - len(barred) < left:
            return
        self.held.append(i)
        self.needed = needed
        self.left -= barred
        self._shown -= lost


def _covering_first(cells: Sequence[Cell], needed: set[str]) -> list[Cell]:
    """Cells in order, but first those that show all that is needed, as few as come easily."""
    first: list[Cell] = []
    rest = list(cells)
    missing = set(needed)
    while missing:
        best = max(rest, key=lambda cell: len(missing & cell.shows))
        missing -= best.shows
        rest.remove(best)
        first.append(best)
    return first + rest


def _why_not(cells: Sequence[Cell], n: int, left: int, most: int) -> str:
    combinations = {cell.combination: cell.parts for cell in cells}
    counts = Counter(part for parts in combinations.values() for part in parts)
    alone = sorted(part for part, times in counts.items() if times == 1)
    text = (
        f"{most} of {n} test robots can be held out of {len(combinations)} combinations such that "
        "their parts are trained in others"
    )
    if len({cell.task for cell in cells}) > 1:
        text += ", the outermost at another task only,"
    text += f" and at least {left} are left to train on"
    if alone:
        text += f"; in one combination only: {', '.join(alone)}"
    return f"{text}; give --from more choices, or ask for fewer robots"

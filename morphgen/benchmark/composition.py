"""New splits by composition: test robots join parts that are trained, but not together."""

from __future__ import annotations

import itertools
import re
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.benchmark.generate import SplitRequest, assemble
from morphgen.benchmark.regimes import NOTHING, combination, parts
from morphgen.benchmark.robot_factory import ComposedRecipe, Progress, RobotFactory, make_robots
from morphgen.benchmark.split import Member, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.grammar.request import parse_words

ATTEMPTS = 50
"""Orders in which robots are tried before too few are taken to fit."""
_CHOICE = re.compile(r"\{([^{}]*)\}")


def expand(pattern: str) -> list[tuple[str, ...]]:
    """Words of ``morphgen compose`` with choices in braces, written out: the product of all.

    Args:
        pattern: Such as ``arm={ur5,panda} ee={plane,stick}``.

    Raises:
        BenchmarkError: If braces do not match, or hold nothing or the same twice.
    """
    joined = _CHOICE.sub(lambda match: re.sub(r"\s", "", match[0]), pattern)
    if "{" in _CHOICE.sub("", joined) or "}" in _CHOICE.sub("", joined):
        raise BenchmarkError(f"--from {pattern!r}: a brace is not closed, or opened twice")
    words = [_choices(word, pattern) for word in joined.split()]
    if not words:
        raise BenchmarkError("--from is empty; expected such as 'arm={ur5,panda} ee={plane,stick}'")
    return list(itertools.product(*words))


def composition(
    order: SplitRequest,
    patterns: Sequence[str],
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Splits whose test robots have parts that are all trained, in a combination that is not.

    With several tasks a robot is chosen at a task, and counts so. What is composed then is body
    and task: the outermost part of a test robot is in no train robot of its task, but in others.

    Args:
        order: Sizes, tasks, seed. Without a size, all that may be trained on is.
        patterns: What to choose from, see ``expand``.
        library: Where parts are.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Returns:
        A split for every size.

    Raises:
        BenchmarkError: If what is asked for does not exist; the message says what stands against.
        MorphgenError: If words name what does not exist or does not fit.
    """
    cells = list(_cells(patterns, order.tasks, library))
    sequence = np.random.SeedSequence(order.seed)
    test, train = hold_out(cells, order.test, max(order.train, default=1), sequence)
    shortest = num_covering(train, test)
    if order.train and order.train[0] < shortest:
        names = ", ".join(cell.name for cell in train[:shortest])
        raise BenchmarkError(
            f"--train {order.train[0]}: {shortest} robots at least are needed so that every part "
            f"of the test robots is trained, such as {names}"
        )
    chosen = [*train[: order.train[-1] if order.train else None], *test]
    unique = {cell.text: ComposedRecipe(cell.words, cell.name) for cell in chosen}
    maker = RobotFactory(library.folders, max_links=order.max_links)
    made = make_robots(list(unique.values()), maker, jobs=jobs, progress=progress)
    bodies = dict(zip(unique, made, strict=True))
    robots = []
    for cell in chosen:
        body = bodies[cell.text]
        name = f"{cell.name}-{cell.task}" if len(order.tasks) > 1 else cell.name
        task = (cell.task, order.obstacles)
        robots.append(Member(name, body.category, str(body.derivation), *task, body.hash))
    kinds = len({cell.combination for cell in cells})
    return assemble(
        order,
        "composition",
        f"{{n}} robots out of {kinds} combinations; test: {order.test} of combinations unseen",
        robots[: -len(test)],
        robots[-len(test) :],
        {"from": list(patterns), "tasks": list(order.tasks)},
    )


def _choices(word: str, pattern: str) -> list[str]:
    """A word once for every choice in its braces."""
    fixed = _CHOICE.split(word)[::2]
    choices = [match.split(",") for match in _CHOICE.findall(word)]
    for given in choices:
        twice = [choice for choice, times in Counter(given).items() if times > 1]
        if "" in given or twice:
            what = f"has {twice[0]!r} twice" if twice and twice[0] else "has an empty choice"
            raise BenchmarkError(f"--from {pattern!r}: {{{','.join(given)}}} {what}")
    return [
        "".join(
            piece for pair in itertools.zip_longest(fixed, chosen, fillvalue="") for piece in pair
        )
        for chosen in itertools.product(*choices)
    ]


def _cells(
    patterns: Sequence[str], tasks: Sequence[str], library: Library
) -> Iterator[HoldoutCandidate]:
    """Every robot that the patterns name, once, at every task."""
    seen: dict[str, str] = {}
    for words in itertools.chain.from_iterable(map(expand, patterns)):
        derivation, name = parse_words(words, library)
        if str(derivation) in seen:
            continue
        if name in seen.values():
            name = f"{name}-{derivation.digest[:8]}"
        seen[str(derivation)] = name
        *_, last = (node.part for node in derivation.walk() if node.part != NOTHING)
        about = (str(derivation), combination(derivation), parts(derivation), last)
        for task in tasks:
            yield HoldoutCandidate(name, words, *about, task)


@dataclass(frozen=True)
class HoldoutCandidate:
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
    cells: Sequence[HoldoutCandidate], n: int, left: int, seed: np.random.SeedSequence
) -> tuple[list[HoldoutCandidate], list[HoldoutCandidate]]:
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


def num_covering(cells: Sequence[HoldoutCandidate], test: Sequence[HoldoutCandidate]) -> int:
    """How many of the first cells are needed to show each part and task of test cells."""
    needed = {what for cell in test for what in cell.shows}
    n = 0
    while needed:
        needed -= cells[n].shows
        n += 1
    return n


class _Pool:
    """What is left to train on while cells are held out; cells by their index."""

    def __init__(self, cells: Sequence[HoldoutCandidate]) -> None:
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


def _covering_first(cells: Sequence[HoldoutCandidate], needed: set[str]) -> list[HoldoutCandidate]:
    """Cells in order, but first those that show all that is needed, as few as come easily."""
    first: list[HoldoutCandidate] = []
    rest = list(cells)
    missing = set(needed)
    while missing:
        best = max(rest, key=lambda cell: len(missing & cell.shows))
        missing -= best.shows
        rest.remove(best)
        first.append(best)
    return first + rest


def _why_not(cells: Sequence[HoldoutCandidate], n: int, left: int, most: int) -> str:
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

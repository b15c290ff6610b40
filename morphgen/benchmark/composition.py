"""New splits by composition: test robots join parts that are trained, but not together."""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from morphgen.benchmark.bodies import Composed, Maker, Progress, make_all
from morphgen.benchmark.generate import Order, assemble
from morphgen.benchmark.holdout import Cell, covering, hold_out
from morphgen.benchmark.regimes import NOTHING, combination, parts
from morphgen.benchmark.split import Member, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.grammar.request import parse_words

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
    order: Order,
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
    shortest = covering(train, test)
    if order.train and order.train[0] < shortest:
        names = ", ".join(cell.name for cell in train[:shortest])
        raise BenchmarkError(
            f"--train {order.train[0]}: {shortest} robots at least are needed so that every part "
            f"of the test robots is trained, such as {names}"
        )
    chosen = [*train[: order.train[-1] if order.train else None], *test]
    unique = {cell.text: Composed(cell.words, cell.name) for cell in chosen}
    maker = Maker(library.folders, max_links=order.max_links)
    made = make_all(list(unique.values()), maker, jobs=jobs, progress=progress)
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


def _cells(patterns: Sequence[str], tasks: Sequence[str], library: Library) -> Iterator[Cell]:
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
            yield Cell(name, words, *about, task)

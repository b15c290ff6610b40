"""New splits by extrapolation: test robots are of a category that is not trained."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.benchmark.generate import (
    RobotStream,
    SplitRequest,
    TestRobotSearch,
    assemble_drawn,
    require_size,
)
from morphgen.benchmark.regimes import structure
from morphgen.benchmark.robot_factory import Candidate, Progress, RobotFactory, make_robots
from morphgen.benchmark.similarity import cosine
from morphgen.benchmark.split import Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library

_BOUND = re.compile(r"\s*([<>])\s*(\d+\.?\d*|\.\d+)\s*")


@dataclass(frozen=True)
class Bound:
    """What the cosine of a test robot to the train robot nearest to it must be.

    The largest cosine, not the mean: a mean hides a twin among strangers.
    """

    is_upper: bool
    value: float

    def __str__(self) -> str:
        return f"{'<' if self.is_upper else '>'}{self.value:g}"

    def holds(self, largest: float) -> bool:
        """Whether a cosine is on the right side."""
        return largest < self.value if self.is_upper else largest > self.value


def parse_bound(text: str) -> Bound:
    """Read a bound such as ``<0.6``.

    Raises:
        BenchmarkError: If it is none.
    """
    match = _BOUND.fullmatch(text)
    if match is None or float(match[2]) > 1:
        raise BenchmarkError(
            f"--similarity {text!r}: expected '<' or '>' and a number from 0 to 1, such as '<0.6'"
        )
    return Bound(match[1] == "<", float(match[2]))


def extrapolation(
    order: SplitRequest,
    train_grammars: Sequence[Grammar],
    test_grammars: Sequence[Grammar],
    library: Library,
    *,
    similarity: Bound | None = None,
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Splits whose test robots are of a grammar, and a structure, that no train robot is of.

    Robots are taken from the grammars in turn, so they are spread evenly over them.

    Args:
        order: Sizes, tasks, seed.
        train_grammars: Of the train robots.
        test_grammars: Of the test robots.
        library: Where parts are.
        similarity: What test robots must meet, for every size.
        jobs: Processes.
        progress: Told how many robots are done, again and again.

    Returns:
        A split for every size.

    Raises:
        BenchmarkError: If a grammar is named twice, or too few test robots are found in
            ``MAX_DRAWS`` draws of which ``MAX_COMPOSED`` are composed.
        SamplingError: If a robot cannot be drawn.
    """
    require_size(order)
    _require_apart(train_grammars, test_grammars)
    trained, tested = (
        [RobotStream.of(grammar, grammar.name, order) for grammar in grammars]
        for grammars in (train_grammars, test_grammars)
    )
    maker = RobotFactory(
        library.folders, comparable=similarity is not None, max_links=order.max_links
    )
    turns = (divmod(i, len(trained)) for i in range(order.train[-1]))
    recipes = [trained[which].recipe(number) for number, which in turns]
    train = make_robots(recipes, maker, jobs=jobs, progress=progress)
    names = {structure(body.derivation, library): body.name for body in reversed(train)}

    def why_not(derivation: Derivation) -> str:
        twin = names.get(structure(derivation, library))
        return f"the structure of train robot {twin}" if twin else ""

    alike = _Likeness(train, order.train[0], similarity)
    search = TestRobotSearch(order, train, maker, progress)
    targets = ", ".join(grammar.name for grammar in test_grammars)
    if not search.find(tested, why_not, alike):
        raise BenchmarkError(f"{targets}: {search.failure()}; {alike.advice()}")
    sources = ", ".join(grammar.name for grammar in train_grammars)
    return assemble_drawn(
        order,
        "extrapolation",
        f"{{n}} robots of {sources}; test: {order.test} of {targets}",
        train,
        search.found,
        {
            "train_categories": {grammar.name: grammar.digest for grammar in train_grammars},
            "test_categories": {grammar.name: grammar.digest for grammar in test_grammars},
            **({"similarity": str(similarity)} if similarity else {}),
            "seeds": {stream.prefix: stream.seed for stream in (*trained, *tested)},
        },
    )


class _Likeness:
    """Whether a body is as alike to the train robots as wanted."""

    def __init__(self, train: Sequence[Candidate], smallest: int, bound: Bound | None) -> None:
        # The largest cosine grows with the set.
        self._train = train[:smallest] if bound and not bound.is_upper else train
        self._bound = bound
        self._nearest: list[tuple[float, str, str]] = []

    def __call__(self, body: Candidate) -> str:
        """What a body has that it shall not; nothing if it is as wanted."""
        if self._bound is None or body.features is None:
            return ""
        cosines = [cosine(body.features, each.features) for each in self._train if each.features]
        most = int(np.argmax(cosines))
        if self._bound.holds(cosines[most]):
            return ""
        self._nearest.append((cosines[most], body.name, self._train[most].name))
        return f"a cosine to the nearest train robot that is not {self._bound}"

    def advice(self) -> str:
        """What to change where too few are found."""
        if self._bound is None or not self._nearest:
            return "choose other categories, or fewer test robots"
        best = min(self._nearest) if self._bound.is_upper else max(self._nearest)
        return (
            f"the nearest to the bound was {best[1]}, with {best[0]:.3f} to {best[2]}: choose "
            "another bound, or other categories"
        )


def _require_apart(train: Sequence[Grammar], test: Sequence[Grammar]) -> None:
    for option, own, others in (
        ("--train-category", train, ()),
        ("--test-category", test, train),
    ):
        seen = {grammar.name for grammar in others}
        for grammar in own:
            if grammar.name in seen:
                where = "on both sides" if others else "there twice"
                raise BenchmarkError(
                    f"{option} {grammar.name}: the category is {where}; a test category must not "
                    "be trained, and none be named twice"
                )
            seen.add(grammar.name)

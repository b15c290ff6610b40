"""Generate extrapolation splits: test robots come from grammars without train robots."""

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
    """Bound on the cosine similarity of a test robot to the nearest train robot.

    It is the largest cosine, because a mean would hide one near duplicate among other robots.
    """

    is_upper: bool
    """Whether the cosine must be below ``value``; above it otherwise."""
    value: float

    def __str__(self) -> str:
        return f"{'<' if self.is_upper else '>'}{self.value:g}"

    def holds(self, largest: float) -> bool:
        """Test if the cosine to the nearest train robot meets the bound."""
        return largest < self.value if self.is_upper else largest > self.value


def parse_bound(text: str) -> Bound:
    """Read a bound such as ``<0.6``.

    Raises:
        BenchmarkError: If the text is malformed.
    """
    match = _BOUND.fullmatch(text)
    if match is None or float(match[2]) > 1:
        raise BenchmarkError(
            f"--similarity {text!r}: expected '<' or '>' and a number from 0 to 1, such as '<0.6'"
        )
    return Bound(match[1] == "<", float(match[2]))


def extrapolation(
    request: SplitRequest,
    train_grammars: Sequence[Grammar],
    test_grammars: Sequence[Grammar],
    library: Library,
    *,
    similarity: Bound | None = None,
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Return splits whose test robots share no grammar and no structure with a train robot.

    Robots are sampled from the grammars in turn, so each grammar gives equally many.

    Args:
        request: Sizes, tasks and seed.
        train_grammars: Grammars of the train robots.
        test_grammars: Grammars of the test robots.
        library: The library of parts.
        similarity: Bound that test robots must meet in the split of every size.
        jobs: Number of processes.
        progress: Receives the number of robots that are finished.

    Returns:
        A split for each size.

    Raises:
        BenchmarkError: If a grammar is named twice, or ``MAX_DRAWS`` draws, of which
            ``MAX_COMPOSED`` are composed, give too few test robots.
        SamplingError: If a grammar gives no valid robot.
    """
    require_size(request)
    _require_apart(train_grammars, test_grammars)
    train_streams, test_streams = (
        [RobotStream.of(grammar, grammar.name, request) for grammar in grammars]
        for grammars in (train_grammars, test_grammars)
    )
    factory = RobotFactory(
        library.folders, with_features=similarity is not None, max_links=request.max_links
    )
    turns = (divmod(i, len(train_streams)) for i in range(request.train[-1]))
    recipes = [train_streams[stream].recipe(number) for number, stream in turns]
    train = make_robots(recipes, factory, jobs=jobs, progress=progress)
    reject_trained = UntrainedStructure(train, library)
    reject_by_similarity = SimilarityBound(train, request.train[0], similarity)
    search = TestRobotSearch(request, train, factory, progress)
    targets = ", ".join(grammar.name for grammar in test_grammars)
    if not search.find(test_streams, reject_trained, reject_by_similarity):
        raise BenchmarkError(f"{targets}: {search.failure()}; {reject_by_similarity.advice()}")
    sources = ", ".join(grammar.name for grammar in train_grammars)
    return assemble_drawn(
        request,
        "extrapolation",
        f"{{n}} robots of {sources}; test: {request.test} of {targets}",
        train,
        search.robots,
        {
            "train_categories": {grammar.name: grammar.digest for grammar in train_grammars},
            "test_categories": {grammar.name: grammar.digest for grammar in test_grammars},
            **({"similarity": str(similarity)} if similarity else {}),
            "seeds": {stream.prefix: stream.seed for stream in (*train_streams, *test_streams)},
        },
    )


class UntrainedStructure:
    """Reject derivations that have the structure of a train robot."""

    def __init__(self, train: Sequence[Candidate], library: Library) -> None:
        self._library = library
        self._names = {structure(each.derivation, library): each.name for each in reversed(train)}

    def __call__(self, derivation: Derivation) -> str:
        """Return the reason why a derivation is rejected; empty if it is accepted."""
        twin = self._names.get(structure(derivation, self._library))
        return f"the structure of train robot {twin}" if twin else ""


class SimilarityBound:
    """Reject robots whose cosine to the nearest train robot violates the bound."""

    def __init__(self, train: Sequence[Candidate], smallest: int, bound: Bound | None) -> None:
        # The largest cosine grows with the set.
        self._train = train[:smallest] if bound and not bound.is_upper else train
        self._bound = bound
        self._nearest: list[tuple[float, str, str]] = []

    def __call__(self, robot: Candidate) -> str:
        """Return the reason why a robot is rejected; empty if it is accepted."""
        if self._bound is None or robot.features is None:
            return ""
        cosines = [
            cosine(robot.features, other.features) for other in self._train if other.features
        ]
        nearest = int(np.argmax(cosines))
        if self._bound.holds(cosines[nearest]):
            return ""
        self._nearest.append((cosines[nearest], robot.name, self._train[nearest].name))
        return f"a cosine to the nearest train robot that is not {self._bound}"

    def advice(self) -> str:
        """Return what to change if a search finds too few robots."""
        if self._bound is None or not self._nearest:
            return "choose other categories, or fewer test robots"
        best = min(self._nearest) if self._bound.is_upper else max(self._nearest)
        return (
            f"the nearest to the bound was {best[1]}, with {best[0]:.3f} to {best[2]}: choose "
            "another bound, or other categories"
        )


def _require_apart(train: Sequence[Grammar], test: Sequence[Grammar]) -> None:
    """Require that no grammar is named twice, on one side or on both."""
    for option, grammars, excluded in (
        ("--train-category", train, ()),
        ("--test-category", test, train),
    ):
        names = {grammar.name for grammar in excluded}
        for grammar in grammars:
            if grammar.name in names:
                where = "on both sides" if excluded else "there twice"
                raise BenchmarkError(
                    f"{option} {grammar.name}: the category is {where}; a test category must not "
                    "be trained, and none be named twice"
                )
            names.add(grammar.name)

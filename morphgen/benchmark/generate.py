"""Generate splits by the rules of interpolation and extrapolation.

``hold_out`` generates splits from what they hold out, with the same request, robots and assembly.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.benchmark.regimes import HULLS, RuledRobot, regime_violations
from morphgen.encoding.similarity import is_near
from morphgen.encoding.tokens import MAX_LINKS, require_max_links
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.derive import RandomChooser, TooManyPartsError, derive
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.syntax import Derivation
from morphgen.processes import parallel_map
from morphgen.progress import report, show_progress
from morphgen.splits.split import (
    COMPOSED,
    MAX_LINKS_KEY,
    Candidate,
    Member,
    Regime,
    RobotFactory,
    SampledRecipe,
    Split,
    numbered_name,
)


def stream_seed(seed: int, prefix: str) -> int:
    """Return the seed of robots with one name prefix, whatever others a split samples."""
    return int(np.random.SeedSequence([seed, *prefix.encode()]).generate_state(1)[0])


MAX_DRAWS = 2000
"""Number of rejected draws after which a search fails. A draw is cheap: most are rejected by their
derivations."""
MAX_COMPOSED = 200
"""Number of rejected robots after which a search fails, of those that had to be composed."""


@dataclass(frozen=True)
class SplitRequest:
    """Request for one or several splits, of any regime."""

    name: str  # name of the split; with several sizes `-train30` and so on is appended
    train: tuple[int, ...]
    """Numbers of train robots, one per split. The splits share their test robots, and the train
    robots of a smaller split are the first of a larger one."""
    test: int  # number of test robots
    tasks: tuple[str, ...] = ("reach",)
    obstacles: bool = False
    seed: int = 0
    max_links: int = MAX_LINKS
    """Largest number of links of a robot; link indices in tokens are divided by one less."""

    def __post_init__(self) -> None:
        sizes = ",".join(map(str, self.train))
        if min(self.train, default=0) < 1 or self.test < 1 or self.seed < 0:
            raise BenchmarkError(
                f"--train {sizes} --test {self.test} --seed {self.seed}: "
                "--train and --test start at 1, --seed at 0"
            )
        require_max_links(0, "an order", self.max_links)
        if list(self.train) != sorted(set(self.train)):
            raise BenchmarkError(f"--train {sizes}: expected sizes that grow, such as 10,30,100")


@dataclass(frozen=True)
class RobotStream:
    """The endless sequence of robots sampled from a grammar with one seed."""

    grammar: Grammar
    prefix: str  # prefix of the robots' names
    seed: int  # seed; `morphgen sample --seed` gives the same robots

    @classmethod
    def of(cls, grammar: Grammar, prefix: str, request: SplitRequest) -> RobotStream:
        """Return the stream of a name prefix in a split."""
        return cls(grammar, prefix, stream_seed(request.seed, prefix))

    def recipe(self, number: int) -> SampledRecipe:
        """Return the recipe of a robot."""
        return SampledRecipe(self.grammar, number, self.seed, numbered_name(self.prefix, number))

    def derivation(self, number: int, library: Library) -> Derivation | None:
        """Return the first derivation drawn, which conditions may reject; None if too large."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        try:
            return derive(self.grammar, library, RandomChooser(rng))
        except TooManyPartsError:
            return None


_REASONS = {
    "structure-unseen": "a structure that no train robot has",
    "hull": "parameters on the other side of the hull of the train robots",
    "structure-seen": "the structure of a train robot",
}
"""Reasons for rejecting a robot by the code of the audit's finding."""


def _drawn_splits(
    request: SplitRequest,
    regime: Regime,
    summary: str,
    streams: tuple[Sequence[RobotStream], Sequence[RobotStream]],
    factory: RobotFactory,
    provenance: Mapping[str, object],
    advice: str,
    jobs: int,
) -> tuple[Split, ...]:
    """Return splits of robots that are taken from streams of train and test robots in turn.

    advice: What to change if a search finds too few robots.
    """
    train_streams, test_streams = streams
    turns = (divmod(i, len(train_streams)) for i in range(request.train[-1]))
    recipes = [train_streams[stream].recipe(number) for number, stream in turns]
    train = list(parallel_map(factory, recipes, jobs))
    # Sizes between the smallest and the largest split cannot violate what both obey.
    sides = [train[:size] for size in sorted({request.train[0], request.train[-1]})]
    library = factory.library
    parsed = [[RuledRobot.of(each, library) for each in side] for side in sides]
    name_by_hash = {robot.hash: robot.name for robot in train}

    def violated(derivation: Derivation) -> str:
        """Return the reason of the first finding that an audit would have; empty if none."""
        test = RuledRobot("", COMPOSED, "", derivation, library)
        found = (regime_violations(regime, provenance, test, side) for side in parsed)
        return next((_REASONS[finding.code] for finding in itertools.chain(*found)), "")

    def refused(robot: Candidate) -> str:
        if twin := name_by_hash.get(robot.hash):
            return f"the body of {twin}"
        # A robot has another derivation if the conditions of its grammar reject the first one.
        reasons = (_near_reason(robot, side) for side in sides)
        return violated(robot.derivation) or next(filter(None, reasons), "")

    test: list[Candidate] = []
    rejected: Counter[str] = Counter()
    num_composed = 0  # robots that were composed and rejected
    numbers = ((number, stream) for number in itertools.count() for stream in test_streams)
    while len(test) < request.test:
        if rejected.total() == MAX_DRAWS or num_composed == MAX_COMPOSED:
            reason, count = rejected.most_common(1)[0]
            raise BenchmarkError(
                f"{', '.join(stream.grammar.name for stream in test_streams)}: {len(test)} of "
                f"{request.test} test robots found in {rejected.total() + len(test)} draws; "
                f"{count} had {reason}; {advice}"
            )
        number, stream = next(numbers)
        derivation = stream.derivation(number, library)
        if reason := violated(derivation) if derivation else "no end":
            rejected[reason] += 1
            continue
        with show_progress(None):  # one robot is one step, whatever its fits report
            robot = factory(stream.recipe(number))
        if reason := refused(robot):
            rejected[reason] += 1
            num_composed += 1
            continue
        name_by_hash[robot.hash] = robot.name
        test.append(robot)
        report(len(train) + len(test), None)
    seeds = {stream.prefix: stream.seed for stream in (*train_streams, *test_streams)}
    first, second = (members(request, side) for side in (train, test))
    provenance = {**provenance, "seeds": seeds}
    return assemble(request, regime, summary, first, second, provenance)


def assemble(
    request: SplitRequest,
    regime: Regime,
    summary: str,
    train: Sequence[Sequence[Member]],
    test: Sequence[Sequence[Member]],
    provenance: Mapping[str, object],
) -> tuple[Split, ...]:
    """Return the requested splits, one for each size, from the members of every robot."""
    sizes = request.train
    nested = {"nested": list(sizes)} if len(sizes) > 1 else {}
    links = {} if request.max_links == MAX_LINKS else {MAX_LINKS_KEY: request.max_links}
    return tuple(
        Split(
            f"{request.name}-train{n}" if nested else request.name,
            regime,
            summary.format(n=n),
            tuple(itertools.chain(*train[:n])),
            tuple(itertools.chain(*test)),
            {
                "seed": request.seed,
                "train": n,
                **nested,
                "test": request.test,
                **links,
                **provenance,
            },
        )
        for n in sizes
    )


def members(request: SplitRequest, robots: Iterable[Candidate]) -> list[list[Member]]:
    """Return the members of every robot: one for each task of a request."""
    tasks, obstacles = request.tasks, request.obstacles
    return [[robot.member(task, tasks, obstacles) for task in tasks] for robot in robots]


def interpolation(
    request: SplitRequest, grammar: Grammar, library: Library, *, hull: str = "any", jobs: int = 1
) -> tuple[Split, ...]:
    """Return splits whose test robots, of another seed, have the structure of a train robot."""
    if hull not in HULLS:
        raise BenchmarkError(f"--hull {hull}: unknown{nearest(hull, HULLS)}")
    train = RobotStream.of(grammar, grammar.name, request)
    test = RobotStream.of(grammar, f"{grammar.name}-test", request)
    where = {"inside": "within their hull", "outside": "outside their hull", "any": "more"}
    advice = {
        "inside": "ask for more train robots, or for --hull any",
        "outside": "ask for fewer train robots, or for --hull any",
        "any": "ask for fewer test robots, or more train robots",
    }
    return _drawn_splits(
        request,
        "interpolation",
        f"{{n}} robots of {grammar.name}; test: {request.test} {where[hull]}",
        ([train], [test]),
        RobotFactory(library, with_features=True, max_links=request.max_links),
        {"grammar": {grammar.name: grammar.digest}, "hull": hull},
        advice[hull],
        jobs,
    )


def _near_reason(robot: Candidate, others: Iterable[Candidate]) -> str:
    """Return the first robot that the audit would call nearly the same; empty if none is."""
    for other in others:
        if robot.features and other.features and is_near(robot.features, other.features):
            return f"almost the sizes of {other.name}"
    return ""


def extrapolation(
    request: SplitRequest,
    train_grammars: Sequence[Grammar],
    test_grammars: Sequence[Grammar],
    library: Library,
    *,
    jobs: int = 1,
) -> tuple[Split, ...]:
    """Return splits whose test robots share no grammar and no structure with a train robot."""
    _require_apart(train_grammars, test_grammars)
    train_streams, test_streams = (
        [RobotStream.of(grammar, grammar.name, request) for grammar in grammars]
        for grammars in (train_grammars, test_grammars)
    )
    sources, targets = (
        ", ".join(grammar.name for grammar in grammars)
        for grammars in (train_grammars, test_grammars)
    )
    return _drawn_splits(
        request,
        "extrapolation",
        f"{{n}} robots of {sources}; test: {request.test} of {targets}",
        (train_streams, test_streams),
        RobotFactory(library, max_links=request.max_links),
        {
            "train_categories": {grammar.name: grammar.digest for grammar in train_grammars},
            "test_categories": {grammar.name: grammar.digest for grammar in test_grammars},
        },
        "choose other categories, or fewer test robots",
        jobs,
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

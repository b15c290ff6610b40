"""The regimes: their rules, tested on parts and parameters alone, and splits that follow them.

``hold_out`` generates splits from what they hold out, with the same request, robots and assembly.
"""

from __future__ import annotations

import itertools
import re
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy  # loads its packages at their first use, which take seconds
from numpy.typing import ArrayLike

from morphgen.encoding.similarity import is_near
from morphgen.encoding.tokens import MAX_LINKS, require_max_links
from morphgen.errors import BenchmarkError, CompositionError, nearest
from morphgen.grammar.derive import RandomChooser, TooManyPartsError, derive
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW
from morphgen.grammar.request import SLOTS
from morphgen.grammar.syntax import Derivation, parse_derivation
from morphgen.model.findings import Finding, texts_of
from morphgen.processes import parallel_map
from morphgen.progress import report, show_progress
from morphgen.splits.split import (
    COMPOSED,
    MAX_LINKS_KEY,
    Candidate,
    DerivedRecipe,
    Member,
    Regime,
    RobotFactory,
    SampledRecipe,
    Split,
    numbered_name,
    recipe_of,
)

NOTHING = "none"  # name of the part for robots without an end-effector
_CHOICE = re.compile(r"\{([^{}]*)\}")
_WILDCARD = re.compile(r"[*?[]")
found = texts_of(Path(__file__).with_name("findings.yaml"))


def pattern_robots(pattern: str, library: Library) -> list[DerivedRecipe]:
    """Return a pattern's robots: ``ee=*`` is all parts that fit; ``none`` must be named."""
    robots: list[DerivedRecipe] = []
    for words in expand(pattern):
        choices = [_matching(word, pattern, library) for word in words]
        misfit: CompositionError | None = None
        fitting: list[DerivedRecipe] = []
        for concrete in itertools.product(*choices):
            try:
                fitting.append(recipe_of(concrete, library))
            except CompositionError as error:
                if concrete == words:  # named parts must fit; a wildcard means those that do
                    raise
                misfit = error
        if misfit is not None and not fitting:
            raise misfit
        robots += fitting
    return robots


def expand(pattern: str) -> list[tuple[str, ...]]:
    """Expand the choices in braces in arguments of ``morphgen compose``: the product of all."""
    joined = _CHOICE.sub(lambda match: re.sub(r"\s", "", match[0]), pattern)
    if "{" in _CHOICE.sub("", joined) or "}" in _CHOICE.sub("", joined):
        raise BenchmarkError(f"--from {pattern!r}: a brace is not closed, or opened twice")
    words = [_choices(word, pattern) for word in joined.split()]
    if not words:
        raise BenchmarkError("--from is empty; expected such as 'arm={ur5,panda} ee={plane,stick}'")
    return list(itertools.product(*words))


def _choices(word: str, pattern: str) -> list[str]:
    """Return a word once for each choice in its braces."""
    fixed = _CHOICE.split(word)[::2]
    choices = [match.split(",") for match in _CHOICE.findall(word)]
    for options in choices:
        twice = [choice for choice, times in Counter(options).items() if times > 1]
        if "" in options or twice:
            what = f"has {twice[0]!r} twice" if twice and twice[0] else "has an empty choice"
            raise BenchmarkError(f"--from {pattern!r}: {{{','.join(options)}}} {what}")
    return [
        "".join(
            piece for pair in itertools.zip_longest(fixed, chosen, fillvalue="") for piece in pair
        )
        for chosen in itertools.product(*choices)
    ]


def _matching(word: str, pattern: str, library: Library) -> Sequence[str]:
    """Return a word once for each part that its wildcard matches."""
    key, _, value = word.partition("=")
    slot = key.rpartition(".")[2]
    if slot not in SLOTS or not _WILDCARD.search(value):
        return [word]
    names = library.names(slot)
    matching = [name for name in names if name != NOTHING and fnmatchcase(name, value)]
    if not matching:
        raise BenchmarkError(
            f"--from {pattern!r}: no {slot} matches {value!r}{nearest(value, names)}"
        )
    return [f"{key}={name}" for name in matching]


HULLS = ("inside", "outside", "any")
"""Position of a test robot's parameters relative to the convex hull of the train robots."""
ON_HULL = 1e-6
"""Distance up to which a point counts as inside the hull, in ranges of the parameters."""
_SAME = 1e-9  # relative difference below which a parameter does not vary


def structure(derivation: Derivation, library: Library) -> str:
    """Return the parts of a robot, their ports, and their counts, such as the number of fingers.

    Labels and parameters that are not whole numbers are omitted. Robots of one structure have the
    same links and joints at different sizes.
    """
    counts = [
        f"{name}={value:g}"
        for name, value in _values(derivation, library).items()
        if _is_count(name, derivation, library)
    ]
    below = [f"{port}: {structure(child, library)}" for port, child in derivation.children]
    return derivation.part + _bracketed("({})", counts) + _bracketed("[{}]", below)


def combination(derivation: Derivation) -> str:
    """Return the parts of a robot and their ports: its structure without counts."""
    below = [f"{port}: {combination(child)}" for port, child in derivation.children]
    return derivation.part + _bracketed("[{}]", below)


def parts(derivation: Derivation) -> frozenset[str]:
    """Return the parts of a robot, except ``none``."""
    return frozenset(node.part for node in derivation.walk()) - {NOTHING}


def parameters(derivation: Derivation, library: Library) -> dict[str, float]:
    """Return all parameters that are not whole numbers, under keys such as ``1.length`` [SI units].

    Parts are numbered as in ``Derivation.walk``, so robots of one structure have the same keys.
    """
    result: dict[str, float] = {}
    for index, node in enumerate(derivation.walk()):
        yaw = {MOUNT_YAW: 0.0} if index else {}  # derivations omit it where it is 0
        values = yaw | _values(node, library)
        result |= {
            f"{index}.{name}": values[name]
            for name in sorted(values)
            if not _is_count(name, node, library)
        }
    return result


def hull_distance(point: ArrayLike, points: ArrayLike) -> float:
    """Return the distance of a point (d,) from the convex hull of others (n, d); 0 inside.

    It is the smallest L1 distance, each coordinate divided by its range over the others, by a
    linear program, exact to ``ON_HULL``. A point that differs where all others are equal is
    infinitely far.
    """
    x, others = np.asarray(point, dtype=np.float64), np.asarray(points, dtype=np.float64)
    low, span = others.min(axis=0), np.ptp(others, axis=0)
    varied = span > _SAME * np.abs(others).max(axis=0)
    if not np.allclose(x[~varied], low[~varied], rtol=_SAME, atol=_SAME):
        return float("inf")
    if not varied.any():
        return 0.0
    scaled = (others[:, varied] - low[varied]) / span[varied]
    target = (x[varied] - low[varied]) / span[varied]
    n, d = scaled.shape
    # Variables: the convex weights of the points, then the negative and positive deviation in each
    # coordinate, whose sum is minimised.
    equal = np.block([[scaled.T, np.eye(d), -np.eye(d)], [np.ones((1, n)), np.zeros((1, 2 * d))]])
    cost = np.concatenate([np.zeros(n), np.ones(2 * d)])
    solution = scipy.optimize.linprog(cost, A_eq=equal, b_eq=np.append(target, 1.0), method="highs")
    return max(float(solution.fun), 0.0)


def regime_findings(split: Split, library: Library) -> tuple[Finding, ...]:
    """Return the violations of a split's regime that the derivations show; see docs/splits.md."""
    train = [RuledRobot.of(member, library) for member in split.train]
    test = [RuledRobot.of(member, library) for member in split.test]
    tasks = {robot.task for robot in train}
    findings: list[Finding] = []
    for robot in test:
        if robot.task not in tasks:
            findings.append(found("task-unseen", robot.where, task=robot.task))
        findings += regime_violations(split.regime, split.provenance, robot, train)
    return tuple(findings)


@dataclass(frozen=True)
class RuledRobot:
    """A robot with the properties that the rules of the regimes compare."""

    name: str
    category: str
    task: str
    derivation: Derivation
    library: Library = field(repr=False, compare=False)

    @classmethod
    def of(cls, robot: Member | Candidate, library: Library) -> RuledRobot:
        """Return the robot of a member, or of a candidate, which has no task yet."""
        if isinstance(robot, Candidate):
            return cls(robot.name, robot.category, "", robot.derivation, library)
        derivation = parse_derivation(robot.derivation, f"derivation of {robot.name!r}")
        return cls(robot.name, robot.category, robot.task, derivation, library)

    @property
    def where(self) -> str:
        """The test robot as the place of a finding."""
        return f"test robot {self.name}"

    @cached_property
    def structure(self) -> str:
        """See ``structure``."""
        return structure(self.derivation, self.library)

    @cached_property
    def combination(self) -> str:
        """See ``combination``."""
        return combination(self.derivation)

    @cached_property
    def parts(self) -> frozenset[str]:
        """See ``parts``."""
        return parts(self.derivation)

    @property
    def outermost(self) -> str:
        """The last part of the robot, usually the end-effector."""
        *_, last = (node.part for node in self.derivation.walk() if node.part != NOTHING)
        return last

    @cached_property
    def covers(self) -> frozenset[str]:
        """The parts and the task that training with this robot covers."""
        return self.parts | {f"task {self.task}"}

    @cached_property
    def parameters(self) -> list[float]:
        """Values of ``parameters``."""
        return list(parameters(self.derivation, self.library).values())


def regime_violations(
    regime: Regime, provenance: Mapping[str, object], test: RuledRobot, train: Sequence[RuledRobot]
) -> Iterator[Finding]:
    """Yield how a test robot violates the rule of a regime; generators then draw another."""
    if regime == "interpolation":
        return _interpolation(str(provenance.get("hull", "any")), test, train)
    if regime == "composition":
        return _composition(test, train)
    return _extrapolation(test, train) if regime == "extrapolation" else iter(())


def _interpolation(hull: str, test: RuledRobot, train: Sequence[RuledRobot]) -> Iterator[Finding]:
    same_structure = [robot for robot in train if robot.structure == test.structure]
    if not same_structure:
        yield found("structure-unseen", test.where, structure=test.structure)
        return
    if hull not in HULLS[:2]:
        return
    distance = hull_distance(test.parameters, [robot.parameters for robot in same_structure])
    if (distance <= ON_HULL) != (hull == "inside"):
        lie = "inside" if distance <= ON_HULL else f"outside, by {distance:.3g} ranges,"
        yield found("hull", test.where, lie=lie, count=len(same_structure), hull=hull)


def _composition(test: RuledRobot, train: Sequence[RuledRobot]) -> Iterator[Finding]:
    unseen = sorted(test.parts.difference(*(robot.parts for robot in train)))
    if unseen:
        yield found("part-unseen", test.where, parts=", ".join(map(repr, unseen)))
    twin = next((robot.name for robot in train if robot.combination == test.combination), None)
    if twin:
        yield found("combination-seen", test.where, twin=twin, combination=test.combination)
    if len({robot.task for robot in train}) > 1 and not unseen:
        task = test.task
        if not test.parts.difference(*(robot.parts for robot in train if robot.task == task)):
            yield found("pair-seen", test.where, task=task)


def _extrapolation(test: RuledRobot, train: Sequence[RuledRobot]) -> Iterator[Finding]:
    if test.category != COMPOSED and test.category in {robot.category for robot in train}:
        yield found("category-seen", test.where, category=test.category)
    twin = next((robot.name for robot in train if robot.structure == test.structure), None)
    if twin:
        yield found("structure-seen", test.where, twin=twin, structure=test.structure)


def _values(node: Derivation, library: Library) -> dict[str, float]:
    """Return the parameters of a part, with defaults for those that the derivation omits."""
    known = library.manifest(node.part).parameters
    return {name: known[name].default for name in known} | dict(node.parameters)


def _is_count(name: str, node: Derivation, library: Library) -> bool:
    known = library.manifest(node.part).parameters
    return name in known and known[name].integer


def _bracketed(brackets: str, entries: Iterable[str]) -> str:
    text = ", ".join(entries)
    return brackets.format(text) if text else ""


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
    """Return splits of robots from streams in turn; errors give advice on what to change."""
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
        reasons = (near_reason(robot, side) for side in sides)
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


def near_reason(robot: Candidate, others: Iterable[Candidate]) -> str:
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

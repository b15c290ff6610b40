"""What the generators of new splits share: the order, the search for test robots, the result."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.benchmark.robot_factory import (
    Candidate,
    Progress,
    RobotFactory,
    SampledRecipe,
    members,
    numbered_name,
    stream_seed,
)
from morphgen.benchmark.split import MAX_LINKS_KEY, Member, Regime, Split
from morphgen.benchmark.token_layout import MAX_LINKS, require_max_links
from morphgen.errors import BenchmarkError
from morphgen.grammar.choosers import RandomChooser, RecordedChooser
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.derive import TooManyPartsError, derive
from morphgen.grammar.grammar_file import Grammar
from morphgen.grammar.library import Library

MAX_DRAWS = 2000
"""Draws that are no test robot before what is asked for is taken to be too hard. They are cheap:
most are rejected by their derivations."""
MAX_COMPOSED = 200
"""The same of those that had to be composed to be looked at."""


@dataclass(frozen=True)
class SplitRequest:
    """What is asked for in every regime."""

    name: str
    """Of the split; with several sizes ``-train30`` and so on is added."""
    train: tuple[int, ...]
    """Robots to train on. Several sizes make several splits with the same test robots; the train
    robots of a smaller one are the first of a larger one. Where robots are chosen and not drawn,
    none means all."""
    test: int
    """Robots to test on."""
    tasks: tuple[str, ...] = ("reach",)
    obstacles: bool = False
    seed: int = 0
    max_links: int = MAX_LINKS
    """The most links that a robot may have; indices of tokens are divided by one less."""

    def __post_init__(self) -> None:
        sizes = ",".join(map(str, self.train))
        if min(self.train, default=1) < 1 or self.test < 1 or self.seed < 0:
            raise BenchmarkError(
                f"--train {sizes} --test {self.test} --seed {self.seed}: "
                "--train and --test start at 1, --seed at 0"
            )
        require_max_links(0, "an order", self.max_links)
        if list(self.train) != sorted(set(self.train)):
            raise BenchmarkError(f"--train {sizes}: expected sizes that grow, such as 10,30,100")


def require_size(order: SplitRequest) -> None:
    """Require that an order says how many robots to train on.

    Raises:
        BenchmarkError: If it does not.
    """
    if not order.train:
        raise BenchmarkError("--train: say how many robots to train on, such as 10 or 10,30,100")


@dataclass(frozen=True)
class RobotStream:
    """Robots of a grammar, by number."""

    grammar: Grammar
    prefix: str
    """Of their names."""
    seed: int
    """Of ``morphgen sample``, which draws the same robots."""

    @classmethod
    def of(cls, grammar: Grammar, prefix: str, order: SplitRequest) -> RobotStream:
        """The stream of a prefix in a split."""
        return cls(grammar, prefix, stream_seed(order.seed, prefix))

    def recipe(self, number: int) -> SampledRecipe:
        """How to make a robot."""
        return SampledRecipe(self.grammar, number, self.seed, numbered_name(self.prefix, number))

    def derivation(self, number: int, library: Library) -> Derivation | None:
        """The first derivation drawn for a robot, most often its own; None if it does not end."""
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        try:
            return derive(self.grammar, library, RecordedChooser(RandomChooser(rng)))
        except TooManyPartsError:
            return None


WhyNot = Callable[[Derivation], str]
"""Why a derivation is none of a test robot; empty if it is."""
WhyNotBody = Callable[[Candidate], str]
"""The same of a body, once composed."""


class TestRobotSearch:
    """Looks for test robots, number by number."""

    def __init__(
        self,
        order: SplitRequest,
        train: Sequence[Candidate],
        maker: RobotFactory,
        progress: Progress,
    ) -> None:
        self._order, self._maker, self._progress = order, maker, progress
        self._before = len(train)
        self._taken = {body.hash: body.name for body in train}
        self._rejected: Counter[str] = Counter()
        self._composed = 0
        self.found: list[Candidate] = []

    def find(
        self,
        streams: Sequence[RobotStream],
        why_not: WhyNot,
        why_not_body: WhyNotBody = lambda body: "",
    ) -> bool:
        """Take test robots from streams in turn; return whether there are as many as ordered."""
        for number in itertools.count():
            for stream in streams:
                if len(self.found) == self._order.test:
                    return True
                if self._rejected.total() == MAX_DRAWS or self._composed == MAX_COMPOSED:
                    return False
                reason = self._try(stream, number, why_not, why_not_body)
                if reason:
                    self._rejected[reason] += 1
        return False

    def _try(
        self, stream: RobotStream, number: int, why_not: WhyNot, why_not_body: WhyNotBody
    ) -> str:
        """Take a robot, or say what it has that it shall not."""
        derivation = stream.derivation(number, self._maker.library)
        reason = why_not(derivation) if derivation else "no end"
        if reason:
            return reason
        body = self._maker(stream.recipe(number))
        # Where the first draw is not sound, the robot comes from a later one.
        reason = why_not(body.derivation) or why_not_body(body)
        if not reason and body.hash in self._taken:
            reason = f"the body of {self._taken[body.hash]}"
        if reason:
            self._composed += 1
            return reason
        self._taken[body.hash] = body.name
        self.found.append(body)
        self._progress(self._before + len(self.found))
        return ""

    def failure(self) -> str:
        """How many were tried, and what was wrong with most."""
        reason, times = self._rejected.most_common(1)[0]
        drawn = self._rejected.total() + len(self.found)
        return (
            f"{len(self.found)} of {self._order.test} test robots found in {drawn} draws; "
            f"{times} had {reason}"
        )


def assemble(
    order: SplitRequest,
    regime: Regime,
    summary: str,
    train: Sequence[Member],
    test: Sequence[Member],
    made: Mapping[str, object],
    per_robot: int = 1,
) -> tuple[Split, ...]:
    """The splits of an order, one for every size.

    Args:
        order: The order.
        regime: Of the split.
        summary: With ``{n}`` for the number of train robots.
        train: Members of the largest split.
        test: Members to test on.
        made: How they were chosen, besides what the order says.
        per_robot: Members that a robot has.
    """
    sizes = order.train or (len(train) // per_robot,)
    several = len(sizes) > 1
    links = {} if order.max_links == MAX_LINKS else {MAX_LINKS_KEY: order.max_links}
    return tuple(
        Split(
            f"{order.name}-train{n}" if several else order.name,
            regime,
            summary.format(n=n),
            tuple(train[: n * per_robot]),
            tuple(test),
            {
                "seed": order.seed,
                "train": n,
                **({"nested": list(sizes)} if several else {}),
                "test": order.test,
                **links,
                **made,
            },
        )
        for n in sizes
    )


def assemble_drawn(
    order: SplitRequest,
    regime: Regime,
    summary: str,
    train: Sequence[Candidate],
    test: Sequence[Candidate],
    made: Mapping[str, object],
) -> tuple[Split, ...]:
    """The splits of an order whose robots all do all tasks; see ``assemble``."""
    trained, tested = (members(side, order.tasks, order.obstacles) for side in (train, test))
    return assemble(order, regime, summary, trained, tested, made, per_robot=len(order.tasks))

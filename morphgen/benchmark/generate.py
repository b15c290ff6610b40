"""Shared by the generators of splits: the request, the search for test robots, the assembly."""

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
    UnfitRobotError,
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
"""Number of rejected draws after which a search fails. A draw is cheap: most are rejected by their
derivations."""
MAX_COMPOSED = 200
"""Number of rejected robots after which a search fails, of those that had to be composed."""


@dataclass(frozen=True)
class SplitRequest:
    """Request for one or several splits, of any regime."""

    name: str
    """Name of the split; with several sizes ``-train30`` and so on is appended."""
    train: tuple[int, ...]
    """Numbers of train robots, one per split. The splits share their test robots, and the train
    robots of a smaller split are the first of a larger one. If robots are chosen from a list, an
    empty tuple means all."""
    test: int
    """Number of test robots."""
    tasks: tuple[str, ...] = ("reach",)
    obstacles: bool = False
    seed: int = 0
    max_links: int = MAX_LINKS
    """Largest number of links of a robot; link indices in tokens are divided by one less."""

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


def require_size(request: SplitRequest) -> None:
    """Check that a request has a number of train robots.

    Raises:
        BenchmarkError: If it has none.
    """
    if not request.train:
        raise BenchmarkError("--train: say how many robots to train on, such as 10 or 10,30,100")


@dataclass(frozen=True)
class RobotStream:
    """The endless sequence of robots sampled from a grammar with one seed."""

    grammar: Grammar
    prefix: str
    """Prefix of the robots' names."""
    seed: int
    """Seed; ``morphgen sample --seed`` gives the same robots."""

    @classmethod
    def of(cls, grammar: Grammar, prefix: str, request: SplitRequest) -> RobotStream:
        """Return the stream of a name prefix in a split."""
        return cls(grammar, prefix, stream_seed(request.seed, prefix))

    def recipe(self, number: int) -> SampledRecipe:
        """Return the recipe of a robot."""
        return SampledRecipe(self.grammar, number, self.seed, numbered_name(self.prefix, number))

    def derivation(self, number: int, library: Library) -> Derivation | None:
        """Return the first derivation drawn for a robot; None if it has too many parts.

        The robot has this derivation unless its conditions reject it.
        """
        rng = np.random.default_rng(np.random.SeedSequence(self.seed, spawn_key=(number,)))
        try:
            return derive(self.grammar, library, RecordedChooser(RandomChooser(rng)))
        except TooManyPartsError:
            return None


RejectDerivation = Callable[[Derivation], str]
"""Returns the reason why a derivation cannot be a test robot's; empty if it can."""
RejectRobot = Callable[[Candidate], str]
"""Returns the reason why a composed robot cannot be a test robot; empty if it can."""


class TestRobotSearch:
    """Search for test robots in streams, number by number."""

    def __init__(
        self,
        request: SplitRequest,
        train: Sequence[Candidate],
        factory: RobotFactory,
        progress: Progress,
        *,
        skip_unfit: bool = False,
    ) -> None:
        """Begin with no test robots.

        Args:
            request: Number of test robots.
            train: Robots that no test robot may equal.
            factory: Makes the robots.
            progress: Receives the number of robots that are finished.
            skip_unfit: Reject robots that cannot be members of a split, instead of raising.
        """
        self._skip_unfit = skip_unfit
        self._request, self._factory, self._progress = request, factory, progress
        self._num_train = len(train)
        self._name_by_hash = {robot.hash: robot.name for robot in train}
        self._rejected: Counter[str] = Counter()
        self._num_composed = 0
        self.robots: list[Candidate] = []
        """Test robots so far."""

    def find(
        self,
        streams: Sequence[RobotStream],
        reject_derivation: RejectDerivation,
        reject_robot: RejectRobot = lambda robot: "",
    ) -> bool:
        """Take test robots from the streams in turn; return True when the request is met."""
        for number in itertools.count():
            for stream in streams:
                if len(self.robots) == self._request.test:
                    return True
                if self._rejected.total() == MAX_DRAWS or self._num_composed == MAX_COMPOSED:
                    return False
                reason = self._try(stream, number, reject_derivation, reject_robot)
                if reason:
                    self._rejected[reason] += 1
        return False

    def _try(
        self,
        stream: RobotStream,
        number: int,
        reject_derivation: RejectDerivation,
        reject_robot: RejectRobot,
    ) -> str:
        """Take a robot and return an empty text, or return the reason why it is rejected."""
        derivation = stream.derivation(number, self._factory.library)
        reason = reject_derivation(derivation) if derivation else "no end"
        if reason:
            return reason
        try:
            robot = self._factory(stream.recipe(number))
        except UnfitRobotError as error:
            if not self._skip_unfit:
                raise
            self._num_composed += 1
            return error.reason
        # The robot comes from a later draw if the conditions of the grammar reject the first one.
        reason = reject_derivation(robot.derivation)
        if not reason and robot.hash in self._name_by_hash:
            reason = f"the body of {self._name_by_hash[robot.hash]}"
        if reason := reason or reject_robot(robot):
            self._num_composed += 1
            return reason
        self._name_by_hash[robot.hash] = robot.name
        self.robots.append(robot)
        self._progress(self._num_train + len(self.robots))
        return ""

    def failure(self) -> str:
        """Return how many robots were drawn and found, and the most common reason of rejection."""
        reason, count = self._rejected.most_common(1)[0]
        drawn = self._rejected.total() + len(self.robots)
        return (
            f"{len(self.robots)} of {self._request.test} test robots found in {drawn} draws; "
            f"{count} had {reason}"
        )


def assemble(
    request: SplitRequest,
    regime: Regime,
    summary: str,
    train: Sequence[Member],
    test: Sequence[Member],
    provenance: Mapping[str, object],
    per_robot: int = 1,
) -> tuple[Split, ...]:
    """Return the requested splits, one for each size.

    Args:
        request: The request.
        regime: Regime of the splits.
        summary: Summary with ``{n}`` for the number of train robots.
        train: Train members of the largest split.
        test: Test members.
        provenance: Arguments of the generator besides the request.
        per_robot: Number of members of each robot.
    """
    sizes = request.train or (len(train) // per_robot,)
    nested = {"nested": list(sizes)} if len(sizes) > 1 else {}
    links = {} if request.max_links == MAX_LINKS else {MAX_LINKS_KEY: request.max_links}
    return tuple(
        Split(
            f"{request.name}-train{n}" if nested else request.name,
            regime,
            summary.format(n=n),
            tuple(train[: n * per_robot]),
            tuple(test),
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


def assemble_drawn(
    request: SplitRequest,
    regime: Regime,
    summary: str,
    train: Sequence[Candidate],
    test: Sequence[Candidate],
    provenance: Mapping[str, object],
) -> tuple[Split, ...]:
    """Return the requested splits with a member for each robot and task; see ``assemble``."""
    train_members, test_members = (
        members(side, request.tasks, request.obstacles) for side in (train, test)
    )
    return assemble(
        request,
        regime,
        summary,
        train_members,
        test_members,
        provenance,
        per_robot=len(request.tasks),
    )

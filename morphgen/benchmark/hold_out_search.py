"""Search for the robots of a split with held-out parts, by composing those that are drawn."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

from morphgen.benchmark.generate import MAX_COMPOSED, SplitRequest
from morphgen.benchmark.hold_out_pool import Draft, DraftMaker
from morphgen.benchmark.near_duplicates import is_near
from morphgen.benchmark.robot_factory import Candidate, Progress, RobotFactory, UnfitRobotError
from morphgen.benchmark.stratified import TestBalance, TrainBalance, stratified
from morphgen.errors import BenchmarkError
from morphgen.processes import parallel_map

MAX_REJECTED = 500
"""Number of rejected robots after which the search fails."""


@dataclass(frozen=True)
class _Unfit:
    """A draft whose robot cannot be a member."""

    reason: str


@dataclass(frozen=True)
class ComposeDraft:
    """Compose drafts; can be pickled and sent to a worker process."""

    factory: RobotFactory

    def __call__(self, draft: Draft) -> Candidate | _Unfit:
        """Return the composed robot, or why it cannot be a member."""
        try:
            return self.factory(draft.recipe)
        except UnfitRobotError as error:
            return _Unfit(error.reason)


@dataclass
class HoldOutSearch:
    """Choose robots, compose them, reject those that do not do, and choose again."""

    request: SplitRequest
    maker: DraftMaker
    compose: ComposeDraft
    pool: dict[int, Draft]
    robots: dict[int, Candidate] = field(default_factory=dict)
    """Composed robots by their number in the pool."""
    rejected: dict[int, str] = field(default_factory=dict)
    """Reason by number of the robot."""
    _compared: dict[tuple[int, int], bool] = field(default_factory=dict)

    def run(self, jobs: int, progress: Progress) -> tuple[list[Candidate], list[Candidate]]:
        """Return the test and the train robots.

        Raises:
            BenchmarkError: If there are too few.
        """
        while True:
            test, train = self._choose()
            unknown = [number for number in (*test, *train) if number not in self.robots]
            self._require_enough(test, train, unknown)
            self._compose(unknown, len(test) + len(train), jobs, progress)
            num_rejected = len(self.rejected)
            self._reject_repeated([*test, *train])
            self._reject_near(test, train)
            if not unknown and len(self.rejected) == num_rejected:
                self._require_all_rules(test)
                self._require_covered(test, train)
                return [self.robots[i] for i in test], [self.robots[i] for i in train]

    def _compose(
        self, unknown: Sequence[int], num_chosen: int, jobs: int, progress: Progress
    ) -> None:
        """Compose robots, or reject them."""
        num_known = num_chosen - len(unknown)

        def report(done: int, total: int) -> None:
            progress(num_known + done)

        drafts = [self.pool[number] for number in unknown]
        results = parallel_map(self.compose, drafts, jobs, report)
        for number, result in zip(unknown, results, strict=True):
            if isinstance(result, _Unfit):
                self.rejected[number] = result.reason
                continue
            self.robots[number] = result
            # The conditions of a grammar may have replaced the derivation that was drawn.
            self.pool[number] = self.maker.composed(self.pool[number], result)

    def _choose(self) -> tuple[list[int], list[int]]:
        """Return the numbers of the best test and train robots that are not rejected."""
        drafts = {n: draft for n, draft in self.pool.items() if n not in self.rejected}
        trainable = {n: draft for n, draft in drafts.items() if not draft.rules}
        train_parts = frozenset[str]().union(*(draft.parts for draft in trainable.values()))
        testable = {
            n: draft for n, draft in drafts.items() if draft.rules and draft.required <= train_parts
        }
        test = stratified(testable, self.request.test, TestBalance())
        needed = frozenset[str]().union(*(drafts[n].required for n in test))
        train = stratified(trainable, max(self.request.train), TrainBalance(needed))
        return test, train

    def _require_enough(
        self, test: Sequence[int], train: Sequence[int], unknown: Sequence[int]
    ) -> None:
        """Raise if the robots are too few, once it is known how many differ."""
        if len(self.rejected) > MAX_REJECTED:
            raise BenchmarkError(
                f"{MAX_REJECTED} robots were rejected before enough were found{self._reasons()}"
            )
        # Composing shows which robots are the same; for many robots that takes too long.
        is_final = not unknown or len(unknown) > MAX_COMPOSED
        rules = " or ".join(map(str, self.maker.rules))
        for option, numbers, wanted, what in (
            ("--train", train, max(self.request.train), f"without {rules}"),
            ("--test", test, self.request.test, f"with {rules}"),
        ):
            if len(numbers) < wanted and (is_final or not numbers):
                count = f"{'at most' if unknown else 'only'} {len(numbers)}" if numbers else "no"
                what += ", whose other parts can be trained," if option == "--test" else ""
                raise BenchmarkError(
                    f"{option} {wanted}: {count} different robots {what} exist{self._reasons()}; "
                    "ask for fewer, or name more robots with --from or --grammar"
                )

    def _require_all_rules(self, test: Sequence[int]) -> None:
        """Raise if a rule holds for no test robot."""
        for number, rule in enumerate(self.maker.rules):
            if not any(number in self.pool[n].rules for n in test):
                raise BenchmarkError(
                    f"--hold-out {rule}: no robots with it, whose other parts can be trained, "
                    f"exist{self._reasons()}; name more robots with --from or --grammar"
                )

    def _require_covered(self, test: Sequence[int], train: Sequence[int]) -> None:
        """Raise if the smallest split does not train all other parts of its test robots."""
        smallest = self.request.train[0]
        required = frozenset[str]().union(*(self.pool[n].required for n in test))
        trained = [self.pool[n].parts for n in train]
        missing = required.difference(*trained[:smallest])
        if not missing:
            return
        sizes = range(smallest + 1, len(train) + 1)
        enough = next((size for size in sizes if not required.difference(*trained[:size])), None)
        raise BenchmarkError(
            f"--train {smallest}: no train robot has {', '.join(sorted(missing))}, which test "
            "robots have and --hold-out does not name; ask for "
            f"{f'{enough} or more' if enough else 'more'} train robots, or for fewer test robots"
        )

    def _reasons(self) -> str:
        """Return why robots were rejected, the most common reasons first."""
        counts = Counter(self.rejected.values()).most_common(2)
        reasons = ", ".join(f"{count} with {reason}" for reason, count in counts)
        links = f"more than {self.request.max_links} links"
        hint = "; see --max-links" if any(reason == links for reason, _ in counts) else ""
        return f" ({len(self.rejected)} rejected: {reasons}{hint})" if counts else ""

    def _reject_repeated(self, chosen: Sequence[int]) -> None:
        """Reject robots that are physically the same as an earlier one."""
        first: dict[str, int] = {}
        for number in chosen:
            if number in self.robots and number not in self.rejected:
                earlier = first.setdefault(self.robots[number].hash, number)
                if earlier != number:
                    self.rejected[number] = "the same hash as another robot"

    def _reject_near(self, test: Sequence[int], train: Sequence[int]) -> None:
        """Reject train robots that the audit would call nearly the same as a test robot."""
        for pair in product(test, train):
            if pair not in self._compared and all(n in self.robots for n in pair):
                self._compared[pair] = self._is_near(*pair)
            if self._compared.get(pair) and not self.rejected.keys() & set(pair):
                self.rejected[pair[1]] = "almost the sizes of a test robot"

    def _is_near(self, a: int, b: int) -> bool:
        x, y = self.robots[a].features, self.robots[b].features
        assert x is not None
        assert y is not None
        return is_near(x, y)

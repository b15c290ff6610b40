"""Generate composition splits: test robots combine trained parts in untrained combinations."""

from __future__ import annotations

import itertools
from collections import Counter, defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from morphgen.benchmark.generate import SplitRequest, assemble
from morphgen.benchmark.near_duplicates import NearReason
from morphgen.benchmark.part_patterns import NOTHING, pattern_robots
from morphgen.benchmark.regimes import combination, parts
from morphgen.benchmark.robot_factory import (
    Candidate,
    ComposedRecipe,
    Progress,
    RobotFactory,
    make_robots,
)
from morphgen.benchmark.split import Member, Split
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library

NUM_ATTEMPTS = 50
"""Number of random orders in which candidates are held out before the search fails."""


def composition(
    request: SplitRequest,
    patterns: Sequence[str],
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = lambda done: None,
) -> tuple[Split, ...]:
    """Return splits whose test robots have only trained parts, in an untrained combination.

    With several tasks, a candidate is a robot with one task, and the split composes robots with
    tasks: the outermost part of a test robot is in no train robot of its task, but in others.

    Args:
        request: Sizes, tasks and seed. Without a size, all remaining candidates are train robots.
        patterns: Patterns of the candidates, see ``pattern_robots``.
        library: The library of parts.
        jobs: Number of processes.
        progress: Receives the number of robots that are finished.

    Returns:
        A split for each size.

    Raises:
        BenchmarkError: If the candidates allow no such split; the message gives the reason.
        MorphgenError: If a pattern names an unknown part, or parts do not fit.
    """
    candidates = list(_candidates(patterns, request.tasks, library))
    sequence = np.random.SeedSequence(request.seed)
    test, train = hold_out(candidates, request.test, max(request.train, default=1), sequence)
    shortest = num_covering(train, test)
    if request.train and request.train[0] < shortest:
        names = ", ".join(candidate.name for candidate in train[:shortest])
        raise BenchmarkError(
            f"--train {request.train[0]}: {shortest} robots at least are needed so that every part "
            f"of the test robots is trained, such as {names}"
        )
    members = [*train[: request.train[-1] if request.train else None], *test]
    unique = {
        candidate.text: ComposedRecipe(candidate.words, candidate.name) for candidate in members
    }
    factory = RobotFactory(library.folders, with_features=True, max_links=request.max_links)
    composed_robots = make_robots(list(unique.values()), factory, jobs=jobs, progress=progress)
    robot_of = dict(zip(unique, composed_robots, strict=True))
    _require_no_near(members[-len(test) :], members[: -len(test)], robot_of)
    robots = []
    for candidate in members:
        robot = robot_of[candidate.text]
        name = f"{candidate.name}-{candidate.task}" if len(request.tasks) > 1 else candidate.name
        task = (candidate.task, request.obstacles)
        robots.append(Member(name, robot.category, str(robot.derivation), *task, robot.hash))
    kinds = len({candidate.combination for candidate in candidates})
    return assemble(
        request,
        "composition",
        f"{{n}} robots out of {kinds} combinations; test: {request.test} of combinations unseen",
        robots[: -len(test)],
        robots[-len(test) :],
        {"from": list(patterns), "tasks": list(request.tasks)},
    )


def _require_no_near(
    test: Sequence[HoldOutCandidate],
    train: Sequence[HoldOutCandidate],
    robot_of: Mapping[str, Candidate],
) -> None:
    """Require that no test robot is nearly a train robot of its task, as the audit does.

    Raises:
        BenchmarkError: If one is.
    """
    for each in test:
        others = [robot_of[other.text] for other in train if other.task == each.task]
        if reason := NearReason(others)(robot_of[each.text]):
            raise BenchmarkError(
                f"test robot {each.name}: has {reason}, a train robot; leave one of them out of "
                "--from, or name another --seed"
            )


def _candidates(
    patterns: Sequence[str], tasks: Sequence[str], library: Library
) -> Iterator[HoldOutCandidate]:
    """Yield every robot of the patterns once for each task."""
    name_by_derivation: dict[str, str] = {}
    for robot in itertools.chain.from_iterable(pattern_robots(p, library) for p in patterns):
        derivation, name = robot.derivation, robot.name
        if str(derivation) in name_by_derivation:
            continue
        if name in name_by_derivation.values():
            name = f"{name}-{derivation.digest[:8]}"
        name_by_derivation[str(derivation)] = name
        *_, last = (node.part for node in derivation.walk() if node.part != NOTHING)
        properties = (str(derivation), combination(derivation), parts(derivation), last)
        for task in tasks:
            yield HoldOutCandidate(name, robot.words, *properties, task)


@dataclass(frozen=True)
class HoldOutCandidate:
    """A robot with a task, which may become a train or a test member."""

    name: str
    words: tuple[str, ...]
    """Arguments of ``morphgen compose``."""
    text: str
    """Derivation of the robot."""
    combination: str
    """Parts and ports, see ``regimes.combination``."""
    parts: frozenset[str]
    outermost: str
    """Last part of the robot, usually the end-effector."""
    task: str

    @property
    def covers(self) -> set[str]:
        """The parts and the task that training with this robot covers."""
        return {*self.parts, f"task {self.task}"}


def hold_out(
    candidates: Sequence[HoldOutCandidate], n: int, min_train: int, seed: np.random.SeedSequence
) -> tuple[list[HoldOutCandidate], list[HoldOutCandidate]]:
    """Choose test candidates, of as many different combinations as possible.

    Candidates with the combination of a test candidate are excluded from training, for all tasks.
    With several tasks, candidates with the outermost part and the task of a test candidate are
    excluded, too. The remaining candidates cover every part and task of the test candidates.

    Args:
        candidates: The candidates.
        n: Number of test candidates.
        min_train: Smallest number of candidates that remain for training.
        seed: Seed of the random orders in which candidates are tried.

    Returns:
        Test candidates, and train candidates in an order such that the first few cover each part
        and task of the test candidates.

    Raises:
        BenchmarkError: If too few candidates can be held out; the message gives the reason.
    """
    rng = np.random.default_rng(seed)
    max_held = 0
    for _ in range(NUM_ATTEMPTS):
        pool = _TrainPool(candidates)
        order = [int(i) for i in rng.permutation(len(candidates))]
        for fresh in (True, False):
            for i in order:
                if len(pool.held) < n and pool.is_fresh(i) == fresh:
                    pool.hold(i, min_train)
        if len(pool.held) == n:
            test = [candidates[i] for i in pool.held]
            train = [candidates[i] for i in order if i in pool.remaining]
            return test, _covering_first(train, pool.needed)
        max_held = max(max_held, len(pool.held))
    raise BenchmarkError(_why_not(candidates, n, min_train, max_held))


def num_covering(candidates: Sequence[HoldOutCandidate], test: Sequence[HoldOutCandidate]) -> int:
    """Return how many of the first candidates cover each part and task of the test ones."""
    needed = {item for candidate in test for item in candidate.covers}
    n = 0
    while needed:
        needed -= candidates[n].covers
        n += 1
    return n


class _TrainPool:
    """The candidates that remain for training while others are held out, by their index."""

    def __init__(self, candidates: Sequence[HoldOutCandidate]) -> None:
        self._candidates = candidates
        self._mixed = len({candidate.task for candidate in candidates}) > 1
        self._same_combination: dict[str, list[int]] = defaultdict(list)
        self._pairs: dict[tuple[str, str], list[int]] = defaultdict(list)
        for i, candidate in enumerate(candidates):
            self._same_combination[candidate.combination].append(i)
            for part in candidate.parts:
                self._pairs[part, candidate.task].append(i)
        self.remaining = set(range(len(candidates)))
        self._covered = Counter(item for candidate in candidates for item in candidate.covers)
        self.held: list[int] = []
        self.needed: set[str] = set()
        """Parts and tasks of the candidates that are held out."""

    def is_fresh(self, i: int) -> bool:
        """Test that no candidate of the same combination is held out."""
        return all(
            self._candidates[i].combination != self._candidates[j].combination for j in self.held
        )

    def hold(self, i: int, min_train: int) -> None:
        """Hold a candidate out, if the rest still covers all that is needed and is large enough."""
        candidate = self._candidates[i]
        excluded = set(self._same_combination[candidate.combination])
        if self._mixed:
            excluded.update(self._pairs[candidate.outermost, candidate.task])
        excluded &= self.remaining
        lost = Counter(item for j in excluded for item in self._candidates[j].covers)
        needed = self.needed | candidate.covers
        is_covered = all(self._covered[item] > lost[item] for item in needed)
        if i in self.held or not is_covered or len(self.remaining) - len(excluded) < min_train:
            return
        self.held.append(i)
        self.needed = needed
        self.remaining -= excluded
        self._covered -= lost


def _covering_first(
    candidates: Sequence[HoldOutCandidate], needed: set[str]
) -> list[HoldOutCandidate]:
    """Move candidates that cover all that is needed to the front (greedy set cover)."""
    first: list[HoldOutCandidate] = []
    rest = list(candidates)
    missing = set(needed)
    while missing:
        best = max(rest, key=lambda candidate: len(missing & candidate.covers))
        missing -= best.covers
        rest.remove(best)
        first.append(best)
    return first + rest


def _why_not(candidates: Sequence[HoldOutCandidate], n: int, min_train: int, max_held: int) -> str:
    combinations = {candidate.combination: candidate.parts for candidate in candidates}
    counts = Counter(part for parts in combinations.values() for part in parts)
    alone = sorted(part for part, times in counts.items() if times == 1)
    text = (
        f"{max_held} of {n} test robots can be held out of {len(combinations)} combinations such "
        "that their parts are trained in others"
    )
    if len({candidate.task for candidate in candidates}) > 1:
        text += ", the outermost at another task only,"
    text += f" and at least {min_train} are left to train on"
    if alone:
        text += f"; in one combination only: {', '.join(alone)}"
    return f"{text}; give --from more choices, or ask for fewer robots"

"""Splits by composition: test robots join parts that are trained, but not together.

What is held out is chosen at random, so that train robots have each part of the test robots.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from morphgen.benchmark.regimes import (
    RuledRobot,
    SplitRequest,
    assemble,
    near_reason,
    pattern_robots,
)
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.processes import parallel_map
from morphgen.splits.split import DerivedRecipe, RobotFactory, Split

NUM_ATTEMPTS = 50
"""Number of random orders in which candidates are held out before the search fails."""


def composition(
    request: SplitRequest, patterns: Sequence[str], library: Library, *, jobs: int = 1
) -> tuple[Split, ...]:
    """Return splits whose test robots have only trained parts, in an untrained combination.

    With several tasks, it is one with the task, for the outermost part of a test robot.
    """
    candidates = list(_candidates(patterns, request.tasks, library))
    sequence = np.random.SeedSequence(request.seed)
    test, train = hold_out_combinations(candidates, request.test, request.train[-1], sequence)
    shortest = num_covering(train, test)
    if request.train[0] < shortest:
        names = ", ".join(candidate.name for candidate in train[:shortest])
        raise BenchmarkError(
            f"--train {request.train[0]}: {shortest} robots at least are needed so that every part "
            f"of the test robots is trained, such as {names}"
        )
    train = train[: request.train[-1]]
    recipes = {
        each.name: DerivedRecipe(each.derivation, each.name, each.category)
        for each in (*train, *test)
    }
    factory = RobotFactory(library, with_features=True, max_links=request.max_links)
    robot_of = dict(zip(recipes, parallel_map(factory, list(recipes.values()), jobs), strict=True))
    for each in test:  # as the audit does
        others = [robot_of[other.name] for other in train if other.task == each.task]
        if reason := near_reason(robot_of[each.name], others):
            raise BenchmarkError(
                f"test robot {each.name}: has {reason}, a train robot; leave one of them out of "
                "--from, or name another --seed"
            )
    first, second = (
        [[robot_of[each.name].member(each.task, request.tasks, request.obstacles)] for each in side]
        for side in (train, test)
    )
    kinds = len({candidate.combination for candidate in candidates})
    return assemble(
        request,
        "composition",
        f"{{n}} robots out of {kinds} combinations; test: {request.test} of combinations unseen",
        first,
        second,
        {"from": list(patterns), "tasks": list(request.tasks)},
    )


def _candidates(
    patterns: Sequence[str], tasks: Sequence[str], library: Library
) -> Iterator[RuledRobot]:
    """Yield every robot of the patterns once for each task."""
    name_by_derivation: dict[str, str] = {}
    for robot in itertools.chain.from_iterable(pattern_robots(p, library) for p in patterns):
        derivation, name = robot.derivation, robot.name
        if str(derivation) in name_by_derivation:
            continue
        if name in name_by_derivation.values():
            name = f"{name}-{derivation.digest[:8]}"
        name_by_derivation[str(derivation)] = name
        for task in tasks:
            yield RuledRobot(name, robot.category, task, derivation, library)


def hold_out_combinations(
    candidates: Sequence[RuledRobot], n: int, min_train: int, seed: np.random.SeedSequence
) -> tuple[list[RuledRobot], list[RuledRobot]]:
    """Choose test candidates of as many combinations as possible; return them and train candidates.

    Candidates with a test candidate's combination, or its outermost part and task, are not trained.
    The first few train candidates cover every part and task of the test candidates.
    """
    rng = np.random.default_rng(seed)
    max_held = 0  # most test candidates of an attempt, for the message
    for _ in range(NUM_ATTEMPTS):
        order = [candidates[i] for i in rng.permutation(len(candidates))]
        test, train = _hold_out_in_order(order, n, min_train)
        if len(test) == n:
            return test, _covering_first(train, {item for each in test for item in each.covers})
        max_held = max(max_held, len(test))
    raise BenchmarkError(_why_not(candidates, n, min_train, max_held))


def _hold_out_in_order(
    order: Sequence[RuledRobot], n: int, min_train: int
) -> tuple[list[RuledRobot], list[RuledRobot]]:
    """Hold out each candidate in turn whose parts the rest still covers, new combinations first."""
    is_mixed = len({candidate.task for candidate in order}) > 1
    test: list[RuledRobot] = []
    train = list(order)
    needed: set[str] = set()
    for fresh in (True, False):
        for each in order:
            is_fresh = each.combination not in {held.combination for held in test}
            if len(test) == n or is_fresh != fresh or each in test:
                continue
            rest = [
                other
                for other in train
                if other.combination != each.combination
                and not (is_mixed and each.task == other.task and each.outermost in other.parts)
            ]
            covered = {item for other in rest for item in other.covers}
            if len(rest) >= min_train and needed | each.covers <= covered:
                test.append(each)
                train, needed = rest, needed | each.covers
    return test, train


def num_covering(candidates: Sequence[RuledRobot], test: Sequence[RuledRobot]) -> int:
    """Return how many of the first candidates cover each part and task of the test ones."""
    needed = {item for candidate in test for item in candidate.covers}
    n = 0
    while needed:
        needed -= candidates[n].covers
        n += 1
    return n


def _covering_first(candidates: Sequence[RuledRobot], needed: set[str]) -> list[RuledRobot]:
    """Move candidates that cover all that is needed to the front (greedy set cover)."""
    first: list[RuledRobot] = []
    rest = list(candidates)
    missing = set(needed)
    while missing:
        best = max(rest, key=lambda candidate: len(missing & candidate.covers))
        missing -= best.covers
        rest.remove(best)
        first.append(best)
    return first + rest


def _why_not(candidates: Sequence[RuledRobot], n: int, min_train: int, max_held: int) -> str:
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

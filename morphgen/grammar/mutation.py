"""Neighbours of a robot in its grammar: one choice made anew."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from morphgen.errors import GrammarError
from morphgen.grammar.choosers import Choices, Random, Recorded
from morphgen.grammar.conditions import clauses
from morphgen.grammar.derive import EndlessError, derive
from morphgen.grammar.library import Library
from morphgen.grammar.model import Grammar
from morphgen.grammar.sampling import MAX_ATTEMPTS, TOO_LARGE, Sample, SamplingError, build


def mutate(
    grammar: Grammar, library: Library, choices: Choices, n: int, *, seed: int = 0, name: str
) -> Iterator[Sample]:
    """Neighbours of the robot that some choices make: each has one of them made anew.

    What the new choice opens (the parameters of another part) is drawn; all else stays.

    Args:
        grammar: The grammar.
        library: Where its parts are.
        choices: What was drawn for the robot.
        n: How many neighbours.
        seed: Neighbour i does not depend on n.
        name: Name of the robot; neighbours are called ``<name>-m0000`` and so on.

    Raises:
        GrammarError: If the robot left nothing to choose.
        SamplingError: If no other sound neighbour is found in ``MAX_ATTEMPTS`` draws.
    """
    origin = derive(grammar, library, Recorded(Random(np.random.default_rng(seed)), choices))
    if not choices:
        raise GrammarError(f"grammar {grammar.name!r} leaves nothing to choose: no neighbours")
    conditions = [clause for whole in grammar.wheres for clause in clauses(whole)]
    keys = sorted(choices)
    for index in range(n):
        rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(index,)))
        rejected: dict[str, int] = {}
        for _ in range(MAX_ATTEMPTS):
            recorded = Recorded(Random(rng), _without(choices, keys[rng.integers(len(keys))]))
            reason = "nothing changed"
            try:
                derivation = derive(grammar, library, recorded)
            except EndlessError:
                derivation, reason = origin, TOO_LARGE
            if derivation != origin:
                found = build(
                    derivation, library, conditions, f"{name}-m{index:04d}", recorded.made
                )
                if not isinstance(found, str):
                    yield Sample(index, *found, derivation, recorded.made, rejected)
                    break
                reason = found
            rejected[reason] = rejected.get(reason, 0) + 1
        else:
            raise SamplingError(
                f"no neighbour of {name!r} in {MAX_ATTEMPTS} draws: "
                + ", ".join(f"{times} x {reason}" for reason, times in sorted(rejected.items()))
            )


def _without(choices: Choices, key: str) -> Mapping[str, float]:
    return {other: value for other, value in choices.items() if other != key}

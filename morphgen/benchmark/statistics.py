"""A split in numbers: how large and movable its robots are, and how alike test and train."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from morphgen.benchmark.split import Member, Split
from morphgen.benchmark.survey import Facts, Fault, Survey, Surveyed, survey
from morphgen.errors import BenchmarkError
from morphgen.grammar.library import Library
from morphgen.processes import Progress, unseen

DIGITS = 4
"""Decimals of the figures."""
COUNTED = ("links", "movable", "movable_to_tool")
MEASURED = ("mass", "reach")
COSINE = "cosine"


def statistics(
    split: Split,
    library: Library,
    *,
    jobs: int = 1,
    progress: Progress = unseen,
) -> dict[str, object]:
    """Figures of a split, as its file holds them.

    Args:
        split: The split.
        library: Where its parts are.
        jobs: Processes.
        progress: As ``survey`` tells it.

    Returns:
        Plain data, see ``summed_up``.

    Raises:
        BenchmarkError: If a robot cannot be composed, or a side is empty.
    """
    return summed_up(survey(split, library, jobs=jobs, progress=progress))


def summed_up(found: Survey) -> dict[str, object]:
    """Figures of a split that was surveyed.

    Returns:
        For ``train`` and ``test``: the number of ``robots`` and of different ``bodies``, mean
        ``links``, ``movable`` joints and those on the way from the root to the tool
        (``movable_to_tool``); mean, least and largest ``mass`` (kg) and ``reach`` (m). Mimic joints
        are movable; a body that has two tasks counts twice. ``cosine``: mean, least and largest
        cosine similarity over all pairs of a test and a train robot.

    Raises:
        BenchmarkError: If a robot could not be composed, or a side is empty.
    """
    split = found.split
    return {
        "train": _side(split, split.train, found.train),
        "test": _side(split, split.test, found.test),
        COSINE: mean_and_range(found.of(COSINE).ravel().tolist()),
    }


def mean_and_range(values: Sequence[float]) -> dict[str, float]:
    """Mean, least and largest of values."""
    numbers = {"mean": float(np.mean(values)), "min": min(values), "max": max(values)}
    return {key: round(value, DIGITS) for key, value in numbers.items()}


def _side(
    split: Split, members: Sequence[Member], found: Iterable[Surveyed | Fault]
) -> dict[str, object]:
    if not members:
        raise BenchmarkError(f"split {split.name!r} has a side without robots")
    robots = []
    for member, robot in zip(members, found, strict=True):
        if isinstance(robot, Fault):
            raise BenchmarkError(f"split {split.name!r}: robot {member.name!r}: {robot.why}")
        robots.append(robot)
    facts = [robot.facts for robot in robots]
    return {
        "robots": len(robots),
        "bodies": len({robot.body for robot in robots}),
        **{key: round(float(np.mean(_column(facts, key))), DIGITS) for key in COUNTED},
        **{key: mean_and_range(_column(facts, key)) for key in MEASURED},
    }


def _column(facts: Sequence[Facts], key: str) -> list[float]:
    return [float(getattr(fact, key)) for fact in facts]

"""Scores of robots in an evaluation, and how files hold them."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from morphgen.benchmark.split import Side


@dataclass(frozen=True)
class Score:
    """Result of one robot in an evaluation."""

    robot: str
    """Name of the robot."""
    side: Side
    """Side of the split."""
    task: str
    """Task of the robot."""
    episodes: int
    """Number of episodes."""
    steps: int
    """Control steps of all episodes together."""
    score: float
    """``raw``, for some tasks minus that of the random policy; see ``Task.relative_to_random``."""
    low: float
    """Lower end of the score's 95% bootstrap interval over episodes; nan if there is only one."""
    high: float
    """Upper end of that interval."""
    raw: float
    """Mean score of the episodes; see ``Task.episode_score``."""
    random: float
    """``raw`` of the random policy."""
    success: float
    """Share of the episodes that end in success."""
    random_success: float
    """``success`` of the random policy."""
    distance: float
    """Mean distance from success at the end of an episode [m]."""
    relative_distance: float
    """``distance`` divided by the robot's reach; nan for tasks where it means nothing."""
    unstable: int = 0
    """Number of episodes that ended because the simulation diverged."""


def scores_to_json(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Return scores for JSON, with None instead of nan."""
    return [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(each).items()}
        for each in scores
    ]


def score_from_json(data: Mapping[str, Any]) -> Score:
    """Return the score of an entry of ``scores_to_json``.

    Raises:
        TypeError: If an entry is missing or unknown.
    """
    values: dict[str, Any] = {k: math.nan if v is None else v for k, v in data.items()}
    return Score(**values)

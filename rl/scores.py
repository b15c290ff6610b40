"""Scores of robots in an evaluation, and their JSON form."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from morphgen.benchmark.split import Side
from morphgen.rl.intervals import Interval, success_interval

_TEXTS = ("robot", "side", "task")
"""Fields of a score that are no numbers."""
_SUCCESS_ENDS = ("success_low", "success_high")
"""Ends of the 95% Wilson interval of ``success``, which follow from the fields of a score."""


@dataclass(frozen=True)
class Score:
    """Result of one robot in an evaluation."""

    robot: str
    """Name of the robot."""
    side: Side
    """Side of the split that the robot is on."""
    task: str
    """Task of the robot."""
    episodes: int
    """Number of episodes."""
    steps: int
    """Total length of the episodes [control steps]."""
    score: float
    """``raw``, or ``raw - random`` for tasks with ``Task.relative_to_random``."""
    low: float
    """Lower end of the 95% interval of ``score`` over episodes; see ``episode_interval``."""
    high: float
    """Upper end of the interval; nan like ``low`` if the episodes cannot tell it."""
    raw: float
    """Mean score of the episodes; see ``Task.episode_score``."""
    random: float
    """Mean score of the random policy's episodes."""
    success: float
    """Success rate of the episodes, 0 to 1."""
    random_success: float
    """Success rate of the random policy's episodes, 0 to 1."""
    distance: float
    """Mean distance from success at the end of an episode [m]."""
    relative_distance: float
    """``distance`` divided by the robot's reach; nan for tasks without ``relative_distance``."""
    unstable: int = 0
    """Number of episodes that ended because the simulation diverged."""
    angle: float = math.nan
    """Mean angle from success at the end of an episode [rad]; nan without orientation."""


SCORE_KEYS = (*(field.name for field in fields(Score)), *_SUCCESS_ENDS)
"""Keys of a score in JSON, and columns of CSV."""


def success_of(scores: Sequence[Score]) -> Interval:
    """Return the mean success rate of robots, or of robots and seeds, with its Wilson interval."""
    return success_interval([each.success for each in scores], [each.episodes for each in scores])


def scores_to_json(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Return scores as JSON values, with null instead of nan, and the interval of the success."""
    table = []
    for score in scores:
        success = success_of([score])
        ends = dict(zip(_SUCCESS_ENDS, (success.low, success.high), strict=True))
        table.append(finite_or_none(asdict(score) | ends))
    return table


def finite_or_none(value: Any) -> Any:  # noqa: ANN401
    """Return nested dictionaries and sequences for JSON, with None for numbers not finite."""
    if isinstance(value, Mapping):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def score_decimals(scores: Iterable[float]) -> int:
    """Return the number of decimals with which scores of a task are shown, at least three digits.

    Args:
        scores: All scores of a column; those of push are from 0 to 1, those of reach up to 300.
    """
    return 1 if any(abs(score) >= 10 for score in scores) else 2


def score_from_json(data: Mapping[str, Any]) -> Score:
    """Return the score that ``scores_to_json`` made a dictionary of.

    Raises:
        TypeError: If a field is missing or unknown.
        ValueError: If a field is of another type, or score or success is not finite.
    """
    values: dict[str, Any] = {
        key: math.nan if value is None else value
        for key, value in data.items()
        if key not in _SUCCESS_ENDS
    }
    score = Score(**values)
    where = f"{score.side} robot {score.robot}"
    for field in fields(Score):
        value = getattr(score, field.name)
        is_number = isinstance(value, int | float) and not isinstance(value, bool)
        if is_number is (field.name in _TEXTS):
            expected = "text" if field.name in _TEXTS else "a number"
            raise ValueError(f"{where}: {field.name} {value!r}; expected {expected}")
        if field.name in ("score", "success") and not math.isfinite(value):
            raise ValueError(f"{where}: {field.name} {value!r}; expected a finite number")
    return score

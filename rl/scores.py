"""Scores of robots in an evaluation, and their JSON form."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from os import PathLike
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import scipy  # loads its packages at their first use, which take seconds
from msgspec import Meta
from numpy.typing import ArrayLike, NDArray

from morphgen.errors import BenchmarkError, TaskError, nearest, path_argument
from morphgen.formats.files import require_writable_file, write_file
from morphgen.formats.records import FiniteNumber, Record
from morphgen.splits.split import Side
from morphgen.tables import table
from morphgen.tasks.registry import TASKS
from morphgen.typing import Array

LEVEL = 0.95  # confidence level of the intervals
RESAMPLES = 2000
MAX_RESAMPLED = 2**26  # largest number of values that are resampled at once: 512 MB
_MAX_DIGITS = 6
"""Largest number of decimals of a rate's ends, which have as many as tell them apart."""


@dataclass(frozen=True)
class Interval:
    """An average or a rate with its interval.

    The ends are nan if the samples cannot tell them: there is one, or all resamples have one mean.
    """

    value: float
    low: float
    high: float

    def ends(self, form: str) -> str:
        """Return the ends as text, such as ``0.64 to 0.95``; nothing if they are not known."""
        return "" if math.isnan(self.low) else f"{self.low:{form}} to {self.high:{form}}"

    def as_text(self, form: str) -> str:
        """Return the value and the ends that are known, such as ``0.85 (0.64 to 0.95)``."""
        ends = self.ends(form)
        return f"{self.value:{form}} ({ends})" if ends else f"{self.value:{form}}"

    def as_percent(self) -> str:
        """Return a rate as text, such as ``85% (64% to 95%)``."""
        ends = (self.low, self.high)
        texts = [[f"{end:.{digits}%}" for end in ends] for digits in range(_MAX_DIGITS + 1)]
        low, high = next((pair for pair in texts if pair[0] != pair[1]), texts[-1])
        return f"{self.value:.0%} ({low} to {high})"


def stratified_mean_interval(strata: Sequence[ArrayLike]) -> Interval:
    """Return the mean of the strata's means, with a bootstrap that resamples every stratum.

    A stratum has independent samples, shape (k,), such as the episodes of a robot.
    """
    tables = tuple(np.asarray(samples, dtype=np.float64) for samples in strata)
    mean = float(np.mean([table.mean() for table in tables]))
    if min(len(table) for table in tables) < 2:
        return Interval(mean, math.nan, math.nan)

    def statistic(*samples: NDArray[Any], axis: int = -1) -> NDArray[Any]:
        values: NDArray[Any] = np.mean([sample.mean(axis=axis) for sample in samples], axis=0)
        return values

    if all(np.ptp(samples) == 0 for samples in tables):
        return Interval(mean, math.nan, math.nan)
    num_values = sum(len(samples) for samples in tables)
    interval = scipy.stats.bootstrap(
        tables,
        statistic,
        vectorized=True,
        n_resamples=RESAMPLES,
        batch=min(RESAMPLES, max(1, MAX_RESAMPLED // num_values)),
        confidence_level=LEVEL,
        method="percentile",
        random_state=np.random.default_rng(0),
    ).confidence_interval
    if interval.low == interval.high:
        return Interval(mean, math.nan, math.nan)
    return Interval(mean, float(interval.low), float(interval.high))


def mean_interval(seeds: Sequence[Sequence[ArrayLike]], *, together: bool = True) -> Interval:
    """Return the mean over training seeds of the means of their strata, with a bootstrap.

    It resamples the seeds, and the samples of every stratum in each of them: a method is the sample
    of its trainings, which differ more than the episodes of one. A single seed tells nothing of
    them; its interval is ``stratified_mean_interval``, of the episodes alone.

    ``together``: A resample has whole seeds; else it has a seed of each stratum, for policies of
    single robots.
    """
    if len(seeds) == 1:
        return stratified_mean_interval(seeds[0])
    tables = [[np.asarray(samples, dtype=np.float64) for samples in strata] for strata in seeds]
    mean = float(np.mean([[samples.mean() for samples in strata] for strata in tables]))
    generator = np.random.default_rng(0)
    num_strata = len(tables[0])
    means = np.zeros((RESAMPLES, num_strata))
    for _ in tables:  # a resample has as many seeds as there are
        shape = (RESAMPLES, 1 if together else num_strata)
        drawn = np.broadcast_to(generator.integers(len(tables), size=shape), means.shape)
        for (seed, strata), stratum in itertools.product(enumerate(tables), range(num_strata)):
            rows, samples = np.flatnonzero(drawn[:, stratum] == seed), strata[stratum]
            picked = generator.integers(len(samples), size=(len(rows), len(samples)))
            means[rows, stratum] += samples[picked].mean(axis=1) / len(tables)
    tail = (1 - LEVEL) / 2
    low, high = np.quantile(means.mean(axis=1), (tail, 1 - tail)).tolist()
    return Interval(mean, low, high) if low < high else Interval(mean, math.nan, math.nan)


def success_interval(rates: ArrayLike, trials: ArrayLike) -> Interval:
    """Return a mean success rate with its interval (Wilson 1927), which stays within 0 and 1.

    It has a width at 0 and 1, too. It is that of one rate for all strata: strata of different rates
    make it too wide, never too narrow.

    Rates and numbers of trials, at least 1, are those of the strata, such as the episodes of a
    robot and seed, shape (k,), or one number for all.
    """
    rates, trials = np.broadcast_arrays(np.asarray(rates, dtype=np.float64), trials)
    mean = float(rates.mean())
    # As many trials as have the variance of the mean of the strata: all, if they are equally large.
    total = round(rates.size**2 / float(np.sum(1 / trials)))
    result = scipy.stats.binomtest(round(mean * total), total).proportion_ci(LEVEL, method="wilson")
    return Interval(mean, float(result.low), float(result.high))


def seeds_success_interval(
    seeds: Sequence[Sequence[Sequence[bool]]], *, together: bool = True
) -> Interval:
    """Return the mean success rate of seeds and robots, from the successes of their episodes.

    Its interval has that of all episodes (``success_interval``), which a single seed has, and that
    of the seeds (``mean_interval``): seeds that agree are no less uncertain than their episodes.
    """
    successes = [each for strata in seeds for each in strata]
    interval = success_interval([np.mean(each) for each in successes], list(map(len, successes)))
    if len(seeds) == 1:
        return interval
    of_seeds = mean_interval(seeds, together=together)
    low, high = (interval.low, of_seeds.low), (interval.high, of_seeds.high)
    return Interval(interval.value, float(np.nanmin(low)), float(np.nanmax(high)))


def episode_interval(
    scores: Sequence[Sequence[ArrayLike]],
    successes: Sequence[Sequence[Sequence[bool]]],
    *,
    relative: bool,
    together: bool = True,
) -> Interval:
    """Return the mean over seeds and robots of their mean scores.

    Its interval is ``seeds_success_interval`` if the score of an episode is its success, as that of
    push; else ``mean_interval``. Scores and successes are lists of seeds, of robots, of episodes.
    """
    pairs = zip(itertools.chain(*scores), itertools.chain(*successes), strict=True)
    if not relative and all(np.array_equal(*pair) for pair in pairs):
        return seeds_success_interval(successes, together=together)
    return mean_interval(scores, together=together)


POWER = 0.8  # probability that a difference shows, by convention
_Z_LEVEL, _Z_POWER = 1.959964, 0.841621
"""Quantiles of the normal distribution, of ``LEVEL`` on two sides and of ``POWER``."""


def smallest_rate_difference(episodes: int) -> float:
    """Return the smallest difference of two success rates, around 50%, that shows.

    It does at ``LEVEL`` with the probability ``POWER``, where either method has so many episodes
    (Fleiss, Levin and Paik 2003, Statistical Methods for Rates and Proportions, chapter 4, without
    correction for continuity): d = (z1 sqrt(2 p q) + z2 sqrt(p1 q1 + p2 q2)) / sqrt(n) with
    p1, p2 = (1 +- d) / 2. Around other rates it is smaller.
    """
    # With d = sin(x) it is: sqrt(2 n) sin(x) - z2 cos(x) = z1.
    norm = math.hypot(math.sqrt(2 * episodes), _Z_POWER)
    angle = math.asin(min(_Z_LEVEL / norm, 1)) + math.asin(_Z_POWER / norm)
    return math.sin(min(angle, math.pi / 2))


def smallest_mean_difference(errors: tuple[float, float]) -> float:
    """Return the smallest difference of two means with standard errors that shows, likewise."""
    return (_Z_LEVEL + _Z_POWER) * math.hypot(*errors)


def mean_error(seeds: Sequence[Sequence[ArrayLike]]) -> float:
    """Return the standard error of ``mean_interval``: of the seeds, or more of their episodes.

    It is nan if there is one seed with one episode of a robot.
    """
    tables = [[np.asarray(samples, dtype=np.float64) for samples in strata] for strata in seeds]
    errors = [
        float(np.std(samples, ddof=1)) / math.sqrt(samples.size) if samples.size > 1 else math.nan
        for strata in tables
        for samples in strata
    ]
    of_episodes = math.hypot(*errors) / len(errors)
    if len(tables) == 1:
        return of_episodes
    means = [np.mean([samples.mean() for samples in strata]) for strata in tables]
    return float(np.fmax(of_episodes, np.std(means, ddof=1) / math.sqrt(len(seeds))))


Name = Annotated[str, Meta(min_length=1, max_length=200)]
Count = Annotated[int, Meta(ge=0, le=1_000_000_000)]


class RobotOutcomes(Record, frozen=True):
    """The episodes of one robot."""

    robot: Name
    side: Side
    task: Name
    body: Name  # hash of the robot in the split
    goal_set: Name  # key of the robot's goal set: a hash of all that goals and starts follow from
    success: tuple[bool, ...]
    score: tuple[FiniteNumber, ...]  # score of each episode, not relative to the random policy
    distance: tuple[FiniteNumber, ...]  # distance from success at the end of each episode [m]
    steps: tuple[Count, ...]  # length of each episode [control steps]
    diverged: tuple[bool, ...]  # whether each episode ended because the simulation diverged
    random_score: tuple[FiniteNumber, ...]
    """Score of each episode of the random policy with the same starts and goals."""
    random_success: tuple[bool, ...]


LISTS = ("success", "score", "distance", "steps", "diverged")
"""Lists of a robot with an entry per episode of the policy, named as the fields of an episode."""

RandomScores = Mapping[tuple[Side, str], Sequence[float]]
"""Scores of the random policy's episodes, by side and name of the robot."""


def relative_scores(outcomes: RobotOutcomes, random: RandomScores | None = None) -> Array:
    """Return the score of each episode, relative to the random policy where the task wants it."""
    scores = np.array(outcomes.score)
    if not TASKS[outcomes.task].relative_to_random:
        return scores
    if random is None:
        random = {(outcomes.side, outcomes.robot): outcomes.random_score}
    if (outcomes.side, outcomes.robot) not in random:
        raise BenchmarkError(
            f"{outcomes.side} robot {outcomes.robot}: the release has no episodes of the random "
            "policy; leave the robots of this side out"
        )
    own = np.array(random[outcomes.side, outcomes.robot])
    if len(scores) % len(own):  # another run's: some episodes would count more often
        own = np.array([own.mean()])
    relative: Array = scores - np.resize(own, len(scores))
    return relative


@dataclass(frozen=True)
class Score:
    """Result of one robot in an evaluation."""

    robot: str  # name of the robot
    side: Side  # side of the split that the robot is on
    task: str  # task of the robot
    episodes: int  # number of episodes
    steps: int  # total length of the episodes [control steps]
    score: float  # `raw`, or `raw - random` for tasks with `Task.relative_to_random`
    low: float  # lower end of the 95% interval of `score` over episodes; see `episode_interval`
    high: float  # upper end of the interval; nan like `low` if the episodes cannot tell it
    raw: float  # mean score of the episodes; see `Task.episode_score`
    random: float  # mean score of the random policy's episodes
    success: float  # success rate of the episodes, 0 to 1
    random_success: float  # success rate of the random policy's episodes, 0 to 1
    distance: float  # mean distance from success at the end of an episode [m]
    relative_distance: float
    """``distance`` over the robot's ``reach_from_root``; nan for tasks without such a distance."""
    unstable: int  # number of episodes that ended because the simulation diverged
    angle: float  # mean angle from success at the end of an episode [rad]; nan without orientation
    success_low: float  # lower end of the 95% Wilson interval of `success`
    success_high: float  # upper end of the interval
    outcomes: RobotOutcomes = field(repr=False, compare=False)
    """The episodes, for submissions; tables leave them out."""


SCORE_KEYS = tuple(each.name for each in fields(Score) if each.name != "outcomes")
"""Keys of a score in JSON, and columns of CSV."""


def score_of(outcomes: RobotOutcomes, angles: Sequence[float], reach_from_root: float) -> Score:
    """Return the score of a robot from its episodes and their last angles."""
    task, distance = TASKS[outcomes.task], float(np.mean(outcomes.distance))
    interval = episode_interval(
        [[relative_scores(outcomes)]], [[outcomes.success]], relative=task.relative_to_random
    )
    success = success_interval(np.mean(outcomes.success), len(outcomes.success))
    return Score(
        robot=outcomes.robot,
        side=outcomes.side,
        task=outcomes.task,
        episodes=len(outcomes.score),
        steps=sum(outcomes.steps),
        score=interval.value,
        low=interval.low,
        high=interval.high,
        raw=float(np.mean(outcomes.score)),
        random=float(np.mean(outcomes.random_score)),
        success=success.value,
        random_success=float(np.mean(outcomes.random_success)),
        distance=distance,
        relative_distance=distance / reach_from_root if task.relative_distance else math.nan,
        unstable=sum(outcomes.diverged),
        angle=float(np.mean(angles)),
        success_low=success.low,
        success_high=success.high,
        outcomes=outcomes,
    )


def success_of(scores: Sequence[Score]) -> Interval:
    """Return the mean success rate of robots, or of robots and seeds, with its Wilson interval."""
    return success_interval([each.success for each in scores], [each.episodes for each in scores])


def scores_to_json(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Return scores as JSON values, with null instead of nan."""
    return [finite_or_none({key: getattr(each, key) for key in SCORE_KEYS}) for each in scores]


def finite_or_none(value: Any) -> Any:  # noqa: ANN401
    """Return nested dictionaries and sequences for JSON, with None for numbers not finite."""
    if isinstance(value, Mapping):
        return {key: finite_or_none(item) for key, item in value.items()}
    if isinstance(value, (tuple, list)):
        return [finite_or_none(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def score_decimals(scores: Iterable[float]) -> int:
    """Return the number of decimals of a task's scores in tables, for at least three digits."""
    return 1 if any(abs(score) >= 10 for score in scores) else 2


SIDES = {"train": "MT", "test": "ZS"}
"""The paper's names of the mean score of a side: multi-task and zero-shot."""
HEADERS = ("robot", "side", "task", "mode", "score", "95%", "success", "raw", "random", "distance")
UNSTABLE = "episodes that ended because their simulation became unstable"
SUFFIXES = (".csv", ".json", ".md")


def require_table(path: Path) -> None:
    """Require that a table can be written to a path."""
    if path.suffix not in SUFFIXES:
        raise TaskError(
            f"{path}: no name of a table ends in {path.suffix!r}{nearest(path.suffix, SUFFIXES)}"
        )
    require_writable_file(path)


@dataclass(frozen=True)
class Evaluation:
    """Scores of a policy or a baseline, robot by robot; its text is a table."""

    scores: Mapping[str, Sequence[Score]]
    """Scores by mode (``deterministic`` or ``stochastic``), or by the name of a baseline."""

    def as_dict(self) -> dict[str, list[dict[str, Any]]]:
        """Return the scores as JSON values, with null instead of nan."""
        return {mode: scores_to_json(scores) for mode, scores in self.scores.items()}

    def table(self, style: str = "simple") -> str:
        """Return a table with a line per robot and mode; ``style`` is one of tabulate's."""
        rows = [_row(mode, each) for mode, scores in self.scores.items() for each in scores]
        return table(rows, HEADERS, style=style)

    def summary(self) -> str:
        """Return a line per mode: mean scores of each side and task, and diverged episodes."""
        lines = []
        for mode, scores in self.scores.items():
            means = []
            for side, task in dict.fromkeys((each.side, each.task) for each in scores):
                own = [each for each in scores if (each.side, each.task) == (side, task)]
                score = np.mean([each.score for each in own])
                success = success_of(own).as_percent()
                means.append(f"{SIDES[side]} {task} {score:.2f}, success {success}")
            if unstable := sum(each.unstable for each in scores):
                means.append(f"{UNSTABLE}: {unstable}")
            lines.append(f"{mode}: " + "; ".join(means))
        return "\n".join(lines)

    def __str__(self) -> str:
        return f"{self.table()}\n{self.summary()}"

    def write(self, path: str | PathLike[str]) -> None:
        """Write CSV, JSON or Markdown, by the suffix of the path."""
        file = path_argument("path", path, TaskError)
        require_table(file)
        if file.suffix == ".json":
            write_file(file, json.dumps(self.as_dict(), indent=2) + "\n")
        elif file.suffix == ".md":
            write_file(file, self.table("github") + "\n")
        else:
            text = io.StringIO()
            writer = csv.DictWriter(text, ["mode", *SCORE_KEYS], lineterminator="\n")
            writer.writeheader()
            for mode, rows in self.as_dict().items():
                writer.writerows({"mode": mode, **row} for row in rows)
            write_file(file, text.getvalue())


def _row(mode: str, score: Score) -> tuple[str, ...]:
    angle = "" if math.isnan(score.angle) else f", {math.degrees(score.angle):.1f} deg"
    interval = Interval(score.score, score.low, score.high)
    return (
        score.robot,
        score.side,
        score.task,
        mode,
        f"{score.score:.2f}",
        interval.ends(".2f"),
        success_of([score]).as_percent(),
        f"{score.raw:.2f}",
        f"{score.random:.2f}",
        f"{score.distance:.3f} m{angle}",
    )

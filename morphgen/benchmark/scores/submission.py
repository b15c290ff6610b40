"""A submission: the outcome of every episode of one policy on a split, as JSON.

Scores are not part of it: ``morphgen.benchmark.scores.leaderboard`` computes them from the
episodes. Lists of a robot have an entry per episode, in the order of the evaluation, which the seed
determines.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from msgspec import Meta

from morphgen.benchmark.eval_protocol import EvalProtocol, ExpectedRobot
from morphgen.errors import BenchmarkError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import write_file
from morphgen.formats.records import Record, dotted_values, read_record
from morphgen.rl.scores import Count, Name, RobotOutcomes, Score
from morphgen.splits.split import Split, split_id
from morphgen.tasks.registry import TASKS

FORMAT = 1
KIND = "morphgen submission"
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class SplitName(Record, frozen=True):
    """The split that a submission is for."""

    name: Name
    id: Name  # id of the split, see `morphgen.splits.split.split_id`


class Training(Record, frozen=True):
    """How a policy was trained."""

    simulator: Name
    transitions: Annotated[int, Meta(ge=0, le=10**15)]
    finetuned: Count = 0
    """Transitions of fine-tuning on the test robots, after ``transitions`` on the train robots."""


class Submission(Record, frozen=True):
    """The content of a submission."""

    kind: Literal["morphgen submission"]
    format: int
    method: Name  # name of the method in rankings
    mode: Literal["", "deterministic", "stochastic"]  # how the policy acts; empty for a baseline
    training_seed: Seed | None  # seed of the training; None for a baseline
    morphgen: Name  # version of morphgen that ran the episodes
    split: SplitName
    evaluation: dict[str, Any]  # rules of the evaluation, see `morphgen.benchmark.eval_protocol`
    robots: tuple[RobotOutcomes, ...]
    training: Training | None = None  # how the policy was trained, if it is known
    config: dict[str, Any] | None = None
    """Config of the run in a study, without the text of its split."""

    @property
    def finetuned(self) -> int:
        """Transitions of fine-tuning on the test robots."""
        return self.training.finetuned if self.training else 0

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"format {self.format}; this version reads {FORMAT}")
        if not self.method.isprintable():
            raise ValueError(f"method {self.method!r}; expected printable characters")


def make_submission(
    split: Split,
    scores: Iterable[Score],
    *,
    method: str,
    mode: str,
    training_seed: int | None,
    evaluation: dict[str, Any],
    training: Training | None = None,
    config: dict[str, Any] | None = None,
) -> Submission:
    """Return the episodes of evaluated robots as a submission; see ``Submission``."""
    data = {
        "kind": KIND,
        "format": FORMAT,
        "method": method,
        "mode": mode,
        "training_seed": training_seed,
        "morphgen": version("morphgen"),
        "split": {"name": split.name, "id": split_id(split)},
        "evaluation": evaluation,
        "training": msgspec.to_builtins(training),
        "config": config,
        "robots": [msgspec.to_builtins(score.outcomes) for score in scores],
    }
    return read_record(data, Submission, "submission", BenchmarkError)


def submission_text(submission: Submission) -> str:
    """Return the text of a submission: a line per list of a robot."""
    data = msgspec.to_builtins(submission)
    robots = data.pop("robots")
    for name in ("training", "config"):
        if data[name] is None:
            del data[name]
    head = json.dumps(data, indent=2).removesuffix("\n}")
    blocks = [
        ",\n".join(f"      {json.dumps(key)}: {json.dumps(value)}" for key, value in robot.items())
        for robot in robots
    ]
    body = ",\n".join(f"    {{\n{block}\n    }}" for block in blocks)
    return f'{head},\n  "robots": [\n{body}\n  ]\n}}\n'


def write_submission(path: Path, submission: Submission) -> None:
    """Write a submission."""
    write_file(path, submission_text(submission))


def json_files(path: Path, *patterns: str) -> Iterator[tuple[Path, Any]]:
    """Yield a JSON file with its content, or those of a folder in the order of their paths."""
    if path.is_dir():
        files = sorted({file for pattern in patterns for file in path.glob(pattern)})
    elif path.is_file():
        files = [path]
    else:
        raise BenchmarkError(f"{path}: no such file or folder")
    for file in files:
        yield file, read_json(file)


def is_submission(data: object) -> bool:
    """Return whether the content of a JSON file claims to be a submission."""
    return isinstance(data, dict) and data.get("kind") == KIND


def read_submission(path: Path) -> Submission:
    """Read a submission and check its form, not what it claims."""
    data = read_json(path)
    if not is_submission(data):
        raise BenchmarkError(
            f"{path}: no submission; expected an object with the kind {KIND!r}, as morphgen eval "
            "--submission writes it"
        )
    return submission_from(data, path)


def submission_from(data: object, where: Path | str) -> Submission:
    """Return the submission of a JSON file's content, and check its form."""
    return read_record(data, Submission, str(where), BenchmarkError)


LISTS = ("success", "score", "distance", "steps", "diverged")
"""Lists of a robot with an entry per episode of the policy."""
MAX_EPISODES = 10_000  # largest number of episodes of a robot
MAX_DISTANCE = 1e3  # largest distance from success [m]
ROUNDING = 1e-4
"""Relative error of a sum of an episode's scores in single precision, which a valid score may
exceed its range by."""
RANDOM_TOLERANCE = 1.0
"""Largest difference of the mean scores of the same episodes of the random policy: processors
differ in the last bits, as for ``SCORE_TOLERANCE`` of ``tests/doctor/test_versions.py``."""
RANDOM_ERRORS = 4.0
"""Largest difference of the mean scores of different episodes of it [standard errors]."""


def check_submission(
    submission: Submission,
    where: str,
    split: Split,
    protocol: EvalProtocol,
    expected: Sequence[ExpectedRobot],
    version: str,
) -> None:
    """Check all that a submission claims; its scores compare with those of ``version``."""
    if submission.split.id != split_id(split):
        raise BenchmarkError(
            f"{where}: split.id: {submission.split.id} ({submission.split.name}); expected "
            f"{split_id(split)} ({split.name})"
        )
    # Episodes may change with the second number of a version, never with the third.
    theirs, series = (".".join(each.split(".")[:2]) for each in (submission.morphgen, version))
    if theirs != series:
        raise BenchmarkError(
            f"{where}: morphgen: {submission.morphgen}; scores are compared with those of version "
            f"{series}"
        )
    require_rules(submission.evaluation, protocol.as_data(split), where)
    wanted = {(each.side, each.member.name): each for each in expected}
    require_each_once(submission, where)
    for outcomes in submission.robots:
        key = (outcomes.side, outcomes.robot)
        at = f"{where}: {outcomes.side} robot {outcomes.robot}"
        if key not in wanted:
            raise BenchmarkError(f"{at}: the split has no such robot")
        _check_robot(outcomes, at, wanted[key], protocol)
    seen = {(outcomes.side, outcomes.robot) for outcomes in submission.robots}
    sides = {side for side, _ in seen} | {"test"}  # the train side may be left out as a whole
    for side, name in wanted:
        if side in sides and (side, name) not in seen:
            raise BenchmarkError(
                f"{where}: {side} robot {name}: is missing; expected all robots of the side"
            )


def require_each_once(submission: Submission, where: str) -> None:
    """Require that a submission has no robot of a side twice."""
    counts = Counter((outcomes.side, outcomes.robot) for outcomes in submission.robots)
    for (side, robot), count in counts.items():
        if count > 1:
            raise BenchmarkError(f"{where}: {side} robot {robot}: is there twice; expected once")


def require_comparable(submissions: Mapping[str, Submission]) -> None:
    """Require that submissions have the robots and the evaluation of the first one."""
    (first, other), *rest = submissions.items()
    for where, each in rest:
        if each.split.id != other.split.id:
            raise BenchmarkError(
                f"{where}: split.id {each.split.id}; expected {other.split.id}, as in {first}"
            )
        found, expected = (dotted_values({"evaluation": x.evaluation}) for x in (each, other))
        for key in expected | found:
            if found.get(key) != expected.get(key):
                raise BenchmarkError(
                    f"{where}: {key} {found.get(key)!r}; expected {expected.get(key)!r}, as in "
                    f"{first}; scores of different evaluations do not compare"
                )


def require_same_random(submissions: Sequence[tuple[str, Submission]]) -> None:
    """Require that submissions agree about the random policy, whose scores follow from the split.

    Episodes of a test robot are the same if there are as many. Those of a train robot may be
    others: policies of single robots are evaluated robot by robot, and so is the random policy.
    """
    first: dict[tuple[str, str], tuple[str, RobotOutcomes]] = {}
    for where, submission in submissions:
        for outcomes in submission.robots:
            if not TASKS[outcomes.task].relative_to_random:
                continue
            key = (outcomes.side, outcomes.robot)
            earlier, other = first.setdefault(key, (where, outcomes))
            found, expected = np.array(outcomes.random_score), np.array(other.random_score)
            if abs(found.mean() - expected.mean()) > _random_tolerance(outcomes, other):
                raise BenchmarkError(
                    f"{where}: {outcomes.side} robot {outcomes.robot}: random_score: mean "
                    f"{found.mean():.2f}; expected {expected.mean():.2f}, as in {earlier}: the "
                    "random policy has the same episodes in all submissions; evaluate again, or "
                    "rank them in a release with a submission of random"
                )


def _random_tolerance(outcomes: RobotOutcomes, other: RobotOutcomes) -> float:
    """Return the largest valid difference of two mean scores of the random policy."""
    counts = len(outcomes.random_score), len(other.random_score)
    if outcomes.side == "test" and counts[0] == counts[1]:
        return RANDOM_TOLERANCE
    # The smaller deviation: edited scores cannot widen their own tolerance.
    deviation = min(float(np.std(each.random_score)) for each in (outcomes, other))
    error = deviation * math.sqrt(1 / counts[0] + 1 / counts[1])
    return max(RANDOM_TOLERANCE, RANDOM_ERRORS * error)


def require_rules(found: Mapping[str, Any], rules: Mapping[str, Any], where: str) -> None:
    """Require that an evaluation followed the rules of a protocol."""
    given = dotted_values(found)
    fixed = {key: rules[key] for key in ("simulator", "seed", "goal_seed", "constants")}
    for key, value in dotted_values(fixed).items():
        if given.get(key) != value:
            raise BenchmarkError(
                f"{where}: evaluation.{key}: {given.get(key)!r}; expected {value!r}"
            )
    episodes = found.get("episodes")
    if type(episodes) is not int or episodes < rules["episodes"]:  # True is an int, too
        raise BenchmarkError(
            f"{where}: evaluation.episodes: {episodes!r}; expected {rules['episodes']} or more"
        )


def _check_robot(
    outcomes: RobotOutcomes, at: str, expected: ExpectedRobot, protocol: EvalProtocol
) -> None:
    member = expected.member
    for key, found, wanted in (
        ("task", outcomes.task, member.task),
        ("body", outcomes.body, member.robot_hash),
        ("goal_set", outcomes.goal_set, expected.goal_set),
    ):
        if found != wanted:
            raise BenchmarkError(f"{at}: {key}: {found}; expected {wanted}")
    count = len(outcomes.score)
    if not protocol.episodes <= count <= MAX_EPISODES:
        raise BenchmarkError(
            f"{at}: score: {count} episodes; expected {protocol.episodes} to {MAX_EPISODES}"
        )
    require_full_lists(outcomes, at, protocol.episodes)
    _check_episodes(outcomes, at, expected, protocol)


def require_full_lists(outcomes: RobotOutcomes, at: str, least_random: int = 0) -> None:
    """Require an entry for every episode in the lists of a robot, and one episode or more."""
    count, random_count = len(outcomes.score), len(outcomes.random_score)
    if not count:
        raise BenchmarkError(f"{at}: score: no episodes; expected one or more")
    for name in LISTS:
        if len(getattr(outcomes, name)) != count:
            raise BenchmarkError(
                f"{at}: {name}: {len(getattr(outcomes, name))} episodes; expected {count}, as in "
                "score"
            )
    if len(outcomes.random_success) != random_count or random_count < least_random:
        least = f"{least_random} or more, " if least_random else ""
        raise BenchmarkError(
            f"{at}: random_score: {random_count} episodes, random_success: "
            f"{len(outcomes.random_success)}; expected {least}as many of both"
        )
    if not random_count and TASKS[outcomes.task].relative_to_random:
        raise BenchmarkError(f"{at}: random_score: no episodes; expected one or more")


def _check_episodes(
    outcomes: RobotOutcomes, at: str, expected: ExpectedRobot, protocol: EvalProtocol
) -> None:
    task = TASKS[expected.member.task]
    config = protocol.goals.task_config(expected.member.task)
    low, high = task.score_range(config, expected.reach)
    for name in ("score", "random_score"):
        for i, score in enumerate(getattr(outcomes, name)):
            if not low - ROUNDING * abs(low) <= score <= high + ROUNDING * abs(high):
                raise BenchmarkError(f"{at}: {name}[{i}]: {score:g}; expected {low:g} to {high:g}")
    rows = zip(*(getattr(outcomes, name) for name in LISTS), strict=True)
    for i, (success, score, distance, steps, diverged) in enumerate(rows):
        fault = ""
        if not 1 <= steps <= config.max_episode_steps:
            fault = f"steps[{i}]: {steps}; expected 1 to {config.max_episode_steps}"
        elif not 0 <= distance <= MAX_DISTANCE:
            fault = f"distance[{i}]: {distance:g}; expected 0 to {MAX_DISTANCE:g}"
        elif diverged and success:
            fault = f"success[{i}]: true in an episode that diverged; expected false"
        elif not diverged and (why := task.outcome_fault(config, success, score, distance)):
            fault = f"episode {i}: {why}"
        if fault:
            raise BenchmarkError(f"{at}: {fault}")

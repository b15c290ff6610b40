"""A submission: the outcome of every episode of one policy on a split, as JSON or in a table.

It follows the rules of a release, so that scores can be compared; see ``EvalProtocol``.

Scores are not part of it: ``morphgen.benchmark.scores.results`` computes them from the episodes.
Lists of a robot have an entry per episode, in the order of the evaluation, which the seed
determines. A file ends with the SHA-256 of its content, which an edited one does not have.

``episodes.csv.gz``, the table of a study, has a row per episode. Before the rows of each run and
mode stands a line that begins with ``#``: the submission without its robots, as JSON. Tools that
skip such lines, such as ``pandas.read_csv(file, comment="#")``, read the rest as it is. New runs
are appended as further gzip members, so that a table is never unpacked to be extended.
"""

from __future__ import annotations

import csv
import gzip
import hashlib
import io
import itertools
import json
import math
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np
from filelock import FileLock
from msgspec import Meta

from morphgen.errors import MAX_WHOLE, BenchmarkError, MorphgenError, TaskError, nearest
from morphgen.files import write_atomic
from morphgen.formats.data_files import parse_json, read_bytes, read_json
from morphgen.formats.files import LOCK
from morphgen.formats.records import Record, dotted_values, read_record
from morphgen.grammar.library import Library
from morphgen.model.kinematics import reach_from_root
from morphgen.processes import parallel_map
from morphgen.progress import note
from morphgen.rl.scores import LISTS, Count, Name, RobotOutcomes, Score
from morphgen.splits.split import Member, Side, Split, sided_members, split_id
from morphgen.tasks.goal_sets import goal_set_key
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import (
    GoalConfig,
    ground_under,
    member_with_primitives,
    task_configs,
)

FORMAT = 1
KIND = "morphgen submission"
Seed = Annotated[int, Meta(ge=0, le=MAX_WHOLE)]


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
    evaluation: dict[str, Any]  # rules of the evaluation, see `EvalProtocol`
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


DIGEST = "sha256"


def content_digest(data: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the data of a submission, which do not hold it yet."""
    return hashlib.sha256(json.dumps(data, sort_keys=True).encode()).hexdigest()


def submission_text(submission: Submission) -> str:
    """Return the text of a submission: a line per list of a robot."""
    data = msgspec.to_builtins(submission)
    robots = data.pop("robots")
    for name in ("training", "config"):
        if data[name] is None:
            del data[name]
    digest = content_digest(data | {"robots": robots})
    head = json.dumps(data, indent=2).removesuffix("\n}")
    blocks = [
        ",\n".join(f"      {json.dumps(key)}: {json.dumps(value)}" for key, value in robot.items())
        for robot in robots
    ]
    body = ",\n".join(f"    {{\n{block}\n    }}" for block in blocks)
    return f'{head},\n  "robots": [\n{body}\n  ],\n  "{DIGEST}": "{digest}"\n}}\n'


def is_submission(data: object) -> bool:
    """Return whether the content of a JSON file claims to be a submission."""
    return isinstance(data, dict) and data.get("kind") == KIND


def read_submission(path: Path) -> Submission:
    """Read a submission and check its form, not what it claims."""
    _require_no_split(path)
    data = read_json(path)
    if not is_submission(data):
        raise BenchmarkError(
            f"{path}: no submission; expected an object with the kind {KIND!r}, as morphgen eval "
            "--submission writes it"
        )
    if DIGEST not in data:
        note(f"morphgen: {path}: an earlier version wrote no {DIGEST}: it may have been edited")
    return submission_from(data, path)


def _require_no_split(path: Path) -> None:
    if path.suffix in (".yaml", ".yml"):
        raise BenchmarkError(f"{path}: a split, no submission; name it by --split")


def submission_from(data: object, where: Path | str) -> Submission:
    """Return the submission of a JSON file; its form and SHA-256 (if any) are checked."""
    if isinstance(data, dict) and DIGEST in data:
        data = dict(data)
        if (stored := data.pop(DIGEST)) != (found := content_digest(data)):
            raise BenchmarkError(
                f"{where}: {DIGEST}: {stored}; its content has {found}: it was edited after "
                "morphgen eval; evaluate again with --submission"
            )
    return read_record(data, Submission, str(where), BenchmarkError)


MAX_EPISODES = 10_000  # largest number of episodes of a robot
MAX_DISTANCE = 1e3  # largest distance from success [m]
ROUNDING = 1e-4
"""Relative error of a sum of an episode's scores in single precision, which a valid score may
exceed its range by."""
RANDOM_TOLERANCE = 1.0
"""Largest difference of the mean scores of the same episodes of the random policy: processors
differ in the last bits, as for ``SCORE_TOLERANCE`` of ``tests/doctor/test_diagnosis.py``."""
RANDOM_ERRORS = 4.0
"""Largest difference of the mean scores of different episodes of it [standard errors]."""


SAME_SCORES = {"0.4": "0.3"}
"""Versions, by their first two numbers, whose mean scores compare with those of the one before."""


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
    # The third number of a version changes no scores.
    series = [".".join(each.split(".")[:2]) for each in (submission.morphgen, version)]
    if len({SAME_SCORES.get(each, each) for each in series}) > 1:
        raise BenchmarkError(
            f"{where}: morphgen: {submission.morphgen}; scores are compared with those of version "
            f"{version}"
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
    low, high = task.score_range(config, expected.reach_from_root)
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


EPISODES = "episodes.csv.gz"  # name of the table in the folder of a study
RUN = ("split", "method", "mode", "training_seed", "finetuned")
ROBOT = ("robot", "side", "task", "body", "goal_set")
RANDOM = ("random_score", "random_success")
COLUMNS = (*RUN, *ROBOT, "episodes", *LISTS, *RANDOM)
"""Columns of the table. ``episodes`` is 1, or the number of episodes whose means a row has: studies
of morphgen 0.2 kept no more. Cells of ``RANDOM`` are empty beyond the episodes of random."""
_FLAGS = ("success", "diverged", "random_success")
"""Columns that are true or false, written as 1 or 0."""
MAX_BYTES = 128 * 2**20
"""Largest table without compression [bytes]: about 900,000 episodes, which take less than
1 GiB to read."""


def _table_text(submission: Submission) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    head = msgspec.to_builtins(submission)
    del head["robots"]
    text.write(f"# {json.dumps(head)}\n")
    run = [submission.split.name, *(getattr(submission, name) for name in RUN[1:])]
    for robot in submission.robots:
        named = [getattr(robot, name) for name in ROBOT]
        columns = [getattr(robot, name) for name in (*LISTS, *RANDOM)]
        for values in itertools.zip_longest(*columns, fillvalue=""):
            cells = (int(each) if isinstance(each, bool) else each for each in values)
            writer.writerow([*run, *named, 1, *cells])
    return text.getvalue()


def append_submission(path: Path, submission: Submission) -> None:
    """Add a submission to a table, which is made if it does not exist; processes may share it."""
    with FileLock(path.with_name(LOCK)):
        before = path.read_bytes() if path.is_file() else _packed(f"{','.join(COLUMNS)}\n")
        write_atomic(path, before + _packed(_table_text(submission)))


def _packed(text: str) -> bytes:
    return gzip.compress(text.encode(), mtime=0)  # the same text gives the same bytes


def read_table(path: Path) -> tuple[Submission, ...]:
    """Return the submissions of a table; a file that did not change is not read again."""
    try:
        status = path.stat()
        return _read(path, status.st_mtime_ns, status.st_size)
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error.strerror}") from error


@lru_cache(maxsize=4)
def _read(path: Path, _changed: int, _size: int) -> tuple[Submission, ...]:
    try:
        with gzip.open(io.BytesIO(read_bytes(path))) as file:
            content = file.read(MAX_BYTES + 1)
        if len(content) > MAX_BYTES:
            raise BenchmarkError(f"{path}: more than {MAX_BYTES} bytes without compression")
        text = content.decode("utf-8")
    except (EOFError, UnicodeDecodeError, zlib.error, gzip.BadGzipFile) as error:
        raise BenchmarkError(f"{path}: is not a table of episodes: {error}") from error
    first, *lines = text.removesuffix("\n").split("\n")
    if first != ",".join(COLUMNS):
        raise BenchmarkError(f"{path}: line 1: expected the columns {','.join(COLUMNS)}")
    return tuple(_submissions(lines, path))


def _submissions(lines: Sequence[str], path: Path) -> Iterator[Submission]:
    starts = [i for i, line in enumerate(lines) if line.startswith("#")]
    for start, end in itertools.pairwise([*starts, len(lines)]):
        where = f"{path}: line {start + 2}"
        head = parse_json(lines[start].removeprefix("#"), where)
        if not is_submission(head):
            raise BenchmarkError(f"{where}: is not the head of a submission")
        rows = csv.DictReader(lines[start + 1 : end], COLUMNS, restval="")
        try:
            robots = [
                _robot(dict(zip(ROBOT, key, strict=True)), own)
                for key, own in itertools.groupby(rows, lambda row: [row[n] for n in ROBOT])
            ]
        except (ValueError, KeyError) as error:
            raise BenchmarkError(f"{where}: the rows of its run are damaged: {error}") from error
        yield submission_from(head | {"robots": robots}, where)


def _robot(named: Mapping[str, str], rows: Iterable[Mapping[str, str]]) -> dict[str, Any]:
    values: dict[str, list[Any]] = {name: [] for name in (*LISTS, *RANDOM)}
    for row in rows:  # one at a time: as a mapping, a row takes ten times its text
        for name, own in values.items():
            if name in RANDOM and not row[name]:
                continue  # the random policy had fewer episodes
            if name in _FLAGS:
                own.extend(_flags(row[name], int(row["episodes"])))
            else:
                own.append(int(row[name]) if name == "steps" else float(row[name]))
    return {**named, **values}


def _flags(cell: str, episodes: int) -> list[bool]:
    """Return a flag per episode; of a mean as many that are true, whose order is not known."""
    if not 1 <= episodes <= MAX_EPISODES:
        raise ValueError(f"{episodes} episodes; expected 1 to {MAX_EPISODES}")
    if episodes == 1:
        return [cell == "1"]
    return [i < round(float(cell) * episodes) for i in range(episodes)]


def read_submissions(paths: Sequence[Path]) -> dict[str, Submission]:
    """Return submissions in files, folders and tables of studies, by path or row."""
    found: dict[str, Submission] = {}
    for path in paths:
        before = len(found)
        is_table = path.name == EPISODES
        if not is_table and not path.exists():
            raise BenchmarkError(f"{path}: no such file or folder")
        for table in [path] if is_table else sorted(path.rglob(EPISODES)):
            found |= {f"{table}: {name_of(each)}": each for each in read_table(table)}
        files = sorted(path.rglob("*.json")) if path.is_dir() else [path]
        for file in () if is_table else files:
            _require_no_split(file)
            data = read_json(file)
            if is_submission(data) or file == path:
                found[str(file)] = submission = submission_from(data, file)
                if not submission.robots:
                    raise BenchmarkError(f"{file}: robots: none; expected one or more")
                require_each_once(submission, str(file))
                for robot in submission.robots:
                    require_full_lists(robot, f"{file}: {robot.side} robot {robot.robot}")
        if len(found) == before:
            raise BenchmarkError(
                f"{path}: no submissions below it; morphgen study writes them to {EPISODES}"
            )
    return found


def name_of(submission: Submission) -> str:
    """Return split, method, seed and mode of a submission, for messages."""
    seed = "" if submission.training_seed is None else f" seed{submission.training_seed}"
    return f"{submission.split.name} {submission.method}{seed} {mode_of(submission)}".rstrip()


def mode_of(submission: Submission) -> str:
    """Return the name of a submission's mode; empty for a baseline."""
    tuned = submission.finetuned
    return f"fine-tuned {tuned:,}" if tuned else submission.mode


DEFAULT_EPISODES = 34  # default number of episodes per robot: 10,000 control steps


@dataclass(frozen=True)
class EvalProtocol:
    """Rules of an evaluation."""

    simulator: str = DEFAULT_SIMULATOR
    episodes: int = DEFAULT_EPISODES  # minimum number of episodes per robot
    seed: int = 0  # seed of the episodes
    goals: GoalConfig = field(default_factory=GoalConfig)
    """Seed of the goals, and constants of the tasks."""

    def __post_init__(self) -> None:
        """Check the simulator and the numbers."""
        valid = [name for name in SIMULATORS.builtin if name not in ("kinematic", "warp")]
        if self.simulator not in valid:
            raise BenchmarkError(
                f"simulator {self.simulator!r}: no simulator with contacts that comes with morphgen"
                f"{nearest(self.simulator, valid)}"
            )
        numbers = (self.episodes, self.seed)
        is_whole = all(type(number) is int for number in numbers)
        if not (is_whole and 1 <= self.episodes <= 10_000 and 0 <= self.seed <= MAX_WHOLE):
            raise BenchmarkError(
                f"{self.episodes} episodes of seed {self.seed}: expected 1 to 10000 episodes, and "
                "a seed of 0 or more, both whole numbers"
            )

    def as_data(self, split: Split) -> dict[str, Any]:
        """Return the rules as JSON data, with the constants of the split's tasks."""
        return rules_data(self.simulator, self.episodes, self.seed, self.goals, split)


@dataclass(frozen=True)
class ExpectedRobot:
    """A robot of a split whose episodes a submission must hold."""

    side: Side
    member: Member
    goal_set: str  # key of the goal set
    reach_from_root: float  # largest distance of the tool from the root [m]


def rules_data(
    simulator: str, episodes: int, seed: int, goals: GoalConfig, split: Split
) -> dict[str, Any]:
    """Return rules as JSON data, also of an evaluation in a simulator of another package."""
    tasks = tasks_of_split(split)
    constants = goals.as_data(tasks)
    return {
        "simulator": simulator,
        "episodes": episodes,
        "seed": seed,
        "goal_seed": goals.seed,
        "constants": json.loads(json.dumps({task: constants[task] for task in tasks})),
    }


def protocol_from(data: Mapping[str, Any], where: str) -> EvalProtocol:
    """Read what ``EvalProtocol.as_data`` returned."""
    try:
        rules = dict(data)
        constants = rules.pop("constants")
        goals = GoalConfig(int(rules.pop("goal_seed")), task_configs(constants))
        return EvalProtocol(goals=goals, **rules)
    except KeyError as error:
        raise BenchmarkError(f"{where}: evaluation: missing key {error}") from error
    except (TypeError, ValueError, AttributeError, OverflowError, MorphgenError) as error:
        raise BenchmarkError(f"{where}: evaluation: {error}") from error


def tasks_of_split(split: Split) -> tuple[str, ...]:
    """Return the tasks of a split's robots, without repetition."""
    return tuple(dict.fromkeys(each.task for _, each in sided_members(split)))


def expected_robots(
    split: Split, protocol: EvalProtocol, library: Library, *, jobs: int = 1
) -> list[ExpectedRobot]:
    """Return what a submission must hold for every member, train robots first."""
    expect = partial(_expect, library, protocol.goals)
    return list(parallel_map(expect, sided_members(split), jobs))


def _expect(library: Library, goals: GoalConfig, sided: tuple[Side, Member]) -> ExpectedRobot:
    """Compute the key of a member's goal set without sampling it, in a worker process."""
    side, member = sided
    if not TASKS.is_installed(member.task):
        raise TaskError(f"robot {member.name!r}: unknown task {member.task!r}")
    robot = member_with_primitives(member, library)
    key = goal_set_key(
        robot,
        TASKS[member.task],
        goals.task_config(member.task),
        obstacles=member.obstacles,
        seed=goals.seed,
        ground=ground_under(robot),
    )
    return ExpectedRobot(side, member, key, reach_from_root(robot))

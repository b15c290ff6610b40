"""The episodes of a study: one compressed table, and the one reader of episodes in files.

``episodes.csv.gz`` has a row per episode. Before the rows of each run and mode stands a line that
begins with ``#``: the submission without its robots, as JSON. Tools that skip such lines, such as
``pandas.read_csv(file, comment="#")``, read the rest as it is. New runs are appended as further
gzip members, so that a table is never unpacked to be extended.
"""

from __future__ import annotations

import csv
import gzip
import io
import itertools
import json
import zlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
from filelock import FileLock

from morphgen.benchmark.scores.submission import (
    LISTS,
    MAX_EPISODES,
    Submission,
    is_submission,
    json_files,
    require_each_once,
    require_full_lists,
    submission_from,
)
from morphgen.errors import BenchmarkError
from morphgen.formats.data_files import parse_json, read_bytes
from morphgen.formats.files import LOCK, write_atomic

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


def table_text(submissions: Iterable[Submission]) -> str:
    """Return the lines of submissions, without the names of the columns."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for submission in submissions:
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
        write_atomic(path, before + _packed(table_text([submission])))


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
    """Return the data of a robot's outcomes."""
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
    """Return the submissions in files and below folders: JSON files, and tables of studies.

    Keys are the path of the file, and in a table the split, method, seed and mode.
    """
    found: dict[str, Submission] = {}
    for path in paths:
        before = len(found)
        tables = [path] if path.name == EPISODES else sorted(path.rglob(EPISODES))
        for table in tables:
            found |= {f"{table}: {name_of(each)}": each for each in read_table(table)}
        for file, data in () if path in tables else json_files(path, "**/*.json"):
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

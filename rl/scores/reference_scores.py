"""Reference scores: those of a release, and the results of baselines robot by robot."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import msgspec
import numpy as np

from morphgen.benchmark.difficulty import BaselineResult, BaselineResults
from morphgen.benchmark.release_file import SCORES_FILE, SUBMISSIONS_DIR
from morphgen.benchmark.split import Split, split_id
from morphgen.errors import BenchmarkError, nearest
from morphgen.grammar.library import Library
from morphgen.rl.baselines import BASELINES
from morphgen.rl.scores.episode_table import EPISODES, name_of, read_submissions, read_table
from morphgen.rl.scores.leaderboard import (
    RandomScores,
    Row,
    random_scores,
    relative_scores,
    score_submission,
)
from morphgen.rl.scores.submission import (
    Submission,
    check_submission,
    read_submission,
    require_comparable,
    require_same_random,
    submission_text,
)
from morphgen.tasks.goals.eval_protocol import EvalProtocol, expected_robots

FORMAT = 2
RANDOM = "random"
"""Method whose episodes all scores of a release are relative to."""


@dataclass(frozen=True, eq=False)
class References:
    """The reference scores of a release."""

    submissions: tuple[Submission, ...] = ()

    @property
    def random(self) -> RandomScores | None:
        """Scores of the random policy, if the release holds a submission of it."""
        baselines = (each for each in self.submissions if _is_baseline(each, RANDOM))
        return next(map(random_scores, baselines), None)

    def rows(self) -> list[Row]:
        """Return the scores of the submissions."""
        return [score_submission(each, self.random, "reference") for each in self.submissions]

    def results(self) -> BaselineResults:
        """Return the results of the baselines, in the order of ``BASELINES``."""
        return _baseline_results(self.submissions, self.random)


def collect_references(
    paths: Sequence[Path],
    split: Split,
    protocol: EvalProtocol,
    library: Library,
    *,
    jobs: int = 1,
) -> References:
    """Read the reference scores of a new release from submissions and studies, and check them."""
    submissions: dict[str, Submission] = {}
    expected = None
    for path in paths:
        before = len(submissions)
        for where, each in read_submissions([path]).items():
            if each.split.id != split_id(split) and where != str(path):
                continue
            expected = expected or expected_robots(split, protocol, library, jobs=jobs)
            check_submission(each, where, split, protocol, expected, version("morphgen"))
            if _is_baseline(each, RANDOM) and len(each.robots) < len(expected):
                raise BenchmarkError(
                    f"{where}: {RANDOM}: the train robots are missing, to whose episodes the "
                    "scores of other submissions are relative; evaluate it on both sides"
                )
            submission = msgspec.structs.replace(each, config=None)
            if submissions.setdefault(_path(submission), submission) != submission:
                raise BenchmarkError(f"{where}: another submission of {each.method} is there")
        if len(submissions) == before:
            raise BenchmarkError(f"{path}: no scores of split {split.name}, id {split_id(split)}")
    # Sorted, so that the order of the paths does not change the files.
    references = References(tuple(submissions[name] for name in sorted(submissions)))
    if references.random is None:
        require_same_random([*submissions.items()])
    return references


def reference_files(references: References) -> dict[str, bytes]:
    """Return the files of a release with reference scores, by path."""
    files = {_path(each): submission_text(each).encode() for each in references.submissions}
    data = {"format": FORMAT, "rows": msgspec.to_builtins(references.rows())}
    return files | {SCORES_FILE: (json.dumps(data, indent=2) + "\n").encode()}


def read_references(folder: Path) -> References:
    """Read the reference scores of a release; they were checked when it was made."""
    files = sorted((folder / SUBMISSIONS_DIR).glob("*.json"))
    return References(tuple(read_submission(file) for file in files))


def _is_baseline(submission: Submission, *names: str) -> bool:
    """Return whether a submission is of a baseline, not of a policy with its name."""
    is_trained = submission.mode != "" or submission.training_seed is not None
    return submission.method in names and not is_trained


def _path(submission: Submission) -> str:
    """Return the path in a release: a file name of letters, digits and a few signs."""
    words = [submission.method]
    if submission.mode == "stochastic":
        words.append(submission.mode)
    if submission.finetuned:
        words.append(f"fine-tuned-{submission.finetuned}")
    if submission.training_seed is not None:
        words.append(f"seed{submission.training_seed}")
    return f"{SUBMISSIONS_DIR}/{re.sub(r'[^A-Za-z0-9+_-]', '_', '-'.join(words))}.json"


def _baseline_results(
    submissions: Sequence[Submission], random: RandomScores | None
) -> BaselineResults:
    own = {name: each for name in BASELINES for each in submissions if _is_baseline(each, name)}
    return {
        name: {
            (robot.side, robot.robot): BaselineResult(
                float(np.mean(relative_scores(robot, random))), float(np.mean(robot.success))
            )
            for robot in submission.robots
        }
        for name, submission in own.items()
    }


def study_results(folder: Path, split: Split) -> BaselineResults:
    """Return the results of the baselines of a study, in the order of ``BASELINES``."""
    table = folder / EPISODES
    if not table.is_file():
        raise BenchmarkError(
            f"{folder}: no {EPISODES}; expected the output folder of morphgen study"
        )
    baselines = [each for each in read_table(table) if _is_baseline(each, *BASELINES)]
    own = {f"{table}: {name_of(each)}": each for each in baselines if each.split.name == split.name}
    if not own:
        others = {each.split.name for each in baselines}
        raise BenchmarkError(
            f"{folder}: no episodes of baselines on split {split.name!r}"
            f"{nearest(split.name, others)}"
        )
    require_comparable(own)
    for where, each in own.items():
        if each.split.id != split_id(split):
            raise BenchmarkError(
                f"{where}: of other robots: split id {each.split.id}; expected {split_id(split)}, "
                f"that of {split.name}; name a study of these robots"
            )
    return _baseline_results(list(own.values()), None)

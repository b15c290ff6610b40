"""A submission: the outcome of every episode of one policy on a split, as JSON.

Scores are not part of it: ``morphgen.rl.leaderboard`` computes them from the episodes. Lists of a
robot have an entry per episode, in the order of the evaluation, which the seed determines.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

from morphgen.benchmark.split import Side, Split, split_id
from morphgen.errors import BenchmarkError, FormatError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import write_file
from morphgen.formats.records import FiniteNumber, Record, read_record
from morphgen.rl.rollouts import Episode
from morphgen.tasks.task import EnvSpec

FORMAT = 1
KIND = "morphgen submission"
Name = Annotated[str, Meta(min_length=1, max_length=200)]
Count = Annotated[int, Meta(ge=0, le=1_000_000_000)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]


class SplitName(Record, frozen=True):
    """The split that a submission is for."""

    name: Name
    id: Name
    """Id of the split, see ``morphgen.benchmark.split.split_id``."""


class RobotOutcomes(Record, frozen=True):
    """The episodes of one robot."""

    robot: Name
    side: Side
    task: Name
    body: Name
    """Hash of the robot in the split."""
    goal_set: Name
    """Key of the robot's goal set: a hash of all that goals and starts follow from."""
    success: tuple[bool, ...]
    score: tuple[FiniteNumber, ...]
    """Score of each episode, not relative to the random policy."""
    distance: tuple[FiniteNumber, ...]
    """Distance from success at the end of each episode [m]."""
    steps: tuple[Count, ...]
    """Length of each episode [control steps]."""
    diverged: tuple[bool, ...]
    """Whether each episode ended because the simulation diverged."""
    random_score: tuple[FiniteNumber, ...]
    """Score of each episode of the random policy with the same starts and goals."""
    random_success: tuple[bool, ...]


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
    method: Name
    """Name of the method in rankings."""
    mode: Literal["", "deterministic", "stochastic"]
    """How the policy acts; empty for a baseline."""
    training_seed: Seed | None
    """Seed of the training; None for a baseline."""
    morphgen: Name
    """Version of morphgen that ran the episodes."""
    split: SplitName
    evaluation: dict[str, Any]
    """Rules of the evaluation, see ``morphgen.tasks.eval_protocol``."""
    robots: tuple[RobotOutcomes, ...]
    training: Training | None = None
    """How the policy was trained, if it is known."""

    @property
    def finetuned(self) -> int:
        """Transitions of fine-tuning on the test robots."""
        return self.training.finetuned if self.training else 0

    def __post_init__(self) -> None:
        if self.format != FORMAT:
            raise ValueError(f"format {self.format}; this version reads {FORMAT}")
        if not self.method.isprintable():
            raise ValueError(f"method {self.method!r}; expected printable characters")


class SubmissionRecorder:
    """Collects the episodes of an evaluation; an instance is its ``record`` callback."""

    def __init__(self, split: Split) -> None:
        self._split = split
        self.robots: list[RobotOutcomes] = []
        """Outcomes of the robots so far."""

    def __call__(
        self,
        spec: EnvSpec,
        side: Side,
        episodes: Sequence[Episode],
        random_episodes: Sequence[Episode],
    ) -> None:
        """Add a robot."""
        name = spec.robot.name
        member = next(each for each in self._split.side(side) if each.name == name)
        self.robots.append(
            RobotOutcomes(
                robot=name,
                side=side,
                task=spec.task,
                body=member.robot_hash,
                goal_set=spec.goals.key,
                success=tuple(each.success for each in episodes),
                score=tuple(each.score for each in episodes),
                distance=tuple(each.distance for each in episodes),
                steps=tuple(each.steps for each in episodes),
                diverged=tuple(each.unstable for each in episodes),
                random_score=tuple(each.score for each in random_episodes),
                random_success=tuple(each.success for each in random_episodes),
            )
        )

    def submission(
        self,
        method: str,
        mode: str,
        training_seed: int | None,
        evaluation: dict[str, Any],
        training: Training | None = None,
    ) -> Submission:
        """Return the submission of the recorded episodes; for the arguments see ``Submission``.

        Raises:
            BenchmarkError: If the method has no valid name.
        """
        data = {
            "kind": KIND,
            "format": FORMAT,
            "method": method,
            "mode": mode,
            "training_seed": training_seed,
            "morphgen": version("morphgen"),
            "split": {"name": self._split.name, "id": split_id(self._split)},
            "evaluation": evaluation,
            "training": msgspec.to_builtins(training),
            "robots": msgspec.to_builtins(self.robots),
        }
        return read_record(data, Submission, "submission", BenchmarkError)


def submission_text(submission: Submission) -> str:
    """Return the text of a submission: a line per list of a robot."""
    data = msgspec.to_builtins(submission)
    robots = data.pop("robots")
    if submission.training is None:
        del data["training"]
    head = json.dumps(data, indent=2).removesuffix("\n}")
    blocks = [
        ",\n".join(f"      {json.dumps(key)}: {json.dumps(value)}" for key, value in robot.items())
        for robot in robots
    ]
    body = ",\n".join(f"    {{\n{block}\n    }}" for block in blocks)
    return f'{head},\n  "robots": [\n{body}\n  ]\n}}\n'


def write_submission(path: Path, submission: Submission) -> None:
    """Write a submission.

    Raises:
        FormatError: If it cannot be written; then nothing is left behind.
    """
    write_file(path, submission_text(submission))


def json_files(path: Path, *patterns: str) -> Iterator[tuple[Path, Any]]:
    """Yield a JSON file with its content, or those of a folder in the order of their paths.

    Args:
        path: The file or folder.
        patterns: Patterns of the files in the folder.

    Raises:
        BenchmarkError: If there is no such file or folder, or a file is no JSON.
    """
    if path.is_dir():
        files = sorted({file for pattern in patterns for file in path.glob(pattern)})
    elif path.is_file():
        files = [path]
    else:
        raise BenchmarkError(f"{path}: no such file or folder")
    for file in files:
        try:
            data = read_json(file)
        except FormatError as error:  # which names the file
            raise BenchmarkError(str(error)) from error
        except OSError as error:
            raise BenchmarkError(f"{file}: cannot be read: {error.strerror}") from error
        yield file, data


def is_submission(data: object) -> bool:
    """Return whether the content of a JSON file claims to be a submission."""
    return isinstance(data, dict) and data.get("kind") == KIND


def read_submission(path: Path) -> Submission:
    """Read a submission and check its form; ``submission_checks`` checks what it claims.

    Raises:
        BenchmarkError: If it is missing or malformed; the message names robot and field.
    """
    try:
        data = read_json(path)
    except FileNotFoundError as error:
        raise BenchmarkError(f"{path}: no such file") from error
    except OSError as error:
        raise BenchmarkError(f"{path}: cannot be read: {error.strerror}") from error
    except FormatError as error:
        raise BenchmarkError(str(error)) from error
    if not is_submission(data):
        raise BenchmarkError(
            f"{path}: no submission; expected an object with the kind {KIND!r}, as morphgen eval "
            "--submission writes it"
        )
    return submission_from(data, path)


def submission_from(data: object, path: Path) -> Submission:
    """Return the submission of a JSON file's content, and check its form.

    Raises:
        BenchmarkError: If it is malformed; the message names file, robot and field.
    """
    return read_record(data, Submission, str(path), BenchmarkError)

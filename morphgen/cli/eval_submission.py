"""``morphgen eval --submission``: rules, recording and file of a submission."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.errors import TaskError

if TYPE_CHECKING:
    from morphgen.rl.evaluation import EvalConfig
    from morphgen.rl.robot_source import RobotSource
    from morphgen.rl.submission import SubmissionRecorder, Training
    from morphgen.tasks.eval_protocol import EvalProtocol


@dataclass(frozen=True, eq=False)
class PlannedSubmission:
    """A submission whose episodes are still to be run."""

    path: Path
    method: str
    mode: str
    training_seed: int | None
    evaluation: dict[str, Any]
    training: Training | None
    record: SubmissionRecorder
    """Callback for the episodes of every robot."""

    def write(self) -> None:
        """Write the submission of the recorded episodes."""
        from morphgen.rl.submission import write_submission

        submission = self.record.submission(
            self.method, self.mode, self.training_seed, self.evaluation, self.training
        )
        write_submission(self.path, submission)


def rules_of(words: Sequence[str]) -> EvalProtocol:
    """Return the rules of the release that ``--split`` names, else the default ones."""
    from morphgen.benchmark.release_file import is_release, read_release
    from morphgen.tasks.eval_protocol import EvalProtocol, protocol_from

    folder = Path(words[0]) if len(words) == 1 else None
    if folder is None or not is_release(folder):
        return EvalProtocol()
    return protocol_from(read_release(folder).evaluation, str(folder))


def plan_submission(
    args: argparse.Namespace,
    source: RobotSource,
    config: EvalConfig,
    *,
    method: str,
    mode: str = "",
    training_seed: int | None = None,
    training: Training | None = None,
) -> PlannedSubmission | None:
    """Return the submission that the arguments ask for, or None.

    Args:
        args: Arguments of ``morphgen eval``.
        source: The robots, any side of a split.
        config: Configuration of the evaluation.
        method: Name of the method unless ``--method`` is given.
        mode: How the policy acts; empty for a baseline.
        training_seed: Seed of the training; None for a baseline.
        training: How the policy was trained, if it is known.

    Raises:
        TaskError: If the robots are not those of a split, or the test side is left out.
        BenchmarkError: If the evaluation does not follow the rules, or the name is invalid.
    """
    from morphgen.formats.files import require_writable_file
    from morphgen.rl.robot_source import split_of
    from morphgen.rl.submission import SubmissionRecorder
    from morphgen.rl.submission_checks import require_rules
    from morphgen.tasks.eval_protocol import EvalProtocol

    if args.submission is None:
        return None
    if not source.split:
        raise TaskError(f"--submission: {source.name} is no split; name one with --split")
    if args.on == "train":
        raise TaskError("--submission: the test robots are needed; leave --on train out")
    require_writable_file(args.submission, "--submission")
    split = split_of(source)
    rules = rules_of(args.words)
    goals = replace(rules.goals, seed=source.goal_seed, tasks=config.tasks)
    followed = EvalProtocol(config.sim, config.episodes, config.seed, goals).as_data(split)
    require_rules(followed, rules.as_data(split), "--submission")
    name = method if args.method is None else args.method
    record = SubmissionRecorder(split)
    # Refuses an invalid name or seed now, not after hours of episodes.
    record.submission(name, mode, training_seed, followed)
    return PlannedSubmission(args.submission, name, mode, training_seed, followed, training, record)

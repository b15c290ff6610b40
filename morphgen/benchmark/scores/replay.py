"""Run random episodes of a submission again, and compare: a hash finds a slip, this a forger."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.benchmark.scores.submission import Submission, protocol_from
from morphgen.errors import BenchmarkError
from morphgen.rl.baselines import BASELINES, Baseline
from morphgen.rl.demonstrations.recording import TOLERANCE
from morphgen.rl.evaluation import EvalConfig, episodes_again
from morphgen.rl.inference import Episode, Mode
from morphgen.rl.runs.checkpoint import Interface, read_checkpoint
from morphgen.rl.runs.robot_source import split_source
from morphgen.rl.runs.training import checkpoint_files
from morphgen.rl.scores import RobotOutcomes
from morphgen.rl.shipped_policies import checkpoint_path, is_named
from morphgen.splits.split import SIDES, Split


@dataclass(frozen=True)
class ReplayedEpisode:
    """An episode of a submission beside the same one in the simulator."""

    robot: RobotOutcomes
    number: int  # number of the episode, from 0
    episode: Episode

    @property
    def agrees(self) -> bool:
        """Whether success and final distance [m] are those of the submission."""
        success, distance = self.robot.success[self.number], self.robot.distance[self.number]
        is_near = abs(self.episode.distance - distance) <= TOLERANCE
        return is_near and self.episode.success == success

    def __str__(self) -> str:
        """Return a line: the episode, and what it gives if that is something else."""
        own = self.robot.success[self.number], self.robot.distance[self.number]
        again = self.episode.success, self.episode.distance
        texts = [f"{'success' if won else 'failure'} at {far:.4f} m" for won, far in (own, again)]
        where = f"{self.robot.side} robot {self.robot.robot}, episode {self.number}"
        verdict = "agrees" if self.agrees else f"DIFFERS: again {texts[1]}"
        return f"{where}: {texts[0]}: {verdict}"


def needs_checkpoint(submission: Submission) -> bool:
    """Return whether a submission's policy is neither a baseline nor one that morphgen ships."""
    return not is_named(submission.method)


def replay_submission(
    submission: Submission,
    where: str,
    split: Split,
    *,
    count: int,
    seed: int,
    checkpoint: Path | None = None,
    library: tuple[Path, ...] = (),
) -> Iterator[ReplayedEpisode]:
    """Run random episodes of a submission again with a checkpoint, or the method of its name."""
    interface = Interface()
    controller: Baseline | tuple[dict[str, Any], Mode]
    if checkpoint is None and not submission.mode:
        controller = BASELINES[submission.method]
    else:
        files = list(checkpoint_files(checkpoint_path(checkpoint or submission.method)))
        if len(files) > 1:
            raise BenchmarkError(
                f"{where}: {checkpoint} has policies of single robots; expected one checkpoint"
            )
        run, learner = read_checkpoint(files[0])
        interface, controller = run.interface, (learner, submission.mode or "deterministic")
    rules = protocol_from(submission.evaluation, where)
    config = EvalConfig(rules.episodes, rules.simulator, rules.seed, 1, tuple(rules.goals.tasks))
    pairs = [(robot, i) for robot in submission.robots for i in range(len(robot.score))]
    rng = np.random.default_rng(seed)
    picked = sorted(rng.choice(len(pairs), min(count, len(pairs)), replace=False).tolist())
    source = split_source(split, goal_seed=rules.goals.seed, library=library)
    for side in SIDES:
        own = [pairs[i] for i in picked if pairs[i][0].side == side]
        if not own:
            continue
        chosen = [(robot.robot, number) for robot, number in own]
        # A batch of one rounds otherwise than that of the evaluation, which a policy may amplify:
        # what differs is judged by the whole evaluation.
        for whole in (False, True):
            again = episodes_again(
                controller, replace(source, side=side), config, interface, chosen, whole=whole
            )
            found = list(map(ReplayedEpisode, *zip(*own, strict=True), again))
            if all(each.agrees for each in found):
                break
        yield from found

"""How well a policy or a reference controller does, robot by robot, beside chance."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.benchmark.split import Side
from morphgen.errors import TaskError, nearest
from morphgen.model.kinematics import reach
from morphgen.rl.intervals import mean_interval
from morphgen.rl.names import REFERENCES
from morphgen.rl.references import Random, reference
from morphgen.rl.rollouts import Controller, Episode, run_episodes
from morphgen.rl.runs import Interface, RunConfig, read_checkpoint
from morphgen.rl.sources import Source, members, other_side, specs_of
from morphgen.rl.trained import Mode, Policy
from morphgen.rl.training import checkpoints
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.env_specs import GoalConfig, default_configs
from morphgen.tasks.make import batch_of
from morphgen.tasks.registry import SIMULATORS, TASKS
from morphgen.tasks.task import EnvSpec, TaskConfig

STEPS = 10_000
"""Control steps of an evaluation, a robot (paper)."""
AT_ONCE = 34
"""Environments of a robot at most: with these, 10,000 steps are one episode in each."""
SALT = 0x5C0_4E5
"""So that an evaluation's episodes are not those of the training with the same seed."""

Acting = Callable[[TaskBatch], Controller]
"""What acts in a batch."""
Tell = Callable[[float, int], None]
"""Told how many episodes are over, parts of them included, and how many there are."""
Count = Callable[[str], Tell]
"""Called with the name of an evaluation that begins; what it returns, with how far it is."""


def silent(done: float, total: int) -> None:
    """Tell nobody."""


def uncounted(name: str) -> Tell:
    """Tell nobody of any evaluation."""
    return silent


@dataclass(frozen=True)
class Exam:
    """How an evaluation is done."""

    episodes: int = 34
    """Of each robot at least; all episodes of a robot count, from their starts to their ends."""
    sim: str = "pybullet"
    seed: int = 0
    workers: int = 1
    tasks: tuple[TaskConfig, ...] = field(default_factory=default_configs)
    """Constants of tasks; others have their defaults."""

    def as_data(self) -> dict[str, Any]:
        """Return plain data for JSON, with the constants of each task under its name."""
        data = asdict(self)
        del data["tasks"]
        return data | GoalConfig(tasks=self.tasks).as_data()

    def __post_init__(self) -> None:
        """Check.

        Raises:
            TaskError: If there is no episode, or the seed is none.
        """
        if self.episodes < 1 or not 0 <= self.seed < 2**63:
            raise TaskError(
                f"{self.episodes} episodes, seed {self.seed}: at least one episode, and a seed "
                "from 0 to 2^63 - 1"
            )


@dataclass(frozen=True)
class Score:
    """A robot's part of an evaluation."""

    robot: str
    side: Side
    task: str
    episodes: int
    steps: int
    score: float
    """``raw``, for some tasks above that of the random policy; see ``Task.relative_to_random``."""
    low: float
    high: float
    """Of the score: 95% bootstrap interval over episodes; nan if there is one episode."""
    raw: float
    """Mean score of episodes; see ``Task.episode_score``."""
    random: float
    """The same of the random controller."""
    success: float
    """Share of the episodes that end in success."""
    random_success: float
    distance: float
    """From success at the end, metres, mean."""
    relative_distance: float
    """The same over the robot's reach; nan for tasks where this means nothing."""
    unstable: int = 0
    """How many episodes ended because their simulation became unstable."""


def episodes_for(steps: int, longest: int) -> int:
    """How many episodes of full length have so many steps.

    Raises:
        TaskError: If there are none.
    """
    if steps < 1:
        raise TaskError(f"--steps {steps}: expected 1 or more")
    return -(-steps // longest)


def evaluate_run(
    path: Path, side: Side, exam: Exam, mode: Mode, *, device: str = "cpu", tell: Tell = silent
) -> list[Score]:
    """Evaluate what was trained on the robots of a side of its split, or on its one robot.

    Args:
        path: A checkpoint, or a run's folder.
        side: Of the split.
        exam: How.
        mode: Whether policies act by the mean of their actions, or draw.
        device: Where the networks are.
        tell: Told how far it is; for ``se`` robot by robot.

    Raises:
        TaskError: If there is no checkpoint, or no such side.
    """
    files = list(checkpoints(path))
    source = other_side(read_checkpoint(files[0])[0].source, side)
    return evaluate_checkpoints(files, source, exam, mode, device=device, tell=tell)


def evaluate_checkpoints(
    paths: Sequence[Path],
    source: Source,
    exam: Exam,
    mode: Mode,
    *,
    device: str = "cpu",
    tell: Tell = silent,
) -> list[Score]:
    """Evaluate the trained policies of a run.

    Policies of single robots, of ``se``, are each evaluated on their own robot, if ``source`` is
    the robots that they were trained on, and all of them on every robot of another, where their
    episodes count alike.

    Raises:
        TaskError: If one is no checkpoint, or for other observations or actions.
        MorphgenError: If a robot or simulator cannot be made.
    """
    trained = [read_checkpoint(path) for path in paths]
    sources = [run.source for run, _ in trained]
    if all(own.only for own in sources) and _of_same(sources[0], source):
        found = (
            _evaluate_together([one], replace(source, only=own.only), exam, mode, device, tell)
            for one, own in zip(trained, sources, strict=True)
        )
        return [score for scores in found for score in scores]
    _require_same_interface(paths, [run for run, _ in trained])
    return _evaluate_together(trained, source, exam, mode, device, tell)


def _require_same_interface(paths: Sequence[Path], runs: Sequence[RunConfig]) -> None:
    """Require that all policies take the same observations and actions.

    Raises:
        TaskError: If one does not; it says in what.
    """
    interfaces = [asdict(run.interface) for run in runs]
    first, *others = [{**each.pop("channels"), **each} for each in interfaces]
    for path, other in zip(paths[1:], others, strict=True):
        wrong = [
            f"{key} {other[key]}, not {first[key]}" for key in first if other[key] != first[key]
        ]
        if wrong:
            raise TaskError(
                f"{path}: its policy is for other observations or actions than that of "
                f"{paths[0]}: {'; '.join(wrong)}; evaluate it on its own"
            )


def _of_same(one: Source, whole: Source) -> bool:
    """Whether a robot is of the robots of a split's side, all of which are meant."""
    if not whole.split or whole.only is not None or one.side != whole.side:
        return False
    return members(replace(one, only=None)) == members(whole)


def _evaluate_together(
    trained: Sequence[tuple[RunConfig, dict[str, Any]]],
    source: Source,
    exam: Exam,
    mode: Mode,
    device: str,
    tell: Tell,
) -> list[Score]:
    """The episodes of all policies count together."""
    acting = [_policy(learner, mode, exam.seed, device) for _, learner in trained]
    wanted = trained[0][0].interface
    return evaluate(acting, source, exam, wanted, tell=tell)


def _policy(learner: dict[str, Any], mode: Mode, seed: int, device: str) -> Acting:
    return lambda batch: Policy(learner, mode, seed, device)


def evaluate_reference(
    name: str, source: Source, exam: Exam, *, tell: Tell = silent
) -> list[Score]:
    """Evaluate a controller that learns nothing; see ``REFERENCES``.

    Its actions are continuous. Robots at a task that it is not for are left out.

    Raises:
        TaskError: If it is unknown, or for none of the robots' tasks.
    """
    if name not in REFERENCES:
        raise TaskError(f"unknown reference {name!r}{nearest(name, REFERENCES)}")

    def acting(batch: TaskBatch) -> Controller:
        return reference(name, batch, exam.seed)

    return evaluate([acting], source, exam, Interface(), tasks=REFERENCES[name], tell=tell)


def evaluate(
    acting: Sequence[Acting],
    source: Source,
    exam: Exam,
    wanted: Interface,
    *,
    tasks: Sequence[str] | None = None,
    tell: Tell = silent,
) -> list[Score]:
    """Scores of the robots of a source, in order; the random controller has the same episodes.

    Args:
        acting: What acts: each in episodes of its own, which all count.
        source: The robots.
        exam: How.
        wanted: What those that act see and do.
        tasks: Robots at other tasks are left out, if tasks are named.
        tell: Told how far those that act are, and not the random controller.

    Raises:
        TaskError: If no robot is left.
        MorphgenError: If a robot or simulator cannot be made.
    """
    specs = specs_of(source, GoalConfig(tasks=exam.tasks))
    if tasks is not None:
        specs = [each for each in specs if each.task in tasks]
        if not specs:
            raise TaskError(f"{source.name}: no robot is there to {' or '.join(tasks)}")
    folders = tuple(map(Path, source.library))
    played: list[list[Episode]] = [[] for _ in specs]
    for i, one in enumerate(acting):
        found = _played(one, specs, exam, wanted, folders, partial(_of, i, len(acting), tell))
        for all_own, own in zip(played, found, strict=True):
            all_own.extend(own)
    chance = _chance(source, exam, None if tasks is None else tuple(tasks), specs, folders)
    return [
        _score(spec, source.side, own, other)
        for spec, own, other in zip(specs, played, chance, strict=True)
    ]


_known: dict[object, list[list[Episode]]] = {}


def _chance(
    source: Source,
    exam: Exam,
    tasks: tuple[str, ...] | None,
    specs: Sequence[EnvSpec],
    folders: tuple[Path, ...],
) -> list[list[Episode]]:
    """Episodes of the random controller; played once in a process."""
    key = (source, replace(exam, workers=1), tasks)
    if key not in _known:
        _known[key] = _played(lambda batch: Random(exam.seed), specs, exam, Interface(), folders)
    return _known[key]


def _played(
    acting: Acting,
    specs: Sequence[EnvSpec],
    exam: Exam,
    wanted: Interface,
    folders: tuple[Path, ...],
    tell: Tell = silent,
) -> list[list[Episode]]:
    """Episodes by robot, in as many batches as it takes; what acts is made for the first."""
    rounds = -(-exam.episodes // AT_ONCE)
    each = -(-exam.episodes // rounds)
    most = max(SIMULATORS[exam.sim].max_envs // len(specs), 1)
    found: list[list[Episode]] = [[] for _ in specs]
    controller: Controller | None = None
    whole = each * rounds * len(specs)
    for begin in range(0, each, most):
        before = begin * rounds * len(specs)
        batch = _batch(range(begin, min(begin + most, each)), specs, exam, wanted, folders)
        try:
            controller = controller or acting(batch)
            now = partial(_in, before, whole, tell)
            for episode in run_episodes(batch, controller, rounds, now):
                found[episode.body].append(episode)
        finally:
            batch.close()
    return found


def _in(before: int, whole: int, tell: Tell, done: float) -> None:
    """Tell of all batches, when so many episodes of one are over."""
    tell(before + done, whole)


def _of(before: int, parts: int, tell: Tell, done: float, own: int) -> None:
    """Tell of all parts, each of as many episodes, when so many are over."""
    tell(before * own + done, parts * own)


def _batch(
    own: range,
    specs: Sequence[EnvSpec],
    exam: Exam,
    wanted: Interface,
    folders: tuple[Path, ...],
) -> TaskBatch:
    """Some of the environments of each robot."""
    return batch_of(
        specs,
        len(own) * len(specs),
        first=own.start * len(specs),
        sim=exam.sim,
        seed=int(np.random.SeedSequence([SALT, exam.seed]).generate_state(1)[0]),
        kind=wanted.kind,
        observe=wanted.channels,
        workers=exam.workers,
        max_links=wanted.max_links,
        library=folders,
    )


def _score(spec: EnvSpec, side: Side, own: Sequence[Episode], chance: Sequence[Episode]) -> Score:
    raw, random = (np.array([each.score for each in found]) for found in (own, chance))
    task = TASKS[spec.task]
    above = raw - np.resize(random, len(raw)) if task.relative_to_random else raw
    interval = mean_interval(above)
    distance = float(np.mean([episode.distance for episode in own]))
    return Score(
        robot=spec.robot.name,
        side=side,
        task=spec.task,
        episodes=len(own),
        steps=sum(episode.steps for episode in own),
        score=interval.value,
        low=interval.low,
        high=interval.high,
        raw=float(raw.mean()),
        random=float(random.mean()),
        success=float(np.mean([episode.success for episode in own])),
        random_success=float(np.mean([episode.success for episode in chance])),
        distance=distance,
        relative_distance=distance / reach(spec.robot) if task.relative_distance else math.nan,
        unstable=sum(episode.unstable for episode in own),
    )


def exam_of(config: RunConfig, episodes: int, *, seed: int = 0, workers: int = 1) -> Exam:
    """An evaluation in the simulator and with the tasks of a run, but for how many goals it had."""
    return Exam(
        episodes,
        config.sim,
        seed,
        workers,
        tuple(each.with_num_goals(type(each)().num_goals) for each in config.tasks),
    )


def as_data(scores: Sequence[Score]) -> list[dict[str, Any]]:
    """Scores for JSON; nothing instead of what is no number."""
    return [
        {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in asdict(each).items()}
        for each in scores
    ]

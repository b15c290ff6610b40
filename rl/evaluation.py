"""Score a policy or a baseline robot by robot, relative to the random policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.benchmark.split import Side
from morphgen.errors import TaskError
from morphgen.model.kinematics import reach
from morphgen.rl.baselines import BASELINES
from morphgen.rl.baselines.simple import Random
from morphgen.rl.inference import Mode, Policy, PolicyController
from morphgen.rl.intervals import mean_interval
from morphgen.rl.robot_source import RobotSource, members, other_side, specs_of
from morphgen.rl.rollouts import Controller, Episode, run_episodes
from morphgen.rl.runs import Interface, RunConfig, read_checkpoint
from morphgen.rl.scores import Score
from morphgen.rl.training import checkpoint_files
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.env_specs import GoalConfig, default_configs
from morphgen.tasks.make import batch_from_specs
from morphgen.tasks.registry import SIMULATORS, TASKS, default_simulator
from morphgen.tasks.task import EnvSpec, TaskConfig

MAX_ENVS_PER_ROBOT = 34
"""Largest number of environments of a robot: 10,000 control steps are one episode in each."""
EVAL_SEED_OFFSET = 0x5C0_4E5
"""Mixed into the seed, so that evaluation episodes differ from training ones with the same seed."""

MakeController = Callable[[], Controller]
"""Builds a controller."""
Progress = Callable[[float, int], None]
"""Callback with the number of episodes done, fractions included, and their total number."""
StartProgress = Callable[[str], Progress]
"""Called with the name of an evaluation when it starts; returns the callback for its progress."""


def no_progress(done: float, total: int) -> None:
    """UpdateMetrics the progress to nobody."""


def no_progress_of(name: str) -> Progress:
    """Return a callback that reports to nobody."""
    return no_progress


@dataclass(frozen=True)
class EvalConfig:
    """Constants of an evaluation."""

    episodes: int = 34
    """Least number of episodes per robot; all episodes count, from start to end."""
    sim: str = field(default_factory=default_simulator)
    """Simulator."""
    seed: int = 0
    """Seed of the episodes."""
    workers: int = 1
    """Number of processes of PyBullet, or threads of MuJoCo; scores do not depend on it."""
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
            TaskError: If the number of episodes or the seed is out of its range.
        """
        if self.episodes < 1 or not 0 <= self.seed < 2**63:
            raise TaskError(
                f"{self.episodes} episodes, seed {self.seed}: expected at least one episode, and a "
                "seed from 0 to 2^63 - 1"
            )


def episodes_for(steps: int, longest: int) -> int:
    """Return how many episodes of full length have so many control steps.

    Raises:
        TaskError: If ``steps`` is below 1.
    """
    if steps < 1:
        raise TaskError(f"--steps {steps}: expected 1 or more")
    return -(-steps // longest)


def evaluate_run(
    path: Path,
    side: Side,
    config: EvalConfig,
    mode: Mode,
    *,
    device: str = "cpu",
    progress: Progress = no_progress,
) -> list[Score]:
    """Evaluate a run on the robots of a side of its split, or on its one robot.

    Args:
        path: A checkpoint, or a run's folder.
        side: Side of the split.
        config: Constants of the evaluation.
        mode: Whether policies act by the mean of their actions, or sample them.
        device: Device of the networks.
        progress: Callback for the progress; for ``se`` robot by robot.

    Raises:
        TaskError: If there is no checkpoint, or no such side.
    """
    files = list(checkpoint_files(path))
    source = other_side(read_checkpoint(files[0])[0].source, side)
    return evaluate_checkpoints(files, source, config, mode, device=device, progress=progress)


def evaluate_checkpoints(
    paths: Sequence[Path],
    source: RobotSource,
    config: EvalConfig,
    mode: Mode,
    *,
    device: str = "cpu",
    progress: Progress = no_progress,
) -> list[Score]:
    """Evaluate the trained policies of a run.

    Policies of single robots (``se``) are each evaluated on their own robot if ``source`` has the
    robots that they were trained on. On other robots all of them are evaluated, and their episodes
    count alike.

    Raises:
        TaskError: If a file is not a checkpoint, or its observations or actions differ from
            those of the first.
        MorphgenError: If a robot or simulator cannot be built.
    """
    trained = [read_checkpoint(path) for path in paths]
    sources = [run.source for run, _ in trained]
    if all(own.member for own in sources) and _of_same(sources[0], source):
        per_robot = (
            _evaluate_together(
                [one], replace(source, member=own.member), config, mode, device, progress
            )
            for one, own in zip(trained, sources, strict=True)
        )
        return [score for scores in per_robot for score in scores]
    _require_same_interface(paths, [run for run, _ in trained])
    return _evaluate_together(trained, source, config, mode, device, progress)


def _require_same_interface(paths: Sequence[Path], runs: Sequence[RunConfig]) -> None:
    """Require that all policies take the same observations and actions.

    Raises:
        TaskError: If one does not; the message lists the differences.
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


def _of_same(one: RobotSource, whole: RobotSource) -> bool:
    """Return whether a single robot belongs to a split's whole side."""
    if not whole.split or whole.member is not None or one.side != whole.side:
        return False
    return members(replace(one, member=None)) == members(whole)


def _evaluate_together(
    trained: Sequence[tuple[RunConfig, dict[str, Any]]],
    source: RobotSource,
    config: EvalConfig,
    mode: Mode,
    device: str,
    progress: Progress,
) -> list[Score]:
    """Evaluate policies on the same robots; their episodes count together."""

    def make(learner: dict[str, Any]) -> Controller:
        return PolicyController(Policy(learner, mode, config.seed, device))

    controllers = [partial(make, learner) for _, learner in trained]
    interface = trained[0][0].interface
    return evaluate(controllers, source, config, interface, progress=progress)


def evaluate_baseline(
    name: str, source: RobotSource, config: EvalConfig, *, progress: Progress = no_progress
) -> list[Score]:
    """Evaluate a baseline with continuous actions; robots whose task it cannot do are left out.

    Raises:
        TaskError: If it is unknown, or can do none of the robots' tasks.
    """
    baseline = BASELINES[name]
    make = partial(baseline.make, config.seed)
    return evaluate([make], source, config, Interface(), tasks=baseline.tasks, progress=progress)


def evaluate(
    controllers: Sequence[MakeController],
    source: RobotSource,
    config: EvalConfig,
    interface: Interface,
    *,
    tasks: Sequence[str] | None = None,
    progress: Progress = no_progress,
) -> list[Score]:
    """Return the scores of the robots of a source, in order.

    The random policy, which scores are relative to, has the same episodes.

    Args:
        controllers: Controllers; each has its own episodes, and the episodes of all count.
        source: The robots.
        config: Constants of the evaluation.
        interface: Actions and observations of the controllers.
        tasks: Tasks to evaluate, robots with others are left out; None for all.
        progress: Callback for the progress of the controllers, without the random policy.

    Raises:
        TaskError: If no robot is left.
        MorphgenError: If a robot or simulator cannot be built.
    """
    specs = specs_of(source, GoalConfig(tasks=config.tasks))
    if tasks is not None:
        specs = [spec for spec in specs if spec.task in tasks]
        if not specs:
            raise TaskError(f"{source.name}: no robot is there to {' or '.join(tasks)}")
    library = tuple(map(Path, source.library))
    episodes: list[list[Episode]] = [[] for _ in specs]
    for i, make in enumerate(controllers):

        def add(done: float, total: int, before: int = i) -> None:
            progress(before * total + done, len(controllers) * total)

        more = _run_all(make, specs, config, interface, library, add)
        for of_robot, more_of_robot in zip(episodes, more, strict=True):
            of_robot.extend(more_of_robot)
    random = _random_episodes(
        source, config, None if tasks is None else tuple(tasks), specs, library
    )
    return [
        _score(spec, source.side, own, other)
        for spec, own, other in zip(specs, episodes, random, strict=True)
    ]


_random_cache: dict[object, list[list[Episode]]] = {}


def _random_episodes(
    source: RobotSource,
    config: EvalConfig,
    tasks: tuple[str, ...] | None,
    specs: Sequence[EnvSpec],
    library: tuple[Path, ...],
) -> list[list[Episode]]:
    """Return the episodes of the random policy by robot; they are run once per process."""
    key = (source, replace(config, workers=1), tasks)
    if key not in _random_cache:
        _random_cache[key] = _run_all(
            partial(Random, config.seed), specs, config, Interface(), library
        )
    return _random_cache[key]


def _run_all(
    make: MakeController,
    specs: Sequence[EnvSpec],
    config: EvalConfig,
    interface: Interface,
    library: tuple[Path, ...],
    progress: Progress = no_progress,
) -> list[list[Episode]]:
    """Return episodes by robot, run in as many batches as needed by one controller."""
    rounds = -(-config.episodes // MAX_ENVS_PER_ROBOT)
    envs_per_robot = -(-config.episodes // rounds)
    at_once = max(SIMULATORS[config.sim].max_envs // len(specs), 1)
    episodes: list[list[Episode]] = [[] for _ in specs]
    controller: Controller | None = None
    total = envs_per_robot * rounds * len(specs)
    for begin in range(0, envs_per_robot, at_once):
        envs = range(begin, min(begin + at_once, envs_per_robot))
        batch = _batch(envs, specs, config, interface, library)

        def add(done: float, before: int = begin * rounds * len(specs)) -> None:
            progress(before + done, total)

        try:
            controller = controller or make()
            for episode in run_episodes(batch, controller, rounds, add):
                episodes[episode.robot_index].append(episode)
        finally:
            batch.close()
    return episodes


def _batch(
    envs: range,
    specs: Sequence[EnvSpec],
    config: EvalConfig,
    interface: Interface,
    library: tuple[Path, ...],
) -> TaskBatch:
    """Build some of the environments of each robot; ``envs`` counts them per robot."""
    return batch_from_specs(
        specs,
        len(envs) * len(specs),
        first=envs.start * len(specs),
        sim=config.sim,
        seed=int(np.random.SeedSequence([EVAL_SEED_OFFSET, config.seed]).generate_state(1)[0]),
        kind=interface.kind,
        observe=interface.channels,
        workers=config.workers,
        max_links=interface.max_links,
        library=library,
    )


def _score(spec: EnvSpec, side: Side, own: Sequence[Episode], random: Sequence[Episode]) -> Score:
    raw, random_raw = (np.array([each.score for each in episodes]) for episodes in (own, random))
    task = TASKS[spec.task]
    relative = raw - np.resize(random_raw, len(raw)) if task.relative_to_random else raw
    interval = mean_interval(relative)
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
        random=float(random_raw.mean()),
        success=float(np.mean([episode.success for episode in own])),
        random_success=float(np.mean([episode.success for episode in random])),
        distance=distance,
        relative_distance=distance / reach(spec.robot) if task.relative_distance else math.nan,
        unstable=sum(episode.unstable for episode in own),
    )


def eval_config_of(
    config: RunConfig, episodes: int, *, seed: int = 0, workers: int = 1
) -> EvalConfig:
    """Return an evaluation in the simulator and tasks of a run, with as many goals as usual."""
    return EvalConfig(
        episodes,
        config.sim,
        seed,
        workers,
        tuple(replace(each, num_goals=type(each)().num_goals) for each in config.tasks),
    )

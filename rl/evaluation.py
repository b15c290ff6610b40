"""Score a policy or a baseline robot by robot; a shipped policy beside controllers, zero-shot."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import closing
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from morphgen.errors import MAX_WHOLE, TaskError
from morphgen.model.kinematics import reach_from_root
from morphgen.progress import part_of, show_progress, stage
from morphgen.rl.baselines import BASELINES, ZERO, Controller, baselines_for
from morphgen.rl.baselines.reach import Random
from morphgen.rl.config import differences
from morphgen.rl.inference import Episode, Mode, Policy, PolicyController, run_episodes
from morphgen.rl.runs.checkpoint import Interface, RunConfig, read_checkpoint
from morphgen.rl.runs.robot_source import (
    OneRobot,
    Source,
    SplitSource,
    members,
    other_side,
    side_of,
    specs_of,
    tasks_of,
)
from morphgen.rl.runs.training import checkpoint_files
from morphgen.rl.scores import LISTS, RobotOutcomes, Score, finite_or_none, score_of, success_of
from morphgen.rl.shipped_policies import name_of
from morphgen.splits.split import Side
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, evaluation_simulator
from morphgen.tasks.scenes.env_specs import GoalConfig, default_configs
from morphgen.tasks.scenes.make import batch_from_specs
from morphgen.tasks.task import EnvSpec, TaskConfig

MAX_ENVS_PER_ROBOT = 34
"""Largest number of environments of a robot: 10,000 control steps are one episode in each."""
EVAL_SEED_OFFSET = 0x5C0_4E5
"""Mixed into the seed, so that evaluation episodes differ from training ones with the same seed."""

MakeController = Callable[[], Controller]  # function that returns a new controller


@dataclass(frozen=True)
class EvalConfig:
    """Configuration of an evaluation."""

    episodes: int = 34  # minimum number of complete episodes per robot
    sim: str = DEFAULT_SIMULATOR  # name of the simulator
    seed: int = 0  # seed of the episodes
    workers: int | None = None  # number of MuJoCo threads; scores do not depend on it
    tasks: tuple[TaskConfig, ...] = field(default_factory=default_configs)
    """Configs of tasks; other tasks have their defaults."""

    def __post_init__(self) -> None:
        if self.episodes < 1 or not 0 <= self.seed <= MAX_WHOLE:
            raise TaskError(
                f"{self.episodes} episodes, seed {self.seed}: expected at least one episode, and a "
                "seed from 0 to 2^63 - 1"
            )


def evaluate_run(path: Path, side: Side, config: EvalConfig, mode: Mode) -> list[Score]:
    """Evaluate a run on the robots of a side of its split, or on its one robot."""
    files = list(checkpoint_files(path))
    source = other_side(read_checkpoint(files[0])[0].source, side)
    return evaluate_checkpoints(files, source, config, mode)


def evaluate_checkpoints(
    paths: Sequence[Path], source: Source, config: EvalConfig, mode: Mode, *, device: str = "cpu"
) -> list[Score]:
    """Evaluate the trained policies of a run.

    Policies of single robots (``se``) are evaluated on their own robot each if ``source`` has the
    robots that they were trained on. On other robots all of them are evaluated, and the scores are
    means over the episodes of all policies.
    """
    trained = [read_checkpoint(path) for path in paths]

    def make(learner: dict[str, Any]) -> Controller:
        return PolicyController(Policy(learner, mode, config.seed, device))

    controllers = [partial(make, learner) for _, learner in trained]
    runs = [run for run, _ in trained]
    robots = [_trained_robot(run.source, source) for run in runs]
    if all(robots):
        scores: list[Score] = []
        for run, robot, controller in zip(runs, robots, controllers, strict=True):
            scores += evaluate([controller], robot or source, config, run.interface)
        return scores
    _require_same_interface(paths, runs)
    return evaluate(controllers, source, config, runs[0].interface)


def require_trained_tasks(run: RunConfig, sources: Iterable[Source], name: str) -> None:
    """Require that a policy was trained on all tasks of robots."""
    trained = tasks_of(run.source)
    for task in (task for source in sources for task in tasks_of(source)):
        if task not in trained:
            raise TaskError(f"policy {name} was trained on {' and '.join(trained)}, not on {task}")


def _require_same_interface(paths: Sequence[Path], runs: Sequence[RunConfig]) -> None:
    """Require that all policies take the same observations and actions."""
    interfaces = [asdict(run.interface) for run in runs]
    first, *others = [{**entries.pop("observe"), **entries} for entries in interfaces]
    for path, other in zip(paths[1:], others, strict=True):
        if wrong := differences(other, first, ", not "):
            raise TaskError(
                f"{path}: its policy is for other observations or actions than that of "
                f"{paths[0]}: {wrong}; evaluate it on its own"
            )


def _trained_robot(trained: Source, source: Source) -> SplitSource | None:
    """Return the robot of a side of a split that alone was trained on; None if there is none."""
    if not (isinstance(trained, SplitSource) and isinstance(source, SplitSource)):
        return None
    if trained.member is None or source.member is not None or trained.side != source.side:
        return None
    is_same = members(replace(trained, member=None)) == members(source)
    return replace(source, member=trained.member) if is_same else None


def evaluate_baseline(name: str, source: Source, config: EvalConfig) -> list[Score]:
    """Evaluate a baseline with continuous actions; robots whose task it cannot do are left out."""
    baseline = BASELINES[name]
    make = partial(baseline.make, config.seed)
    return evaluate([make], source, config, Interface(), tasks=baseline.tasks)


def evaluate(
    controllers: Sequence[MakeController],
    source: Source,
    config: EvalConfig,
    interface: Interface,
    *,
    tasks: tuple[str, ...] | None = None,
) -> list[Score]:
    """Return the scores of the robots of a source, in order.

    Scores may be relative to the random policy; its episodes have the same starts and goals.
    """
    specs = _specs(source, config, tasks)
    if not specs and tasks is not None:
        raise TaskError(f"{source.name}: no robot is there to {' or '.join(tasks)}")
    library = tuple(map(Path, source.library))
    episodes: list[list[Episode]] = [[] for _ in specs]
    total = math.prod(_rounds(config)) * len(specs)
    for i, make in enumerate(controllers):
        with part_of(len(controllers) * total, i * total):
            new_episodes = run_all(make, specs, config, interface, library)
        for robot_episodes, new in zip(episodes, new_episodes, strict=True):
            robot_episodes.extend(new)
    random_episodes = _random_episodes(source, replace(config, workers=1), tasks)
    hashes = {member.name: member.robot_hash for member in members(source)}
    of_one = source.robot_hash if isinstance(source, OneRobot) else ""
    scores = []
    for spec, own, of_random in zip(specs, episodes, random_episodes, strict=True):
        outcomes = RobotOutcomes(
            robot=spec.robot.name,
            side=side_of(source),
            task=spec.task,
            body=hashes.get(spec.robot.name, of_one),
            goal_set=spec.goals.key,
            **{name: tuple(getattr(each, name) for each in own) for name in LISTS},
            random_score=tuple(each.score for each in of_random),
            random_success=tuple(each.success for each in of_random),
        )
        scores.append(score_of(outcomes, [each.angle for each in own], reach_from_root(spec.robot)))
    return scores


@show_progress(None)  # goal sets are not episodes
def _specs(source: Source, config: EvalConfig, tasks: tuple[str, ...] | None) -> list[EnvSpec]:
    specs = specs_of(source, GoalConfig(tasks=config.tasks))
    return [spec for spec in specs if tasks is None or spec.task in tasks]


@lru_cache(maxsize=64)
@show_progress(None)
def _random_episodes(
    source: Source, config: EvalConfig, tasks: tuple[str, ...] | None
) -> list[list[Episode]]:
    """Return the episodes of the random policy by robot; memoised, for all modes of a policy."""
    make, library = partial(Random, config.seed), tuple(map(Path, source.library))
    return run_all(make, _specs(source, config, tasks), config, Interface(), library)


def _rounds(config: EvalConfig) -> tuple[int, int]:
    """Return the number of episodes in each environment, and of environments of a robot."""
    rounds = -(-config.episodes // MAX_ENVS_PER_ROBOT)
    return rounds, -(-config.episodes // rounds)


def run_all(
    make: MakeController,
    specs: Sequence[EnvSpec],
    config: EvalConfig,
    interface: Interface,
    library: tuple[Path, ...],
) -> list[list[Episode]]:
    """Return episodes by robot, from as many batches as the simulator's limit makes necessary."""
    rounds, envs_per_robot = _rounds(config)
    make_batch = _make_batch(specs, config, interface, library)
    batch_envs = max(SIMULATORS[config.sim].max_envs // len(specs), 1)  # per robot
    episodes: list[list[Episode]] = [[] for _ in specs]
    controller: Controller | None = None
    total = envs_per_robot * rounds * len(specs)
    for first in range(0, envs_per_robot, batch_envs):
        num_envs = min(batch_envs, envs_per_robot - first) * len(specs)
        batch = make_batch(num_envs, first=first * len(specs))
        with closing(batch), part_of(total, first * rounds * len(specs)):
            controller = controller or make()
            for episode in run_episodes(batch, controller, rounds):
                episodes[episode.robot_index].append(episode)
    return episodes


def _make_batch(
    specs: Sequence[EnvSpec], config: EvalConfig, interface: Interface, library: tuple[Path, ...]
) -> Callable[..., TaskBatch]:
    """Return ``batch_from_specs`` for an evaluation; it takes ``num_envs`` and ``first``."""
    return partial(
        batch_from_specs,
        specs,
        sim=config.sim,
        seed=int(np.random.SeedSequence([EVAL_SEED_OFFSET, config.seed]).generate_state(1)[0]),
        workers=config.workers,
        layouts="eval",
        device=SIMULATORS[config.sim].devices[0],
        library=library,
        **vars(interface),
    )


def episodes_alone(
    controller: Controller,
    interface: Interface,
    source: Source,
    config: EvalConfig,
    chosen: Sequence[tuple[str, int]],
    *,
    tasks: tuple[str, ...] | None = None,
) -> list[Episode]:
    """Run episodes of an evaluation again, by the robot's name and their number, each in a batch.

    They are those of ``evaluate`` up to rounding, which depends on the size of a batch, if an
    action depends on the state of its environment alone.
    """
    specs, (rounds, _) = _specs(source, config, tasks), _rounds(config)
    robots = {spec.robot.name: i for i, spec in enumerate(specs)}
    make_batch = _make_batch(specs, config, interface, tuple(map(Path, source.library)))
    episodes = []
    for i, (robot, number) in enumerate(chosen):
        env, earlier = divmod(number, rounds)
        batch = make_batch(1, first=env * len(specs) + robots[robot])
        with closing(batch), part_of(len(chosen), i):
            episodes.append(run_episodes(batch, controller, earlier + 1)[-1])
    return episodes


def eval_config_of(
    config: RunConfig, episodes: int, *, seed: int = 0, workers: int | None = None
) -> EvalConfig:
    """Return the config to evaluate a run in its tasks, and its simulator if that has contacts."""
    sim = evaluation_simulator(config.sim)
    return EvalConfig(episodes, sim, seed, workers, config.evaluation_tasks)


def zero_shot(source: OneRobot, policy: Path, config: EvalConfig) -> dict[str, Score]:
    """Run a policy on a robot, and the controllers that do not learn, but for zero actions.

    All of them have the same starts and goals. The scores are by name of the controller.
    """
    name = name_of(policy)
    require_trained_tasks(read_checkpoint(policy)[0], [source], name)
    with stage(name):
        scores = {name: evaluate_checkpoints([policy], source, config, "deterministic")[0]}
    for baseline in baselines_for(source.task):
        if baseline != ZERO.name:
            with stage(baseline):
                (scores[baseline],) = evaluate_baseline(baseline, source, config)
    return scores


def zero_shot_data(scores: Mapping[str, Score]) -> list[dict[str, Any]]:
    """Return the scores of ``zero_shot`` as JSON values, with null instead of nan."""
    return [
        {
            "controller": name,
            "episodes": score.episodes,
            "success": asdict(success_of([score])),
            **{key: finite_or_none(getattr(score, key)) for key in ("distance", "angle", "score")},
        }
        for name, score in scores.items()
    ]

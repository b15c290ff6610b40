"""Train runs: create the run's folder, learn, and write metrics and checkpoints to resume from."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Self

import numpy as np

from morphgen.encoding.tokens import require_max_links
from morphgen.errors import FormatError, MissingDependencyError, TaskError, nearest
from morphgen.files import write_atomic
from morphgen.formats.data_files import parse_json, read_text
from morphgen.formats.files import locked_folder, naming
from morphgen.formats.records import read_record
from morphgen.processes import one_torch_thread
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import PPOConfig, differences, policy_from
from morphgen.rl.demonstrations.cloning import Cloner, DemonstrationBatches
from morphgen.rl.observation_layout import Layout, require_layout
from morphgen.rl.ppo import FINETUNING_ACTOR_LR_SCALE, Learner, UpdateMetrics
from morphgen.rl.runs.checkpoint import (
    CHECKPOINT,
    RunConfig,
    in_main_memory,
    open_run,
    read_checkpoint,
    read_config,
    require_open,
    write_checkpoint,
)
from morphgen.rl.runs.robot_source import (
    GrammarSource,
    RecordedSource,
    Source,
    SplitSource,
    draw,
    members,
    num_actuated,
    num_drawn,
    require_links,
    specs_of,
    write_drawn,
)
from morphgen.rl.scores import finite_or_none
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.registry import batch_device, require_device
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.scenes.make import batch_from_specs

NETWORKS = ("actor", "critic", "target_critic")
"""Networks of a learner, by their names in its state."""


def state_of(learner: Learner) -> dict[str, Any]:
    """Return the state of training; ``torch.load`` reads it with ``weights_only``.

    The learner does not change. The state of the simulator is not part of it: a resumed run begins
    new episodes, and equals one that continued only if that one calls ``restart_episodes`` when the
    state is saved.
    """
    states = {name: getattr(learner, name).state_dict() for name in (*NETWORKS, "optimiser")}
    states["batch"] = learner.batch.state_dict()
    return {
        **{name: in_main_memory(state) for name, state in states.items()},
        # The first axis is that of processes, of which runs had several.
        "generators": {name: each.get_state()[None] for name, each in learner.generators.items()},
        "actor_lr_scale": learner.actor_lr_scale,
        "update": learner.update,
        "updates": learner.num_updates,
        "device": learner.device.type,
        "layout": learner.layout.as_data(),
        "policy": asdict(learner.policy),
        "config": asdict(learner.config),
    }


def resume_learner(learner: Learner, state: Mapping[str, Any]) -> None:
    """Continue where a learner of the same batch, configuration and device stopped.

    All environments begin new episodes.
    """
    _require_networks(learner, state)
    ours = {
        **asdict(learner.config),
        "updates": learner.num_updates,
        "device": learner.device.type,
        "processes": 1,
    }
    processes = len(state["generators"]["actions"])
    stored = {**asdict(PPOConfig(**state["config"])), "processes": processes}
    _require_same(stored | {name: state[name] for name in ("updates", "device")}, ours)
    learner.batch.load_state_dict(state["batch"])
    for name in NETWORKS:
        getattr(learner, name).load_state_dict(state[name])
    learner.optimiser.load_state_dict(state["optimiser"])
    for name, generator in learner.generators.items():
        generator.set_state(state["generators"][name][0].cpu())
    learner.update, learner.actor_lr_scale = state["update"], state["actor_lr_scale"]
    learner.restart_episodes()


def load_networks(learner: Learner, state: Mapping[str, Any]) -> None:
    """Load the networks of a learner's state and nothing else of it, to fine-tune them.

    With a ``desired_kl``, the actor's learning rate begins at ``FINETUNING_ACTOR_LR_SCALE``.
    """
    _require_networks(learner, state)
    for name in NETWORKS:
        getattr(learner, name).load_state_dict(state[name])
    if learner.config.desired_kl:
        learner.actor_lr_scale = FINETUNING_ACTOR_LR_SCALE


def _require_networks(learner: Learner, state: Mapping[str, Any]) -> None:
    layout = read_record(state["layout"], Layout, "the checkpoint: layout", TaskError)
    require_layout(layout, learner.layout, "the checkpoint")
    _require_same(asdict(policy_from(state["policy"])), asdict(learner.policy))


def _require_same(stored: Mapping[str, Any], ours: Mapping[str, Any]) -> None:
    if wrong := differences(stored, ours, ", here "):
        raise TaskError(f"the checkpoint is of another run: {wrong}")


SLICE_STEPS = 600
"""Time that a slice of the robots is trained on [control steps per environment]: two
episodes. A new slice cuts running episodes short, and building its environments takes time."""


def default_slice_updates(config: RunConfig) -> int:
    """Return ``RunConfig.slice_updates`` of a new run: 0 if all drawn robots fit at once.

    In a short run it is lower than ``SLICE_STEPS``, so that every robot is trained on.
    """
    slices = num_slices(config)
    if slices <= 1:
        return 0
    return max(min(-(-SLICE_STEPS // config.ppo.num_steps), config.num_updates // slices), 1)


def num_slices(config: RunConfig) -> int:
    """Return the number of slices with which every drawn robot has been trained on."""
    return -(-num_drawn(config.source) // config.num_envs)


def slice_of(num_robots: int, size: int, number: int, seed: int) -> list[int]:
    """Return the indices of the robots in a slice."""
    first, last = number * size, (number + 1) * size - 1
    passes = range(first // num_robots, last // num_robots + 1)
    order = np.concatenate(
        [np.random.default_rng([seed, i]).permutation(num_robots) for i in passes]
    )
    start = first - passes[0] * num_robots
    robots: list[int] = order[start : start + size].tolist()
    return robots


class TrainingBatches:
    """Makes the batches of a run; batches and their seeds depend on the config only."""

    def __init__(self, config: RunConfig, *, workers: int | None = None) -> None:
        """Build the robots and their goal sets."""
        self._config, self._workers = config, workers
        self._device = batch_device(config.sim, config.device)
        goals = GoalConfig(tasks=config.tasks)
        self._batch: TaskBatch | None = None
        source = config.source
        self.drawn = draw(source, goals) if isinstance(source, GrammarSource) else None
        self._specs = self.drawn.specs if self.drawn else specs_of(source, goals)
        for spec in self._specs:
            links = len(spec.robot.links)
            require_max_links(links, f"robot {spec.robot.name!r}", config.max_links)
        self.most_links = max(len(spec.robot.links) for spec in self._specs)
        self.tasks = {spec.task for spec in self._specs}
        self._channels = config.interface.observe
        if config.slice_updates:
            joints = max(num_actuated(spec.robot, spec.task) for spec in self._specs)
            self._channels = replace(self._channels, tree_joints=joints)

    def make(self, update: int) -> TaskBatch:
        """Close the last batch, and return the one that the run continues with after updates."""
        self.close()
        config, interface = self._config, self._config.interface
        robots, seed = self._robots_at(update), config.seed
        if config.slice_updates:
            seeds = np.random.SeedSequence([config.seed, update // config.slice_updates])
            seed = int(seeds.generate_state(1)[0])
        self._batch = batch_from_specs(
            [self._specs[i] for i in robots],
            config.num_envs,
            sim=config.sim,
            seed=seed,
            kind=interface.kind,
            observe=self._channels,
            workers=self._workers,
            max_links=config.max_links,
            device=self._device,
            library=map(Path, config.source.library),
        )
        return self._batch

    def close(self) -> None:
        """Close the last batch."""
        if self._batch is not None:
            self._batch.close()
        self._batch = None

    def changes_at(self, update: int) -> bool:
        """Return whether a run continues with another batch after so many updates."""
        every = self._config.slice_updates
        return bool(every) and update % every == 0 and update < self._config.num_updates

    def _robots_at(self, update: int) -> list[int]:
        """Return the indices of the robots that are trained on after so many updates."""
        config = self._config
        if not config.slice_updates:
            return list(range(len(self._specs)))
        number = update // config.slice_updates
        return slice_of(len(self._specs), config.num_envs, number, config.seed)


NUM_ENVS = 64  # default number of environments
CONSTANTS: Mapping[str, Any] = {
    "num_steps": 32,
    "minibatches": 4,
    "learning_rate": 3e-4,
    "desired_kl": 0.01,
    "curriculum": False,
}
"""Default hyperparameters that differ from those of the training. A new optimiser has no moments of
the gradient, so that its first steps are large: without a bound of the policy's change they undo
what the training taught (docs/results.md, "Fine-tuning")."""


def finetuning_config(
    initial: RunConfig, source: Source, checkpoint: str, changes: Mapping[str, Any]
) -> RunConfig:
    """Return the config of a run that begins with the networks of another run.

    Agent and hyperparameters are those of the other run, besides ``CONSTANTS`` and ``NUM_ENVS``.
    """
    return replace(
        initial,
        source=source,
        ppo=replace(initial.ppo, **{**CONSTANTS, **changes}),
        num_envs=NUM_ENVS,
        initial_checkpoint=checkpoint,
        slice_updates=0,
    )


MIN_CHECKPOINT_STEPS, MAX_CHECKPOINT_STEPS = 1500, 3000
"""Bounds of the interval between checkpoints [control steps per environment]: 5 and 10 episodes.

A checkpoint has no simulator state, so that it cuts all running episodes short: it must be rare."""
CHECKPOINTS, MIN_CHECKPOINTS = 10, 4
"""Intended number of checkpoints, and the minimum for runs that are short for these bounds."""
ROBOTS = "robots"  # subfolder with a run per robot, in the folder of a run of `se` on a split

ShowMetrics = Callable[[UpdateMetrics, int], None]
"""Callback with the metrics of an update, and the number of updates of the run."""


@dataclass(frozen=True)
class ExecutionConfig:
    """How a run is executed; the weights do not depend on it."""

    workers: int | None = None  # number of MuJoCo threads
    tensorboard: bool = True  # write TensorBoard events
    minutes: int | None = None
    """Time after which training stops with a checkpoint, to be resumed [min]; None for no limit."""

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise TaskError(f"--workers {self.workers}: expected 1 or more")


@dataclass(frozen=True)
class Subrun:
    """A part of a run that trains one set of weights."""

    folder: Path  # folder of the part's config, metrics and checkpoint
    config: RunConfig
    """Config with the part's share of robots, environments, timesteps and its own seed."""


def subruns_of(folder: Path, config: RunConfig) -> list[Subrun]:
    """Return the parts of a run: the run itself, or one per robot for an agent of single robots.

    A part per robot has a seed of its own, and an equal share of the environments and timesteps,
    rounded up.
    """
    per_robot, source = AGENTS[config.policy.agent].per_robot, config.source
    if not per_robot or not isinstance(source, SplitSource) or source.member:
        return [Subrun(folder, config)]
    sources = [replace(source, member=each.name) for each in members(source)]
    share = 1 if config.full_budget else len(sources)
    num_envs = -(-config.num_envs // share)
    ppo = replace(config.ppo, total_timesteps=-(-config.ppo.total_timesteps // share))
    parts = []
    for i, each in enumerate(sources):
        seed = int(np.random.SeedSequence([config.seed, i]).generate_state(1)[0])
        part = replace(config, source=each, ppo=ppo, seed=seed, num_envs=num_envs)
        parts.append(Subrun(folder / ROBOTS / str(each.member), part))
    return parts


def train(
    folder: Path,
    config: RunConfig,
    *,
    resume: bool = False,
    execution: ExecutionConfig | None = None,
    show: Callable[[Subrun], ShowMetrics] | None = None,
    begin: Callable[[], None] | None = None,
    hold: Callable[[Path], AbstractContextManager[None]] = locked_folder,
) -> list[Subrun]:
    """Train all parts of a run to their end; see ``subruns_of``.

    Training may be interrupted or killed at any time. SIGINT, SIGTERM and the end of
    ``ExecutionConfig.minutes`` let the running update end and write a checkpoint; a second signal
    acts at once. A resumed run continues from its last checkpoint. One that was killed ends with
    the same weights as an uninterrupted one; one that was stopped does not, since all its episodes
    begin anew at another update. Nothing is written before all robots and networks are built.

    ``begin`` is called once, when only building robots and networks may still refuse the run.

    Returns the parts, of which the last are unfinished or not begun after ``minutes``.
    """
    execution, parts = execution or ExecutionConfig(), subruns_of(folder, config)
    for part in parts:
        require_runnable(part.config)
    require_open(folder, config, resume=resume)
    unfinished = [part for part in parts if not is_done(part)]
    if unfinished:  # a finished run is evaluated on machines without its GPU
        require_device(config.device)
    with _StopRequest(execution.minutes) as stop, ExitStack() as held, one_torch_thread():
        holds = False
        for part in unfinished:
            if not holds:
                require_links(config.source, config.max_links)
                if begin is not None:
                    begin()
            batches: TrainingBatches | DemonstrationBatches
            if isinstance(config.source, RecordedSource):
                batches = DemonstrationBatches(part.config)
            else:
                batches = TrainingBatches(part.config, workers=execution.workers)
            with _learner(part, batches) as learner:
                if not holds:
                    folder.mkdir(parents=True, exist_ok=True)
                    held.enter_context(hold(folder))
                    open_run(folder, config, resume=resume)
                holds = True
                open_run(part.folder, part.config, resume=True)
                if batches.drawn and isinstance(config.source, GrammarSource):
                    write_drawn(part.folder, config.source, batches.drawn)
                if _learn(learner, batches, part, execution, show, stop):
                    break
    return parts


def require_runnable(config: RunConfig) -> None:
    """Require timesteps for at least one update, and an environment for every robot.

    Drawn robots may have environments one after another;
    see ``RunConfig.slice_updates``.
    """
    source = config.source
    robots = len(members(source)) or num_drawn(source)
    if isinstance(source, GrammarSource) and AGENTS[config.policy.agent].per_robot:
        raise TaskError(
            f"--agent {config.policy.agent}: learns one robot; --robots {source.name} needs "
            "an agent of many"
        )
    if config.num_envs < robots and not config.slice_updates:
        raise TaskError(
            f"--envs {config.num_envs}: fewer than the {robots} robots, each of which has one"
        )
    update_timesteps = config.ppo.num_steps * config.num_envs
    if config.ppo.total_timesteps < update_timesteps:
        member = source.member if isinstance(source, SplitSource) else None
        share = f", the share of {member}" if member else ""
        raise TaskError(
            f"--steps {config.ppo.total_timesteps} with --envs {config.num_envs}{share}: an update "
            f"takes {update_timesteps:,} transitions ({config.ppo.num_steps} steps of every "
            "environment)"
        )
    slices = -(-config.num_updates // config.slice_updates) if config.slice_updates else 1
    if slices < num_slices(config):
        raise TaskError(
            f"--steps {config.ppo.total_timesteps} with --envs {config.num_envs}: only "
            f"{slices * config.num_envs} of {robots} robots would be trained on; use more --steps "
            "or --envs"
        )
    config.ppo.minibatch_size(config.num_envs)


def _runs_beside(path: Path) -> list[str]:
    """Return run folders below the nearest folder above a path that exists and has a name."""
    above = next((each for each in path.parents if each.is_dir()), Path())
    if not above.name:  # the working directory, or the root: too much to search
        return []
    files = [*above.glob(f"*/{CHECKPOINT}"), *above.glob(f"*/*/{CHECKPOINT}")]
    return sorted(str(file.parent) for file in files)


def checkpoint_files(path: Path) -> Iterator[Path]:
    """Yield the checkpoint files of a run."""
    if path.is_file() or (path / CHECKPOINT).is_file():
        yield path if path.is_file() else path / CHECKPOINT
        return
    files = sorted((path / ROBOTS).glob(f"*/{CHECKPOINT}"))
    if not files:
        runs = _runs_beside(path)
        hint = nearest(str(path), runs) if runs else ""
        raise TaskError(f"{path}: no checkpoint, and no folder of a run with one{hint}")
    parts = subruns_of(path, read_config(path))
    missing = [part.folder.name for part in parts if not (part.folder / CHECKPOINT).is_file()]
    if missing:
        raise TaskError(
            f"{path}: {len(missing)} of its {len(parts)} robots have no policy yet, such as "
            f"{missing[0]}; train goes on with --resume"
        )
    yield from files


def is_done(part: Subrun) -> bool:
    """Return whether the checkpoint of a part is its last one."""
    if not (part.folder / CHECKPOINT).is_file():
        return False
    return bool(read_checkpoint(part.folder)[1]["update"] >= part.config.num_updates)


def updates_between(config: RunConfig) -> int:
    """Return the number of updates between two checkpoints of a run."""
    num_steps = config.ppo.num_steps
    interval = config.num_updates * num_steps // CHECKPOINTS
    interval = min(max(interval, MIN_CHECKPOINT_STEPS), MAX_CHECKPOINT_STEPS)
    return max(min(-(-interval // num_steps), config.num_updates // MIN_CHECKPOINTS), 1)


@contextmanager
def _learner(part: Subrun, batches: TrainingBatches | DemonstrationBatches) -> Iterator[Learner]:
    """Build the learner of a part, and resume its checkpoint if there is one."""
    config, state = part.config, None
    if (part.folder / CHECKPOINT).is_file():
        state = read_checkpoint(part.folder)[1]
    make: Callable[..., Learner] = Learner
    if isinstance(batches, DemonstrationBatches):
        make = partial(Cloner, batches)
    with closing(batches):
        learner = make(
            batches.make(state["update"] if state else 0),
            config.policy,
            config.ppo,
            seed=config.seed,
            device=config.device,
            least_links=batches.most_links,
            tasks=batches.tasks,
        )
        if state:
            resume_learner(learner, state)
        elif config.initial_checkpoint:
            initial = (part.folder / config.initial_checkpoint).resolve()
            load_networks(learner, read_checkpoint(initial)[1])
        yield learner


def _learn(
    learner: Learner,
    batches: TrainingBatches | DemonstrationBatches,
    part: Subrun,
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None,
    stop: _StopRequest,
) -> bool:
    """Make the remaining updates of a part; return whether it stopped early."""
    is_stopped = False
    interval = updates_between(part.config)
    report = show(part) if show else None
    with recording(part.folder, learner.update, tensorboard=execution.tensorboard) as record:
        stop.start_clock()
        while not learner.done and not is_stopped:
            metrics = learner.iterate()
            if batches.drawn:  # thousands would fill the records
                metrics = replace(metrics, scores=())
            record(metrics)
            if batches.changes_at(learner.update):
                learner.use(batches.make(learner.update))
            # A checkpoint has the state of the batch that the run continues with.
            left = learner.num_updates - learner.update
            is_stopped = stop.is_requested and left > 0
            is_due = learner.update % interval == 0 and left >= interval
            if not left or is_due or is_stopped:
                write_checkpoint(part.folder, part.config, state_of(learner))
                # A resumed run begins new episodes here, and must end with the same weights.
                learner.restart_episodes()
            if report:
                report(metrics, learner.num_updates)
    return is_stopped


class _StopRequest:
    """Asks training to stop after the running update: by a signal, or because its time is over.

    In this block the first SIGINT or SIGTERM waits for the end of the update, and acts at the end
    of the block; the next one acts at once.
    """

    def __init__(self, minutes: int | None) -> None:
        self._minutes, self._end = minutes, math.inf
        self._received: list[int] = []
        self._handlers: dict[int, Any] = {}

    def start_clock(self) -> None:
        """Begin to count the minutes, once: robots and networks that are built do not count."""
        if self._minutes is not None and math.isinf(self._end):
            self._end = time.monotonic() + 60 * self._minutes

    @property
    def is_requested(self) -> bool:
        return bool(self._received) or time.monotonic() >= self._end

    def __enter__(self) -> Self:
        # Python sets handlers in the main thread only; a study's Ray tasks may run in another.
        if threading.current_thread() is threading.main_thread():
            handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
            # Workers ignore Ctrl-C; handlers of other languages are unknown, and stay.
            self._handlers = {
                n: handler
                for n, handler in handlers.items()
                if handler not in (None, signal.SIG_IGN)
            }
            for number in self._handlers:
                signal.signal(number, self._note)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._restore()
        if self._received and kind is None:
            signal.raise_signal(self._received[0])

    def _note(self, number: int, _: object) -> None:
        self._received.append(number)
        self._restore()

    def _restore(self) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers = {}


METRICS, EVENTS = "metrics.jsonl", "events"

Recorder = Callable[[UpdateMetrics], None]  # function that records the metrics of an update


def read_metrics(folder: Path) -> list[dict[str, Any]]:
    """Return the recorded metrics of a run, a dictionary per update, oldest first.

    An unfinished last line of a killed run is ignored.
    """
    path = folder / METRICS
    if not path.is_file():
        return []
    lines = read_text(path).split("\n")[:-1]
    reports = []
    for number, line in enumerate(lines, 1):
        try:
            report = parse_json(line, f"{path}:{number}")
            report["update"], report["transitions"], report["score"]
        except (FormatError, KeyError, TypeError) as error:
            raise FormatError(f"{path}, line {number}: not the report of an update") from error
        reports.append(report)
    return reports


@contextmanager
def recording(folder: Path, update: int, *, tensorboard: bool) -> Iterator[Recorder]:
    """Yield the recorder of a run that continues after an update; it is closed at the end.

    It writes a line per update, with null for numbers not finite; lines of later updates, which a
    killed run has written, are removed.
    """
    kept = [report for report in read_metrics(folder) if report["update"] <= update]
    path = folder / METRICS
    write_atomic(path, "".join(json.dumps(report) + "\n" for report in kept))
    with ExitStack() as stack:
        file = stack.enter_context(path.open("a", encoding="utf-8"))
        writer = None
        if tensorboard:
            writer = stack.enter_context(closing(_summary_writer(folder, update)))

        def record(report: UpdateMetrics) -> None:
            with naming(path):
                file.write(json.dumps(finite_or_none(asdict(report))) + "\n")
                file.flush()  # a killed run keeps its lines
            if writer is not None:
                for name, value in _scalars(report):
                    writer.add_scalar(name, value, report.update)

        yield record


def _summary_writer(folder: Path, update: int) -> Any:  # noqa: ANN401
    """Return the writer of events for TensorBoard; those of later updates are hidden."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError as error:
        raise MissingDependencyError(
            "TensorBoard is not installed: pip install tensorboard, or say --no-tensorboard"
        ) from error
    return SummaryWriter(str(folder / EVENTS), purge_step=update + 1)


def _scalars(report: UpdateMetrics) -> Iterator[tuple[str, float]]:
    """Yield names and values of a report's numbers; those of robots and terms as ``name/key``."""
    for name, value in asdict(report).items():
        if isinstance(value, Mapping):
            yield from ((f"{name}/{key}", float(each)) for key, each in value.items())
        elif isinstance(value, tuple):
            yield from ((f"{name}/{i}", float(each)) for i, each in enumerate(value))
        elif math.isfinite(value):
            yield name, float(value)

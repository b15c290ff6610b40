"""Train runs: create the run's folder, learn, and write the checkpoints to resume from."""

from __future__ import annotations

import math
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from morphgen.errors import TaskError
from morphgen.formats.files import locked_folder
from morphgen.processes import Progress, no_progress
from morphgen.rl.agents import AGENTS
from morphgen.rl.distributed import ProcessGroup, process_group
from morphgen.rl.drawn_robots import num_drawn, write_drawn
from morphgen.rl.learner_state import load_networks, state_of, use_batch
from morphgen.rl.learner_state import resume as resume_learner
from morphgen.rl.metrics import UpdateMetrics
from morphgen.rl.ppo import Learner
from morphgen.rl.recorders import Recorder, recording, require_wandb
from morphgen.rl.robot_source import members, require_links, single_members
from morphgen.rl.runs import (
    CHECKPOINT,
    RunConfig,
    open_run,
    read_checkpoint,
    read_config,
    require_open,
    write_checkpoint,
)
from morphgen.rl.training_batches import TrainingBatches, num_slices
from morphgen.tasks.device import require_device

MIN_CHECKPOINT_STEPS, MAX_CHECKPOINT_STEPS = 1500, 3000
"""Bounds of the interval between checkpoints [control steps per environment]: 5 and 10 episodes.

A checkpoint has no simulator state, so that it cuts all running episodes short: it must be rare."""
CHECKPOINTS, MIN_CHECKPOINTS = 10, 4
"""Intended number of checkpoints, and the minimum for runs that are short for these bounds."""
ROBOTS = "robots"
"""Subfolder with a run per robot, in the folder of a run of ``se`` on a split."""

ShowMetrics = Callable[[UpdateMetrics, int], None]
"""Callback with the metrics of an update, and the number of updates of the run."""


@dataclass(frozen=True)
class ExecutionConfig:
    """How a run is executed; the weights do not depend on it."""

    workers: int = 1
    """Number of PyBullet processes, or of MuJoCo threads."""
    tensorboard: bool = True
    """Write TensorBoard events."""
    wandb: bool = False
    """Send metrics to Weights & Biases."""
    minutes: int | None = None
    """Time after which training stops with a checkpoint, to be resumed [min]; None for no limit."""

    def __post_init__(self) -> None:
        """Check the values.

        Raises:
            TaskError: If the number of workers is below 1.
            MissingDependencyError: If ``wandb`` is set and the package is not installed.
        """
        if self.wandb:
            require_wandb()
        if self.workers < 1:
            raise TaskError(f"--workers {self.workers}: expected 1 or more")


@dataclass(frozen=True)
class Subrun:
    """A part of a run that trains one set of weights."""

    folder: Path
    """Folder of the part's config, metrics and checkpoint."""
    config: RunConfig
    """Config with the part's share of robots, environments, timesteps and its own seed."""


def subruns_of(folder: Path, config: RunConfig) -> list[Subrun]:
    """Return the parts of a run: the run itself, or one per robot for an agent of single robots.

    A part per robot has a seed of its own, and an equal share of the environments and timesteps,
    rounded up.
    """
    per_robot = AGENTS[config.policy.agent].per_robot
    if not per_robot or not config.source.split or config.source.member:
        return [Subrun(folder, config)]
    sources = list(single_members(config.source))
    share = 1 if config.full_budget else len(sources)
    num_envs = -(-config.num_envs // share)
    ppo = replace(config.ppo, total_timesteps=-(-config.ppo.total_timesteps // share))
    parts = []
    for i, source in enumerate(sources):
        seed = int(np.random.SeedSequence([config.seed, i]).generate_state(1)[0])
        part = replace(config, source=source, ppo=ppo, seed=seed, num_envs=num_envs)
        parts.append(Subrun(folder / ROBOTS / str(source.member), part))
    return parts


def train(
    folder: Path,
    config: RunConfig,
    *,
    resume: bool = False,
    execution: ExecutionConfig | None = None,
    show: Callable[[Subrun], ShowMetrics] | None = None,
    prepare: Progress = no_progress,
    hold: Callable[[Path], AbstractContextManager[None]] = locked_folder,
) -> list[Subrun]:
    """Train all parts of a run to their end; see ``subruns_of``.

    Training may be interrupted or killed at any time. SIGINT, SIGTERM and the end of
    ``ExecutionConfig.minutes`` let the running update end and write a checkpoint; a second signal
    acts at once. A resumed run continues from its last checkpoint. One that was killed ends with
    the same weights as an uninterrupted one; one that was stopped does not, since all its episodes
    begin anew at another update. Nothing is written before all robots and networks are built.

    Args:
        folder: Folder of the run.
        config: Config of the run.
        resume: Whether to continue a run that is already in the folder.
        execution: How the run is executed.
        show: Called at the start of every part; returns the callback for its updates.
        prepare: Called with the number of robots whose goal set is ready, and their total.
        hold: Context manager that locks the folder against other runs.

    Returns:
        The parts, of which the last are unfinished or not begun after ``minutes``; none in
        processes of ``torchrun`` other than the first, which alone writes files.

    Raises:
        TaskError: If the folder has another run, or a metric is not finite.
        FormatError: If another process writes to the folder.
        MorphgenError: If a robot or simulator cannot be built.
        KeyboardInterrupt: If it was stopped by SIGINT.
    """
    execution, parts = execution or ExecutionConfig(), subruns_of(folder, config)
    for part in parts:
        require_runnable(part.config)
    require_open(folder, config, resume=resume)
    unfinished = [part for part in parts if not is_done(part)]
    if unfinished:  # a finished run is evaluated on machines without its GPU
        require_device(config.device)
    with _StopRequest(execution.minutes) as stop, ExitStack() as held:
        processes, device = held.enter_context(process_group(config.device))
        holds = False
        for part in unfinished:
            if not holds:
                require_links(config.source, config.max_links)
            envs = processes.share(part.config.num_envs, "--envs")
            batches = TrainingBatches(
                part.config,
                envs=envs,
                device=device,
                workers=execution.workers,
                progress=prepare if processes.is_first else no_progress,
            )
            with _learner(part, batches, processes, device) as learner:
                if not processes.is_first:
                    if _learn(learner, batches, part, None, None, stop):
                        break
                    continue
                if not holds:
                    folder.mkdir(parents=True, exist_ok=True)
                    held.enter_context(hold(folder))
                    open_run(folder, config, resume=resume)
                    holds = True
                open_run(part.folder, part.config, resume=True)
                if batches.drawn is not None:
                    write_drawn(part.folder, part.config.source, batches.drawn)
                if _learn(learner, batches, part, execution, show(part) if show else None, stop):
                    break
    return parts if processes.is_first else []


def require_runnable(config: RunConfig) -> None:
    """Require timesteps for at least one update, and an environment for every robot.

    Drawn robots may have environments one after another; see ``RunConfig.slice_updates``.

    Raises:
        TaskError: If there are fewer, or a rollout cannot be split into equal minibatches, or the
            agent is for single robots and the robots are drawn.
    """
    robots = len(members(config.source)) or num_drawn(config.source)
    if config.source.grammars and AGENTS[config.policy.agent].per_robot:
        raise TaskError(
            f"--agent {config.policy.agent}: learns one robot; --robots {config.source.name} needs "
            "an agent of many"
        )
    if config.num_envs < robots and not config.slice_updates:
        raise TaskError(
            f"--envs {config.num_envs}: fewer than the {robots} robots, each of which has one"
        )
    update_timesteps = config.ppo.num_steps * config.num_envs
    if config.ppo.total_timesteps < update_timesteps:
        share = f", the share of {config.source.member}" if config.source.member else ""
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
            "or --envs, or a lower --slice-updates"
        )
    config.ppo.minibatch_size(config.num_envs)


def checkpoint_files(path: Path) -> Iterator[Path]:
    """Yield the checkpoint files of a run.

    Args:
        path: A checkpoint file, or the folder of a run.

    Raises:
        TaskError: If there is no checkpoint, or some robots of the run have none yet.
    """
    if path.is_file() or (path / CHECKPOINT).is_file():
        yield path if path.is_file() else path / CHECKPOINT
        return
    files = sorted((path / ROBOTS).glob(f"*/{CHECKPOINT}"))
    if not files:
        raise TaskError(f"{path}: no checkpoint, and no folder of a run with one")
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
def _learner(
    part: Subrun, batches: TrainingBatches, processes: ProcessGroup, device: str
) -> Iterator[Learner]:
    """Build the learner of a part, and resume its checkpoint if there is one."""
    config, state = part.config, None
    if (part.folder / CHECKPOINT).is_file():
        state = read_checkpoint(part.folder)[1]
    with closing(batches):
        learner = Learner(
            batches.make(state["update"] if state else 0),
            config.policy,
            config.ppo,
            seed=config.seed,
            device=device,
            least_links=batches.most_links,
            tasks=batches.tasks,
            processes=processes,
        )
        if state:
            resume_learner(learner, state)
        elif config.initial_checkpoint:
            initial = (part.folder / config.initial_checkpoint).resolve()
            load_networks(learner, read_checkpoint(initial)[1])
        yield learner


def _learn(
    learner: Learner,
    batches: TrainingBatches,
    part: Subrun,
    execution: ExecutionConfig | None,
    show: ShowMetrics | None,
    stop: _StopRequest,
) -> bool:
    """Make the remaining updates of a part; record their metrics and write its checkpoints.

    Args:
        learner: The learner.
        batches: Its batches.
        part: The part.
        execution: How the run is executed; None in a process that writes no files.
        show: Called after every update.
        stop: Request to stop before the last update.

    Returns:
        Whether it has stopped early.
    """
    is_stopped = False
    interval = updates_between(part.config)
    with ExitStack() as stack:
        recorders: Sequence[Recorder] = ()
        if execution is not None:
            recorders = stack.enter_context(
                recording(
                    part.folder,
                    part.config,
                    learner.update,
                    tensorboard=execution.tensorboard,
                    wandb=execution.wandb,
                )
            )
        while not learner.done and not is_stopped:
            metrics = learner.iterate()
            scores = batches.recorded_scores(metrics.scores, learner.update)
            metrics = replace(metrics, scores=scores)
            for recorder in recorders:
                recorder.record(metrics)
            if batches.changes_at(learner.update):
                use_batch(learner, batches.make(learner.update))
            # A checkpoint has the state of the batch that the run continues with.
            left = learner.num_updates - learner.update
            is_stopped = any(learner.processes.gather(stop.is_requested)) and left > 0
            is_due = learner.update % interval == 0 and left >= interval
            if not left or is_due or is_stopped:
                state = state_of(learner)  # of all processes
                if execution is not None:
                    write_checkpoint(part.folder, part.config, state)
                # A resumed run begins new episodes here, and must end with the same weights.
                learner.restart_episodes()
            if show:
                show(metrics, learner.num_updates)
    return is_stopped


class _StopRequest:
    """Asks training to stop after the running update: by a signal, or because its time is over.

    In this block the first SIGINT or SIGTERM waits for the end of the update, and acts at the end
    of the block; the next one acts at once.
    """

    def __init__(self, minutes: int | None) -> None:
        """Begin to count the minutes, if there is a limit."""
        self._end = math.inf if minutes is None else time.monotonic() + 60 * minutes
        self._received: list[int] = []
        self._handlers: dict[int, Any] = {}

    @property
    def is_requested(self) -> bool:
        return bool(self._received) or time.monotonic() >= self._end

    def __enter__(self) -> Self:
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

"""Train: make a run's folder, learn, and leave at any time what can be taken up again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from morphgen.errors import TaskError
from morphgen.formats.files import alone
from morphgen.rl.ppo import Learner
from morphgen.rl.recorders import recording, require_wandb
from morphgen.rl.report import Report
from morphgen.rl.runs import (
    CHECKPOINT,
    RunConfig,
    open_run,
    read_checkpoint,
    read_config,
    require_open,
    write_checkpoint,
)
from morphgen.rl.sources import apart, members, require_links, specs_of
from morphgen.tasks.env_specs import GoalConfig
from morphgen.tasks.make import batch_of

LEAST, MOST = 1500, 3000
"""Control steps of an environment between checkpoints: five and ten of the tasks' episodes.

After each episodes begin anew, so that few of them are cut short; a checkpoint has no simulator's
state."""
PARTS, FEWEST = 10, 4
"""Checkpoints of a run if these steps allow it, and if they are too many for it."""
ROBOTS = "robots"
"""Where the runs of single robots are in the folder of a run of ``se`` on a split."""

Show = Callable[[Report, int], None]
"""Told every report, and how many updates there will be."""


@dataclass(frozen=True)
class Way:
    """How a run is done; its weights do not depend on it."""

    workers: int = 1
    """Processes of PyBullet, threads of MuJoCo."""
    tensorboard: bool = True
    wandb: bool = False

    def __post_init__(self) -> None:
        """Check.

        Raises:
            TaskError: If there are no workers.
            MissingDependencyError: If Weights & Biases is asked for and not installed.
        """
        if self.wandb:
            require_wandb()
        if self.workers < 1:
            raise TaskError(f"--workers {self.workers}: expected 1 or more")


@dataclass(frozen=True)
class Part:
    """A run of one set of weights."""

    folder: Path
    config: RunConfig


def parts_of(folder: Path, config: RunConfig) -> list[Part]:
    """The runs that a run is made of: itself, or for ``se`` on a split one for each robot.

    Each of these has a seed of its own, and its share of environments and transitions, rounded up.
    """
    if config.policy.agent != "se" or not config.source.split or config.source.only:
        return [Part(folder, config)]
    alone = list(apart(config.source))
    share = 1 if config.whole else len(alone)
    made = []
    for i, source in enumerate(alone):
        seed = int(np.random.SeedSequence([config.seed, i]).generate_state(1)[0])
        ppo = replace(config.ppo, transitions=-(-config.ppo.transitions // share))
        own = replace(config, source=source, ppo=ppo, seed=seed, envs=-(-config.envs // share))
        made.append(Part(folder / ROBOTS / str(source.only), own))
    return made


def train(
    folder: Path,
    config: RunConfig,
    *,
    resume: bool = False,
    way: Way | None = None,
    show: Callable[[Part], Show] | None = None,
    hold: Callable[[Path], AbstractContextManager[None]] = alone,
) -> list[Part]:
    """Train a run to its end; see ``parts_of``.

    At any time it may be interrupted or killed; resumed, it takes up its last checkpoint, and comes
    to the same weights as if it had not been. Nothing is written before learning can begin.

    Args:
        folder: Of the run.
        config: What is asked for.
        resume: Whether a run that is there is to be continued.
        way: How it is done.
        show: Called with every part that begins; what it returns, with its reports.
        hold: Holds the folder against other runs.

    Returns:
        What it is made of, all of it trained.

    Raises:
        TaskError: If the folder is another run's, or a number is no longer finite.
        FormatError: If another run is writing there.
        MorphgenError: If a robot or simulator cannot be made.
    """
    way, made = way or Way(), parts_of(folder, config)
    for part in made:
        require_runnable(part.config)
    require_device(config.device)
    require_open(folder, config, resume=resume)
    with ExitStack() as held:
        holds = False
        for part in made:
            if is_done(part):
                continue
            if not holds:
                require_links(config.source, config.max_links)
            with _learner(part, way) as learner:
                if not holds:
                    folder.mkdir(parents=True, exist_ok=True)
                    held.enter_context(hold(folder))
                    open_run(folder, config, resume=resume)
                    holds = True
                open_run(part.folder, part.config, resume=True)
                _learn(learner, part, way, show(part) if show else _unseen)
    return made


def require_runnable(config: RunConfig) -> None:
    """Require that a run has an update, and every robot an environment.

    Raises:
        TaskError: If it has not.
    """
    robots = len(members(config.source))
    if config.envs < robots:
        raise TaskError(
            f"--envs {config.envs}: fewer than the {robots} robots, each of which has one"
        )
    one = config.ppo.steps * config.envs
    if config.ppo.transitions < one:
        share = f", the share of {config.source.only}" if config.source.only else ""
        raise TaskError(
            f"--steps {config.ppo.transitions} with --envs {config.envs}{share}: an update takes "
            f"{one:,} transitions ({config.ppo.steps} steps of every environment)"
        )
    config.ppo.minibatch(config.envs)


def require_device(name: str) -> None:
    """Require that there is such a device.

    Raises:
        TaskError: If there is none.
    """
    kind, _, number = name.partition(":")
    if name != "cpu" and (kind != "cuda" or not (number or "0").isdecimal()):
        raise TaskError(f"unknown device {name!r}; valid: cpu, cuda, or such as cuda:1")
    if kind == "cuda" and not torch.cuda.is_available():
        raise TaskError(f"--device {name}: this machine has no CUDA device")
    if kind == "cuda" and int(number or 0) >= torch.cuda.device_count():
        raise TaskError(f"--device {name}: there are {torch.cuda.device_count()} CUDA devices")


def checkpoints(path: Path) -> Iterator[Path]:
    """The checkpoints of what a user names: a file, a run's folder, or that of ``se`` on a split.

    Raises:
        TaskError: If there is none, or ``se`` has not begun with some of its robots.
    """
    if path.is_file() or (path / CHECKPOINT).is_file():
        yield path if path.is_file() else path / CHECKPOINT
        return
    found = sorted((path / ROBOTS).glob(f"*/{CHECKPOINT}"))
    if not found:
        raise TaskError(f"{path}: no checkpoint, and no folder of a run with one")
    parts = parts_of(path, read_config(path))
    missing = [part.folder.name for part in parts if not (part.folder / CHECKPOINT).is_file()]
    if missing:
        raise TaskError(
            f"{path}: {len(missing)} of its {len(parts)} robots have no policy yet, such as "
            f"{missing[0]}; train goes on with --resume"
        )
    yield from found


def is_done(part: Part) -> bool:
    """Whether all updates of a run have been made."""
    if not (part.folder / CHECKPOINT).is_file():
        return False
    return bool(read_checkpoint(part.folder)[1]["update"] >= part.config.updates)


def updates_between(config: RunConfig) -> int:
    """How many updates there are from a checkpoint of a run to the next."""
    steps = config.ppo.steps
    span = min(max(config.updates * steps // PARTS, LEAST), MOST)
    return max(min(-(-span // steps), config.updates // FEWEST), 1)


@contextmanager
def _learner(part: Part, way: Way) -> Iterator[Learner]:
    """The learner of a part, as far as it got."""
    config, wanted = part.config, part.config.interface
    specs = specs_of(config.source, GoalConfig(tasks=config.tasks))
    batch = batch_of(
        specs,
        config.envs,
        sim=config.sim,
        seed=config.seed,
        kind=wanted.kind,
        observe=wanted.channels,
        workers=way.workers,
        max_links=wanted.max_links,
        library=map(Path, config.source.library),
    )
    try:
        learner = Learner(batch, config.policy, config.ppo, seed=config.seed, device=config.device)
        if (part.folder / CHECKPOINT).is_file():
            learner.resume(read_checkpoint(part.folder)[1])
        elif config.begin:
            learner.adopt(read_checkpoint(Path(config.begin))[1])
        yield learner
    finally:
        batch.close()


def _learn(learner: Learner, part: Part, way: Way, show: Show) -> None:
    often = updates_between(part.config)
    kept = recording(
        part.folder,
        part.config,
        learner.update,
        tensorboard=way.tensorboard,
        wandb=way.wandb,
    )
    with kept as recorders:
        while not learner.done:
            report = learner.iterate()
            for recorder in recorders:
                recorder.record(report)
            rest = learner.updates - learner.update
            if not rest or (learner.update % often == 0 and rest >= often):
                write_checkpoint(part.folder, part.config, learner.checkpoint())
                # A resumed run begins new episodes here, and must come to the same weights.
                learner.restart_episodes()
            show(report, learner.updates)


def _unseen(report: Report, updates: int) -> None:
    """A report that is shown to nobody."""

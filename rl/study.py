"""Studies: every agent with every seed on every split, and baselines to compare with."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from morphgen import processes
from morphgen.benchmark.split import Side
from morphgen.errors import FormatError, MorphgenError, TaskError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, write_atomic
from morphgen.processes import ray_cluster, require_ray
from morphgen.rl.aliases import renamed
from morphgen.rl.baselines import BASELINES
from morphgen.rl.evaluation import (
    EvalConfig,
    Progress,
    evaluate_baseline,
    evaluate_run,
    no_progress,
)
from morphgen.rl.inference import MODES, Mode
from morphgen.rl.robot_source import RobotSource, identity, members, other_side, tasks_of
from morphgen.rl.runs import RunConfig, require_open, require_same_run
from morphgen.rl.scores import Score, score_from_json, scores_to_json
from morphgen.rl.training import ExecutionConfig, ShowMetrics, Subrun, train
from morphgen.tasks.env_specs import GoalConfig, task_configs
from morphgen.tasks.registry import TASKS

SCORES = "scores.json"
POLL = 2.0
"""Time between two checks of cells that another process works on [s]."""


@dataclass(frozen=True)
class Cell:
    """An agent with a seed on a split, or a baseline on a split; done when it has scores."""

    folder: Path
    """Folder of the run and its scores."""
    split: str
    """Name of the split."""
    agent: str
    """Label of the agent, or name of the baseline."""
    seed: int | None
    """Seed of the run; None for a baseline."""
    source: RobotSource
    """Robots that the agent is trained on; for a baseline, a side of the split."""
    eval_config: EvalConfig
    """Configuration of the evaluation."""
    config: RunConfig | None = None
    """Config of the run; None for a baseline."""

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides that the cell is evaluated on; an agent trained on the test side only on that."""
        return ("test",) if self.source.side == "test" else ("train", "test")


@dataclass(frozen=True)
class Outcome:
    """Success or failure of a cell."""

    cell: Cell
    """The finished or failed cell."""
    error: str = ""
    """Error message; empty after success."""


Work = Callable[[Sequence[Cell], ExecutionConfig], Iterator[Outcome]]
"""Function that trains and evaluates cells, and yields their outcomes as they finish."""
StartProgress = Callable[[str], Progress]
"""Called with the name of an evaluation when it starts; returns the callback for its progress."""


def baseline_cells(folder: Path, source: RobotSource, eval_config: EvalConfig) -> list[Cell]:
    """Return the cells of the baselines for the tasks of a split."""
    tasks = {task for side in ("train", "test") for task in tasks_of(other_side(source, side))}
    eval_config = replace(eval_config, workers=1)  # scores do not depend on it
    return [
        Cell(folder / source.name / name, source.name, name, None, source, eval_config)
        for name in BASELINES
        if BASELINES[name].suits(tasks)
    ]


def agent_cell(folder: Path, agent: str, config: RunConfig, eval_config: EvalConfig) -> Cell:
    """Return the cell of a run."""
    source, eval_config = config.source, replace(eval_config, workers=1)
    run_folder = folder / source.name / agent / f"seed{config.seed}"
    return Cell(run_folder, source.name, agent, config.seed, source, eval_config, config)


def matched_budget(config: RunConfig) -> RunConfig:
    """Return a run on test robots with the budget per robot of the same run on train robots.

    The budget is the number of environments and timesteps. Runs on train robots do not change, nor
    do runs with ``full_budget``.
    """
    if config.source.side == "train" or config.full_budget:
        return config
    num_test = len(members(config.source))
    num_train = len(members(other_side(config.source, "train")))
    total_timesteps = -(-config.ppo.total_timesteps * num_test // num_train)
    ppo = replace(config.ppo, total_timesteps=total_timesteps)
    return replace(config, ppo=ppo, num_envs=-(-config.num_envs * num_test // num_train))


def read_scores(cell: Cell) -> dict[str, list[Score]] | None:
    """Return the scores of a cell by mode, or by the baseline's name; None if it is not done.

    Raises:
        TaskError: If the scores are of another evaluation, or of other robots or goals.
        FormatError: If the file is malformed.
    """
    path = cell.folder / SCORES
    if not path.is_file():
        return None
    try:
        data = renamed("scores", read_json(path))
        scores = {
            mode: [score_from_json(record) for record in records]
            for mode, records in data["scores"].items()
        }
        source = RobotSource(**renamed("source", data["source"]))
        stored = _plain([_with_defaults(data["eval"]), identity(source)])
    except (OSError, ValueError, KeyError, TypeError, AttributeError, TaskError) as error:
        raise FormatError(f"{path}: not the scores of a cell: {error}") from error
    expected = _plain([cell.eval_config.as_data(), identity(cell.source)])
    for what, theirs, ours in zip(("evaluation", "set of robots"), stored, expected, strict=True):
        if theirs != ours:
            raise TaskError(f"{path}: of another {what}; delete it, or name another --out")
    return scores


def _with_defaults(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return a stored evaluation with the defaults of constants that tasks did not have then."""
    constants = {name: values for name, values in stored.items() if name in TASKS}
    return {**stored, **GoalConfig(tasks=task_configs(constants)).as_data()}


def _plain(values: Sequence[object]) -> list[Any]:
    """Return values as JSON reads them: lists instead of tuples."""
    plain: list[Any] = json.loads(json.dumps(values))
    return plain


def require_cells(cells: Sequence[Cell]) -> None:
    """Require that the folders of cells have no other runs or scores; write nothing.

    Raises:
        TaskError: If a cell's folder has another run or evaluation.
        FormatError: If scores are malformed.
    """
    for cell in cells:
        if cell.config is not None:
            require_open(cell.folder, cell.config, resume=True)
        # The scores do not say how their policy was trained; the config beside them does.
        if read_scores(cell) is not None and cell.config is not None:
            require_same_run(cell.folder, cell.config)


def do_cell(
    cell: Cell,
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None = None,
    progress: StartProgress = lambda name: no_progress,
    prepare: processes.Progress = processes.no_progress,
) -> None:
    """Train and evaluate a cell, or what remains of it. No other process may work on it.

    Raises:
        MorphgenError: As ``train`` and ``evaluate``.
    """
    if read_scores(cell) is not None:
        return
    eval_config = replace(cell.eval_config, workers=execution.workers)
    if cell.config is None:
        scores = {cell.agent: _baseline_scores(cell, eval_config, progress)}
    else:
        train(
            cell.folder,
            cell.config,
            resume=True,
            execution=execution,
            show=show,
            prepare=prepare,
            hold=lambda folder: nullcontext(),  # the caller has locked the cell's folder
        )
        scores = {
            mode: _policy_scores(cell, cell.config, eval_config, mode, progress) for mode in MODES
        }
    data = {
        "morphgen": version("morphgen"),
        "eval": cell.eval_config.as_data(),
        "source": asdict(cell.source),
        "scores": {mode: scores_to_json(records) for mode, records in scores.items()},
    }
    write_atomic(cell.folder / SCORES, json.dumps(data, indent=2) + "\n")


def run_cells(
    cells: Sequence[Cell],
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None = None,
    progress: StartProgress = lambda name: no_progress,
    prepare: processes.Progress = processes.no_progress,
) -> Iterator[Outcome]:
    """Train and evaluate cells one after another, and yield their outcomes.

    Other processes may work on the same cells. Each cell is done by one process; this one waits at
    the end for the cells of the others.
    """
    waiting = deque(cells)
    skipped = 0
    while waiting:
        cell = waiting.popleft()
        outcome = _do_locked(cell, execution, show, progress, prepare)
        if outcome is not None:
            skipped = 0
            yield outcome
            continue
        waiting.append(cell)
        skipped += 1
        if skipped >= len(waiting):
            time.sleep(POLL)
            skipped = 0


def run_cells_on_ray(address: str | None, *, gpus: float = 0.0) -> Work:
    """Return a function that does cells as tasks of a Ray cluster.

    Its machines have morphgen installed and share the study's folder.

    Args:
        address: Address of the cluster; None for a local one.
        gpus: GPUs per cell; a fraction if below 1.

    Raises:
        MissingDependencyError: If ray is not installed.
    """
    ray = require_ray()

    def work(cells: Sequence[Cell], execution: ExecutionConfig) -> Iterator[Outcome]:
        with ray_cluster(address):
            remote = ray.remote(num_cpus=execution.workers, num_gpus=gpus, max_retries=0)(_on_ray)
            running = {
                remote.remote(replace(cell, folder=cell.folder.resolve()), execution): cell
                for cell in cells
            }
            while running:
                (done, *_), _ = ray.wait(list(running))
                cell = running.pop(done)
                try:
                    yield Outcome(cell, ray.get(done))
                except ray.exceptions.RayError as error:
                    yield Outcome(cell, f"its Ray task failed: {type(error).__name__}: {error}")

    return work


def _on_ray(cell: Cell, execution: ExecutionConfig) -> str:
    (outcome,) = run_cells([cell], execution)
    return outcome.error


def _do_locked(
    cell: Cell,
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None,
    progress: StartProgress,
    prepare: processes.Progress,
) -> Outcome | None:
    """Train and evaluate a cell and return its outcome; None if another process works on it."""
    try:
        cell.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(cell.folder / LOCK, timeout=0):
            do_cell(cell, execution, show, progress, prepare)
    except Timeout:
        return None
    except MorphgenError as error:
        return Outcome(cell, str(error))
    except OSError as error:
        return Outcome(cell, f"{error.filename or cell.folder}: {error.strerror}")
    except Exception as error:  # such as a GPU out of memory: the other cells go on
        traceback.print_exc(file=sys.stderr)
        return Outcome(cell, f"{type(error).__name__}: {error}")
    return Outcome(cell)


def _policy_scores(
    cell: Cell, config: RunConfig, eval_config: EvalConfig, mode: Mode, progress: StartProgress
) -> list[Score]:
    """Return the scores of a run on the sides that its cell is evaluated on."""
    scores = []
    for side in cell.sides:
        show = progress(f"{cell.agent} {mode} on {side}")
        scores += evaluate_run(
            cell.folder, side, eval_config, mode, device=config.device, progress=show
        )
    return scores


def _baseline_scores(cell: Cell, eval_config: EvalConfig, progress: StartProgress) -> list[Score]:
    """Return the scores of a baseline on the sides that have a robot with one of its tasks."""
    scores = []
    for side in cell.sides:
        source = other_side(cell.source, side)
        if BASELINES[cell.agent].suits(tasks_of(source)):
            show = progress(f"{cell.agent} on {side}")
            scores += evaluate_baseline(cell.agent, source, eval_config, progress=show)
    return scores


def as_record(cell: Cell) -> dict[str, Any]:
    """Return the columns of tables that identify a cell."""
    return {"split": cell.split, "agent": cell.agent, "seed": cell.seed}

"""Studies: every agent with every seed on every split, and baselines to compare with."""

from __future__ import annotations

import json
import re
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

from morphgen.benchmark.split import Side, Split, split_id
from morphgen.benchmark.split_file import parse_split
from morphgen.errors import BenchmarkError, FormatError, MorphgenError, TaskError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import LOCK, write_atomic
from morphgen.processes import ray_cluster, require_ray
from morphgen.progress import stage
from morphgen.rl.agents import AGENTS
from morphgen.rl.aliases import renamed
from morphgen.rl.baselines import BASELINES
from morphgen.rl.evaluation import (
    EvalConfig,
    evaluate_baseline,
    evaluate_run,
)
from morphgen.rl.inference import MODES, Mode
from morphgen.rl.runs.checkpoint import CHECKPOINT, RunConfig, require_open, require_same_run
from morphgen.rl.runs.robot_source import (
    RobotSource,
    identity,
    members,
    other_side,
    split_of,
    tasks_of,
)
from morphgen.rl.runs.training import ExecutionConfig, ShowMetrics, Subrun, finetuning_config, train
from morphgen.rl.scores.scores import Score, score_from_json, scores_to_json
from morphgen.rl.scores.submission import SubmissionRecorder, Training, write_submission
from morphgen.tasks.goals.eval_protocol import EvalProtocol
from morphgen.tasks.registry import SIMULATORS, TASKS, evaluation_simulator
from morphgen.tasks.scenes.env_specs import GoalConfig, task_configs

_FINE_TUNED = re.compile(r"fine-tuned (\d[\d,]*)")


@dataclass(frozen=True, eq=False)
class StoredCell:
    """The content of a cell's ``scores.json``."""

    simulator: str
    """Name of the simulator of the evaluation."""
    episodes: int
    """Minimum number of episodes per robot."""
    seed: int
    """Seed of the episodes."""
    goals: GoalConfig
    """Seed of the goals, and constants of the tasks."""
    version: str | None
    """Version of morphgen that ran the episodes; None before 0.2.0, which did not write it."""
    scores: Mapping[str, tuple[Score, ...]]
    """Scores by mode, or by the baseline's name."""


def stored_split(file: Path, data: object) -> str:
    """Return the id of the split that a cell's scores are of; empty if they are of no split."""
    try:
        text = _source(data).split
        return text and split_id(parse_split(text, file).split)
    except (ValueError, KeyError, TypeError, AttributeError, MorphgenError) as error:
        raise _malformed(file, error) from error


def stored_cell(file: Path, data: object) -> StoredCell:
    """Return the scores of a cell and the configuration of their evaluation."""
    try:
        table: dict[str, Any] = renamed("scores", data)
        rules = table["eval"]
        constants = {name: values for name, values in rules.items() if name in TASKS}
        goals = GoalConfig(_source(data).goal_seed, task_configs(constants))
        scores = {
            mode: tuple(score_from_json(record) for record in records)
            for mode, records in table["scores"].items()
        }
        version = str(table["morphgen"]) if "morphgen" in table else None
        return StoredCell(rules["sim"], rules["episodes"], rules["seed"], goals, version, scores)
    except (ValueError, KeyError, TypeError, AttributeError, MorphgenError) as error:
        raise _malformed(file, error) from error


def _source(data: object) -> RobotSource:
    return RobotSource(**renamed("source", renamed("scores", data)["source"]))


def _malformed(file: Path, error: Exception) -> BenchmarkError:
    is_message = isinstance(error, ValueError | MorphgenError)
    return BenchmarkError(
        f"{file}: neither a submission nor the scores of a study's cell: "
        f"{error if is_message else repr(error)}"
    )


def tuned_name(steps: int) -> str:
    """Return the name of the mode of a policy after a number of transitions of fine-tuning."""
    return f"fine-tuned {steps:,}"


def acting(name: str) -> tuple[str, int]:
    """Return how a policy acts, and the transitions of its fine-tuning."""
    match = _FINE_TUNED.fullmatch(name)
    return (MODES[0], int(match[1].replace(",", ""))) if match else (name, 0)


def require_all_robots(scores: Sequence[Score], split: Split, file: Path) -> None:
    """Require a score of every robot of a side with a task: means of fewer do not compare."""
    for side, task in {(score.side, score.task): None for score in scores}:
        found = sorted(s.robot for s in scores if (s.side, s.task) == (side, task))
        expected = sorted(each.name for each in split.side(side) if each.task == task)
        if found != expected:
            raise BenchmarkError(
                f"{file}: scores of {side} robots at {task}: {', '.join(found)}; expected one of "
                f"each: {', '.join(expected) or 'none'}"
            )


SCORES = "scores.json"
FINETUNED = "finetuned"
"""Folder of fine-tuned policies in the folder of a run."""


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
    finetune: tuple[int, ...] = ()
    """Numbers of transitions that the policy is fine-tuned with on the test robots, each of them
    from the end of the run."""

    @property
    def modes(self) -> dict[str, tuple[Mode | None, int]]:
        """Names under which the cell has scores: how the policy acts, and its fine-tuning.

        The mode is None for a baseline, and the number is that of the transitions of fine-tuning.
        """
        if self.config is None:
            return {self.agent: (None, 0)}
        modes: dict[str, tuple[Mode | None, int]] = {mode: (mode, 0) for mode in MODES}
        for steps in self.finetune:
            modes[tuned_name(steps)] = (MODES[0], steps)
        return modes

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides that the cell is evaluated on; an agent trained on the test side only on that."""
        return ("test",) if self.source.side == "test" else ("train", "test")


def baseline_cells(folder: Path, source: RobotSource, eval_config: EvalConfig) -> list[Cell]:
    """Return the cells of the baselines for the tasks of a split."""
    tasks = {task for side in ("train", "test") for task in tasks_of(other_side(source, side))}
    eval_config = replace(eval_config, workers=1)  # scores do not depend on it
    return [
        Cell(folder / source.name / name, source.name, name, None, source, eval_config)
        for name in BASELINES
        if BASELINES[name].suits(tasks)
    ]


def agent_cell(
    folder: Path,
    agent: str,
    config: RunConfig,
    eval_config: EvalConfig,
    finetune: Sequence[int] = (),
) -> Cell:
    """Return the cell of a run."""
    source, eval_config = config.source, replace(eval_config, workers=1)
    run_folder = folder / source.name / agent / f"seed{config.seed}"
    if AGENTS[config.policy.agent].per_robot or source.side == "test":
        finetune = ()
    tuned = tuple(finetune)
    return Cell(run_folder, source.name, agent, config.seed, source, eval_config, config, tuned)


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
    """Return the scores of a cell by mode, or by the baseline's name; None if it is not done."""
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
        raise FormatError(
            f"{path}: not the scores of a cell: {error}; delete it to evaluate the cell again"
        ) from error
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
    """Require that the folders of cells have no other runs or scores; write nothing."""
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
) -> None:
    """Train and evaluate a cell, or what remains of it. No other process may work on it.

    The scores and the episodes of a mode are written when it is evaluated. Policies are evaluated
    on the CPU, so that a machine without the GPU of the training gives the same scores.
    """
    scores = read_scores(cell) or {}
    if scores.keys() >= cell.modes.keys():
        return

    def learn(folder: Path, config: RunConfig) -> None:
        train(
            folder,
            config,
            resume=True,
            execution=execution,
            show=show,
            hold=lambda folder: nullcontext(),  # the caller has locked the cell's folder
        )

    if cell.config is not None:
        learn(cell.folder, cell.config)
    eval_config = replace(cell.eval_config, workers=execution.workers)
    split = split_of(cell.source)
    for name, (mode, steps) in cell.modes.items():
        if name in scores:
            continue
        folder, config, sides = cell.folder, cell.config, cell.sides
        if config is not None and steps:
            folder, sides = folder / FINETUNED / str(steps), ("test",)
            config = finetuning_run(cell, config, steps)
            learn(folder, config)
        recorder = SubmissionRecorder(split)
        records: list[Score] = []
        for side in sides:
            title = f"{cell.agent}{f' {name}' if mode else ''} on {side}"
            if config is not None and mode is not None:
                with stage(title):
                    records += evaluate_run(folder, side, eval_config, mode, record=recorder)
            # A baseline is not evaluated on a side without a robot for it.
            elif BASELINES[cell.agent].suits(tasks_of(other_side(cell.source, side))):
                source = other_side(cell.source, side)
                with stage(title):
                    records += evaluate_baseline(cell.agent, source, eval_config, record=recorder)
        scores[name] = records
        _write_episodes(cell, name, split, recorder)
        _write_scores(cell, scores)


def finetuning_run(cell: Cell, config: RunConfig, steps: int) -> RunConfig:
    """Return the config of a cell's fine-tuning: on a CPU, in a simulator that CPUs run."""
    tuned = finetuning_config(
        config,
        other_side(cell.source, "test"),
        f"../../{CHECKPOINT}",
        {"total_timesteps": steps, "bf16": False, "compile": False},
    )
    return replace(tuned, sim=evaluation_simulator(config.sim), device="cpu")


def _write_episodes(cell: Cell, name: str, split: Split, recorder: SubmissionRecorder) -> None:
    """Write the episodes of one of the modes of a cell as a submission.

    A submission must be in a simulator that comes with morphgen; episodes in others are not kept.
    """
    config, evaluation = cell.config, cell.eval_config
    if evaluation.sim not in SIMULATORS.builtin:
        return
    goals = GoalConfig(seed=cell.source.goal_seed, tasks=evaluation.tasks)
    rules = EvalProtocol(evaluation.sim, evaluation.episodes, evaluation.seed, goals)
    mode, steps = cell.modes[name]
    training = None
    if config is not None:
        training = Training(config.sim, config.ppo.total_timesteps, steps)
    submission = recorder.submission(
        cell.agent, mode or "", cell.seed, rules.as_data(split), training
    )
    file = f"fine-tuned-{steps}" if steps else name
    write_submission(cell.folder / f"{file}.json", submission)


def _write_scores(cell: Cell, scores: Mapping[str, Sequence[Score]]) -> None:
    data = {
        "morphgen": version("morphgen"),
        "eval": cell.eval_config.as_data(),
        "source": asdict(cell.source),
        "scores": {mode: scores_to_json(records) for mode, records in scores.items()},
    }
    write_atomic(cell.folder / SCORES, json.dumps(data, indent=2) + "\n")


def as_record(cell: Cell) -> dict[str, Any]:
    """Return the columns of tables that identify a cell."""
    return {"split": cell.split, "agent": cell.agent, "seed": cell.seed}


POLL = 2.0
"""Time between two checks of cells that another process works on [s]."""


@dataclass(frozen=True)
class Outcome:
    """Success or failure of a cell."""

    cell: Cell
    """The finished or failed cell."""
    error: str = ""
    """Error message; empty after success."""


Work = Callable[[Sequence[Cell], ExecutionConfig], Iterator[Outcome]]
"""Function that trains and evaluates cells, and yields their outcomes as they finish."""


def run_cells(
    cells: Sequence[Cell],
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None = None,
) -> Iterator[Outcome]:
    """Train and evaluate cells one after another, and yield their outcomes.

    Other processes may work on the same cells. Each cell is done by one process; this one waits at
    the end for the cells of the others.
    """
    waiting = deque(cells)
    skipped = 0
    while waiting:
        cell = waiting.popleft()
        outcome = _do_locked(cell, execution, show)
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
) -> Outcome | None:
    """Train and evaluate a cell and return its outcome; None if another process works on it."""
    try:
        cell.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(cell.folder / LOCK, timeout=0):
            do_cell(cell, execution, show)
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

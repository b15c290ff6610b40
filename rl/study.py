"""Studies: every agent with every seed on every split, and baselines to compare with."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path
from typing import Any

from morphgen import processes
from morphgen.benchmark.split import Side, Split
from morphgen.errors import FormatError, TaskError
from morphgen.formats.data_files import read_json
from morphgen.formats.files import write_atomic
from morphgen.rl.agents import AGENTS
from morphgen.rl.aliases import renamed
from morphgen.rl.baselines import BASELINES
from morphgen.rl.evaluation import (
    EvalConfig,
    Progress,
    evaluate_baseline,
    evaluate_run,
    no_progress,
)
from morphgen.rl.finetuning import finetuning_config
from morphgen.rl.inference import MODES, Mode
from morphgen.rl.robot_source import (
    RobotSource,
    identity,
    members,
    other_side,
    split_of,
    tasks_of,
)
from morphgen.rl.runs import CHECKPOINT, RunConfig, require_open, require_same_run
from morphgen.rl.scores import Score, score_from_json, scores_to_json
from morphgen.rl.study_cells import tuned_name
from morphgen.rl.submission import SubmissionRecorder, Training, write_submission
from morphgen.rl.training import ExecutionConfig, ShowMetrics, Subrun, train
from morphgen.tasks.env_specs import GoalConfig, task_configs
from morphgen.tasks.eval_protocol import EvalProtocol
from morphgen.tasks.registry import SIMULATORS, TASKS, evaluation_simulator

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


def agent_cell(
    folder: Path,
    agent: str,
    config: RunConfig,
    eval_config: EvalConfig,
    finetune: Sequence[int] = (),
) -> Cell:
    """Return the cell of a run.

    Args:
        folder: Output folder of the study.
        agent: Label of the agent.
        config: Config of the run.
        eval_config: Configuration of the evaluation.
        finetune: Numbers of transitions to fine-tune with on the test robots. Agents of single
            robots and runs on test robots are not fine-tuned: they have no policy of train robots
            that one could start from.
    """
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

    The scores and the episodes of a mode are written when it is evaluated. Policies are evaluated
    on the CPU, so that a machine without the GPU of the training gives the same scores.

    Raises:
        MorphgenError: As ``train`` and ``evaluate``.
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
            prepare=prepare,
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
            shown = progress(f"{cell.agent}{f' {name}' if mode else ''} on {side}")
            if config is not None and mode is not None:
                records += evaluate_run(
                    folder, side, eval_config, mode, progress=shown, record=recorder
                )
            # A baseline is not evaluated on a side without a robot for it.
            elif BASELINES[cell.agent].suits(tasks_of(other_side(cell.source, side))):
                source = other_side(cell.source, side)
                records += evaluate_baseline(
                    cell.agent, source, eval_config, progress=shown, record=recorder
                )
        scores[name] = records
        _write_episodes(cell, name, split, recorder)
        _write_scores(cell, scores)


def finetuning_run(cell: Cell, config: RunConfig, steps: int) -> RunConfig:
    """Return the config of a cell's fine-tuning: on a CPU, in a simulator that CPUs run.

    Args:
        cell: The cell.
        config: Config of its run.
        steps: Transitions of the fine-tuning.
    """
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

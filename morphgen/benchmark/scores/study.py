"""Studies: every agent with every seed on every split, beside baselines; and episodes run again."""

from __future__ import annotations

import json
import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from filelock import FileLock, Timeout

from morphgen.benchmark.scores import submission
from morphgen.benchmark.scores.results import NOTE, result_rows, result_tables, rows_data
from morphgen.benchmark.scores.submission import Submission, protocol_from
from morphgen.errors import BenchmarkError, MorphgenError, TaskError
from morphgen.formats.files import LOCK, write_file
from morphgen.progress import note, stage
from morphgen.rl.agents import AGENTS
from morphgen.rl.baselines import BASELINES
from morphgen.rl.demonstrations.recording import TOLERANCE
from morphgen.rl.evaluation import (
    EvalConfig,
    episodes_alone,
    evaluate_baseline,
    evaluate_checkpoints,
    evaluate_run,
)
from morphgen.rl.inference import MODES, Episode, Mode, Policy, PolicyController
from morphgen.rl.runs.checkpoint import (
    CHECKPOINT,
    Interface,
    RunConfig,
    config_from,
    read_checkpoint,
    require_open,
    require_same_config,
)
from morphgen.rl.runs.robot_source import (
    SplitSource,
    members,
    other_side,
    side_of,
    split_of,
    split_source,
    tasks_of,
)
from morphgen.rl.runs.training import (
    ExecutionConfig,
    ShowMetrics,
    Subrun,
    checkpoint_files,
    finetuning_config,
    train,
)
from morphgen.rl.scores import UNSTABLE, RobotOutcomes, Score
from morphgen.rl.shipped_policies import checkpoint_path, is_named
from morphgen.splits.split import SIDES, Side, Split, split_id
from morphgen.tasks.registry import evaluation_simulator
from morphgen.tasks.scenes.env_specs import GoalConfig

FINETUNED = "finetuned"  # folder of fine-tuned policies in the folder of a run


@dataclass(frozen=True)
class Cell:
    """An agent with a seed on a split, or a baseline on a split; done when it has episodes."""

    study: Path  # folder of the study, with the table of episodes
    agent: str  # label of the agent, or name of the baseline
    seed: int | None  # seed of the run; None for a baseline
    source: SplitSource  # robots that the agent is trained on; for a baseline, a side of the split
    eval_config: EvalConfig  # configuration of the evaluation
    config: RunConfig | None = None  # config of the run; None for a baseline
    finetune: tuple[int, ...] = ()
    """Numbers of transitions that the policy is fine-tuned with on the test robots, each of them
    from the end of the run."""

    @property
    def split(self) -> str:
        """Name of the split."""
        return self.source.name

    @property
    def folder(self) -> Path:
        """Folder of the run, or of the lock of a baseline."""
        folder = self.study / self.split / self.agent
        return folder if self.seed is None else folder / f"seed{self.seed}"

    @property
    def modes(self) -> dict[str, tuple[Mode | None, int]]:
        """Names of what the cell has episodes of: how the policy acts, and its fine-tuning.

        The mode is None for a baseline, and the number is that of the transitions of fine-tuning.
        """
        if self.config is None:
            return {self.agent: (None, 0)}
        modes: dict[str, tuple[Mode | None, int]] = {mode: (mode, 0) for mode in MODES}
        for steps in self.finetune:
            modes[f"fine-tuned {steps:,}"] = (MODES[0], steps)
        return modes

    @property
    def sides(self) -> tuple[Side, ...]:
        """Sides that the cell is evaluated on; an agent trained on the test side only on that."""
        return ("test",) if self.source.side == "test" else ("train", "test")


def baseline_cells(folder: Path, source: SplitSource, eval_config: EvalConfig) -> list[Cell]:
    """Return the cells of the baselines for the tasks of a split."""
    tasks = {task for side in ("train", "test") for task in tasks_of(other_side(source, side))}
    eval_config = replace(eval_config, workers=1)  # scores do not depend on it
    return [
        Cell(folder, name, None, source, eval_config)
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
    assert isinstance(source, SplitSource)  # a study has splits alone
    if AGENTS[config.policy.agent].per_robot or source.side == "test":
        finetune = ()
    return Cell(folder, agent, config.seed, source, eval_config, config, tuple(finetune))


def matched_budget(config: RunConfig) -> RunConfig:
    """Return a run on test robots with the budget of environments and timesteps per train robot."""
    if side_of(config.source) == "train" or config.full_budget:
        return config
    num_test = len(members(config.source))
    num_train = len(members(other_side(config.source, "train")))
    total_timesteps = -(-config.ppo.total_timesteps * num_test // num_train)
    ppo = replace(config.ppo, total_timesteps=total_timesteps)
    return replace(config, ppo=ppo, num_envs=-(-config.num_envs * num_test // num_train))


def stored_results(cell: Cell) -> dict[str, submission.Submission]:
    """Return the episodes of a cell in the table of its study, by the names of ``Cell.modes``."""
    path = cell.study / submission.EPISODES
    results: dict[str, submission.Submission] = {}
    for each in submission.read_table(path) if path.is_file() else ():
        run = each.split.name, each.method, each.training_seed
        if run == (cell.split, cell.agent, cell.seed):
            _require_same(each, cell, f"{path}: {submission.name_of(each)}")
            results[submission.mode_of(each) or cell.agent] = each
    return results


def _require_same(stored: submission.Submission, cell: Cell, where: str) -> None:
    """Require that stored episodes are of the robots, the evaluation and the run of a cell."""
    split = split_of(cell.source)
    for what, theirs, ours in (
        ("set of robots", stored.split.id, split_id(split)),
        ("evaluation", stored.evaluation, _rules(cell, split)),
    ):
        if theirs != ours:
            raise TaskError(f"{where}: of another {what}; name another --out")
    if cell.config is not None and stored.config is not None:
        require_same_config(config_from(stored.config), _without_split(cell.config), where)


def _rules(cell: Cell, split: Split) -> dict[str, Any]:
    config = cell.eval_config
    goals = GoalConfig(seed=cell.source.goal_seed, tasks=config.tasks)
    return submission.rules_data(config.sim, config.episodes, config.seed, goals, split)


def _without_split(config: RunConfig) -> RunConfig:
    """Return a config without the text of its split, of which a submission has name and id."""
    assert isinstance(config.source, SplitSource)
    return replace(config, source=replace(config.source, split=""))


def require_cells(cells: Sequence[Cell]) -> None:
    """Require that the folders of cells have no other runs or episodes; write nothing."""
    for cell in cells:
        if cell.config is not None:
            require_open(cell.folder, cell.config, resume=True)
        stored_results(cell)


def do_cell(
    cell: Cell, execution: ExecutionConfig, show: Callable[[Subrun], ShowMetrics] | None = None
) -> None:
    """Train and evaluate a cell, or what remains of it. No other process may work on it.

    The episodes of a mode are written when it is evaluated. Policies are evaluated
    on the CPU, so that a machine without the GPU of the training gives the same scores.
    """
    done = stored_results(cell)
    if done.keys() >= cell.modes.keys():
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
    for name, (mode, steps) in cell.modes.items():
        if name in done:
            continue
        folder, config, sides = cell.folder, cell.config, cell.sides
        if config is not None and steps:
            folder, sides = folder / FINETUNED / str(steps), ("test",)
            config = finetuning_run(cell, config, steps)
            learn(folder, config)
        scores: list[Score] = []
        for side in sides:
            source = other_side(cell.source, side)
            if mode is None and not BASELINES[cell.agent].suits(tasks_of(source)):
                continue  # no robot of this side has a task of the baseline
            with stage(f"{cell.agent}{f' {name}' if mode else ''} on {side}", "episode"):
                if mode is not None:
                    scores += evaluate_run(folder, side, eval_config, mode)
                else:
                    scores += evaluate_baseline(cell.agent, source, eval_config)
        submission.append_submission(
            cell.study / submission.EPISODES, _submission(cell, name, scores)
        )


def finetuning_run(cell: Cell, config: RunConfig, steps: int) -> RunConfig:
    """Return the config of a cell's fine-tuning: on a CPU, in a simulator that CPUs run."""
    tuned = finetuning_config(
        config,
        other_side(cell.source, "test"),
        f"../../{CHECKPOINT}",
        {"total_timesteps": steps, "bf16": False, "compile": False},
    )
    return replace(tuned, sim=evaluation_simulator(config.sim), device="cpu")


def _submission(cell: Cell, name: str, scores: Sequence[Score]) -> submission.Submission:
    config, (mode, steps), split = cell.config, cell.modes[name], split_of(cell.source)
    training = data = None
    if config is not None:
        training = submission.Training(config.sim, config.ppo.total_timesteps, steps)
        data = msgspec.to_builtins(_without_split(config).as_data())
    return submission.make_submission(
        split,
        scores,
        method=cell.agent,
        mode=mode or "",
        training_seed=cell.seed,
        evaluation=_rules(cell, split),
        training=training,
        config=data,
    )


POLL = 2.0  # time between two checks of cells that another process works on [s]


Outcome = tuple[Cell, str]  # a cell and its error message, which is empty after success


def run_cells(
    cells: Sequence[Cell],
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None = None,
) -> Iterator[Outcome]:
    """Train and evaluate cells one after another, and yield their outcomes.

    Each is done by one process; this one waits at the end for the cells of others.
    """
    waiting, skipped = deque(cells), 0
    while waiting:
        cell = waiting.popleft()
        error = _do_locked(cell, execution, show)
        if error is not None:
            skipped = 0
            yield cell, error
            continue
        waiting.append(cell)
        skipped += 1
        if skipped >= len(waiting):
            time.sleep(POLL)
            skipped = 0


def _do_locked(
    cell: Cell, execution: ExecutionConfig, show: Callable[[Subrun], ShowMetrics] | None
) -> str | None:
    """Train and evaluate a cell and return its error; None if another process works on it."""
    try:
        cell.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(cell.folder / LOCK, timeout=0):
            do_cell(cell, execution, show)
    except Timeout:
        return None
    except MorphgenError as error:
        return str(error)
    except OSError as error:
        return f"{error.filename or cell.folder}: {error.strerror}"
    except Exception as error:  # such as a GPU out of memory: the other cells go on
        traceback.print_exc(file=sys.stderr)
        return f"{type(error).__name__}: {error}"
    return ""


TABLE, DATA = "table.md", "results.json"
MISSING = "missing"


def write_tables(folder: Path, cells: Sequence[Cell]) -> list[Path]:
    """Write Markdown and JSON of the cells of a study that are done; return their paths."""
    done: dict[str, submission.Submission] = {}
    missing: list[str] = []
    for cell in cells:
        results = stored_results(cell)
        done |= {submission.name_of(each): each for each in results.values()}
        seed = "" if cell.seed is None else f" seed {cell.seed}"
        modes = [mode for mode in cell.modes if mode not in results]
        if modes:
            which = f" ({', '.join(modes)})" if results else ""
            missing.append(f"{cell.split} {cell.agent}{seed}{which}")
    rows = result_rows(done)
    diverged = {name: sum(map(sum, (r.diverged for r in own.robots))) for name, own in done.items()}
    notes = [
        *(f"{MISSING}: {each}" for each in missing),
        *(f"{name}: {UNSTABLE}: {count}" for name, count in diverged.items() if count),
    ]
    lines = [result_tables(rows, "github"), NOTE, *(f"- {each}" for each in notes)]
    write_file(folder / TABLE, "\n".join(lines) + "\n")
    data = {"rows": rows_data(rows), MISSING: missing}
    write_file(folder / DATA, json.dumps(data, indent=2) + "\n")
    return [folder / name for name in (TABLE, DATA)]


@dataclass(frozen=True)
class ReplayedEpisode:
    """An episode of a submission, and what it gave when it was run again."""

    robot: RobotOutcomes
    number: int  # number of the episode, from 0
    again: tuple[bool, float]  # success and final distance [m]

    @property
    def agrees(self) -> bool:
        """Whether success and final distance [m] are those of the submission."""
        won, distance = self._outcome
        return won == self.again[0] and abs(distance - self.again[1]) <= TOLERANCE

    @property
    def _outcome(self) -> tuple[bool, float]:
        return self.robot.success[self.number], self.robot.distance[self.number]

    def __str__(self) -> str:
        """Return a line: the episode, and what it gives if that is something else."""
        own, again = (
            f"{'success' if won else 'failure'} at {distance:.4f} m"
            for won, distance in (self._outcome, self.again)
        )
        where = f"{self.robot.side} robot {self.robot.robot}, episode {self.number}"
        return f"{where}: {own}: {'agrees' if self.agrees else f'DIFFERS: again {again}'}"


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
    """Run random episodes of a submission again, alone if their controller allows it.

    If one ends otherwise, the whole evaluation is run: a batch of one rounds otherwise than that of
    the evaluation, which a policy may amplify.
    """
    rules = protocol_from(submission.evaluation, where)
    config = EvalConfig(rules.episodes, rules.simulator, rules.seed, 1, tuple(rules.goals.tasks))
    pairs = [(robot, i) for robot in submission.robots for i in range(len(robot.score))]
    rng = np.random.default_rng(seed)
    picked = sorted(rng.choice(len(pairs), min(count, len(pairs)), replace=False).tolist())
    source = split_source(split, goal_seed=rules.goals.seed, library=library)
    mode = submission.mode or "deterministic"
    run_alone: Callable[..., list[Episode]] | None = None
    if checkpoint is None and not submission.mode:
        run_whole = partial(evaluate_baseline, submission.method, config=config)
        baseline = BASELINES[submission.method]
        unfit = [each for each in submission.robots if not baseline.suits([each.task])]
        if unfit:
            each = f"{where}: {unfit[0].side} robot {unfit[0].robot}"
            raise BenchmarkError(f"{each}: {submission.method} is not for {unfit[0].task}")
        if baseline.is_independent:
            controller, tasks = baseline.make(config.seed), baseline.tasks
            run_alone = partial(episodes_alone, controller, Interface(), tasks=tasks)
    else:
        files = list(checkpoint_files(checkpoint_path(checkpoint or submission.method)))
        run_whole = partial(evaluate_checkpoints, files, config=config, mode=mode)
        if len(files) == 1 and mode == "deterministic":
            run, learner = read_checkpoint(files[0])
            policy = PolicyController(Policy(learner, mode, config.seed))
            run_alone = partial(episodes_alone, policy, run.interface)
    for side in SIDES:
        own = [pairs[i] for i in picked if pairs[i][0].side == side]
        of_side = replace(source, side=side)
        if run_alone and own:
            chosen = [(robot.robot, number) for robot, number in own]
            episodes = run_alone(of_side, config, chosen)
            again = [(each.success, each.distance) for each in episodes]
            found = list(map(ReplayedEpisode, *zip(*own, strict=True), again))
            if all(each.agrees for each in found):
                yield from found
                continue
            note(f"morphgen: {where}: episodes end otherwise alone; running the whole evaluation")
        outcomes = {score.robot: score.outcomes for score in run_whole(of_side)} if own else {}
        for robot, number in own:
            whole = outcomes[robot.robot]
            if len(robot.score) != len(whole.score):
                raise BenchmarkError(
                    f"{where}: {side} robot {robot.robot}: {len(robot.score)} episodes; its "
                    f"evaluation has {len(whole.score)}"
                )
            yield ReplayedEpisode(robot, number, (whole.success[number], whole.distance[number]))

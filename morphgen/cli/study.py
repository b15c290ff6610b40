"""``morphgen study``: train and score every agent with every seed on every split."""

from __future__ import annotations

import argparse
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, number, option
from morphgen.cli.progress import note, training_progress
from morphgen.cli.train import TRAINING_OPTIONS, execution_config, robots_to_train, run_config
from morphgen.errors import BenchmarkError, TaskError
from morphgen.rl.agents import AGENTS
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, evaluation_simulator

if TYPE_CHECKING:
    from morphgen.benchmark.scores.study import Cell
    from morphgen.rl.runs.checkpoint import RunConfig


PAPER = "paper"
"""Word for all splits of the benchmark."""


@command(
    "study",
    "train and score a matrix of agents, seeds and splits",
    option(
        "words SPLIT",
        "name of a split, its file or built folder; paper: the 15 splits of the benchmark",
        nargs="+",
    ),
    option(
        "--agents",
        "agents, separated by commas, with or without switches such as "
        "me-tf-symlog+task-reweighting; se@test is trained on the test robots; ablation: those of "
        "the paper (default: all agents)",
        default=",".join(AGENTS),
    ),
    option("--seeds", "such as 0..2 or 0,3", default="0..2"),
    option("--out DIR", "output folder", Path, default=Path("study")),
    number("--eval-steps", "number of control steps of each robot's evaluation", default=10_000),
    option(
        "--finetune N,...",
        "also fine-tune every policy of train robots on the test robots, with these numbers "
        "of control steps, such as 10000,30000",
        default="",
    ),
    flag("--report", "only write tables and curves of the finished cells"),
    opt.RAY,
    option(
        "--gpus N", "with --ray: GPUs per cell (default: 1 with --device cuda, else 0)", float
    ).needing("--ray"),
    *TRAINING_OPTIONS,
    opt.LIBRARY,
    details="A cell is an agent with a seed on a split, or a baseline on a split. The command "
    "trains and evaluates each cell, and writes tables and curves. Finished cells are skipped; "
    "several processes with one folder share the work. The exit code is 1 if a cell failed. "
    "All episodes are in episodes.csv.gz of the folder, which morphgen score reads.",
    examples=(
        "study paper --seeds 0..1 --steps 30e6 --finetune 10000,30000 --out results",
        "study interpolation/arm3/reach --agents se,me-mlp,me-tf --seeds 0..2 --out study",
        "study interpolation/arm3/reach --agents ablation",
    ),
    extra="rl",
)
def study(args: argparse.Namespace) -> int:
    """Train, evaluate, write tables, and print failures."""
    from morphgen.benchmark.scores.study import TABLE, require_cells, write_tables

    execution_config(args)  # refuses invalid options before the work
    cells = _cells(args)
    require_cells(cells)
    args.out.mkdir(parents=True, exist_ok=True)
    failures = 0 if args.report else _run_cells(args, cells)
    written = write_tables(args.out, cells)
    print((args.out / TABLE).read_text(encoding="utf-8"))
    for path in written:
        print(path)
    return int(failures > 0)


def _cells(args: argparse.Namespace) -> list[Cell]:
    """Return the cells of the study, baselines first."""
    from morphgen.benchmark.eval_protocol import EvalProtocol
    from morphgen.benchmark.scores.study import agent_cell, baseline_cells, matched_budget
    from morphgen.rl.config import parse_agents
    from morphgen.rl.evaluation import EvalConfig, episodes_for
    from morphgen.rl.runs.robot_source import other_side, tasks_of
    from morphgen.tasks.scenes.env_specs import GoalConfig, default_configs

    episode_steps = max(config.max_episode_steps for config in default_configs())
    num_episodes = episodes_for(args.eval_steps, episode_steps)
    sim = evaluation_simulator(args.sim or DEFAULT_SIMULATOR)
    # A study has no such options, which robots_to_train and run_config read.
    args.on, args.obstacles, args.seed = "train", False, 0
    agents, seeds = parse_agents(args.agents), _seeds(args.seeds)
    finetune = _finetune(args.finetune)
    cells: list[Cell] = []
    words: dict[str, str] = {}
    for name in dict.fromkeys(chain.from_iterable(map(_splits, args.words))):
        source = robots_to_train([name], args)
        opt.require_other_name(words, source.name, name)
        sides = tasks_of(source), tasks_of(other_side(source, "test"))
        tasks = opt.with_goal(default_configs(), args.goal, chain(*sides))
        eval_config = EvalConfig(num_episodes, sim, tasks=tasks)
        if sim in SIMULATORS.builtin:  # the episodes become submissions, whose number is limited
            EvalProtocol(sim, num_episodes, goals=GoalConfig(source.goal_seed, tasks))
        cells += baseline_cells(args.out, source, eval_config)
        for label, spec, side in agents:
            config = run_config(other_side(source, side), spec, args)
            for seed in seeds:
                seeded = matched_budget(replace(config, seed=seed))
                cell = agent_cell(args.out, label, seeded, eval_config, finetune)
                cells.append(cell)
                if not args.report:
                    _require_startable(cell, seeded, args)
    return cells


def _require_startable(cell: Cell, config: RunConfig, args: argparse.Namespace) -> None:
    """Require that training and fine-tuning of a cell can begin, before any of them does."""
    from morphgen.benchmark.scores.study import finetuning_run
    from morphgen.rl.runs.training import is_done, require_runnable, subruns_of
    from morphgen.tasks.registry import require_device

    parts = subruns_of(cell.folder, config)
    for part in parts:
        require_runnable(part.config)
    for steps in cell.finetune:
        try:
            require_runnable(finetuning_run(cell, config, steps))
        except TaskError as error:
            raise TaskError(f"--finetune {steps}: {error}") from error
    is_on_gpu = args.device != "cpu" and args.ray is None  # with Ray, other machines have the GPUs
    if is_on_gpu and not all(map(is_done, parts)):
        require_device(args.device)  # policies are evaluated on the CPU


def _splits(word: str) -> tuple[str, ...]:
    """Return the split that a word names, or the splits of the benchmark."""
    from morphgen.splits.split_file import split_names

    return tuple(split_names()) if word == PAPER and not Path(word).exists() else (word,)


def _finetune(text: str) -> list[int]:
    """Read ``10000,30000``."""
    parts = [part.strip() for part in text.split(",")] if text else []
    if not all(part.isdecimal() and int(part) for part in parts):
        raise TaskError(f"--finetune {text}: expected numbers of steps, such as 10000,30000")
    return sorted({int(part) for part in parts})


def _seeds(text: str) -> list[int]:
    """Read ``0..2`` or ``0,3``."""
    seeds: list[int] = []
    for part in text.split(","):
        first, dots, last = part.partition("..")
        if not first.isdecimal() or (dots and not last.isdecimal()):
            raise TaskError(f"--seeds {text}: expected such as 0..2 or 0,3")
        seeds += range(int(first), int(last or first) + 1)
    if not seeds or len(set(seeds)) < len(seeds):
        raise TaskError(f"--seeds {text}: expected at least one seed, and none twice")
    return seeds


def _run_cells(args: argparse.Namespace, cells: list[Cell]) -> int:
    """Run the cells and return how many failed."""
    from morphgen.benchmark.scores.study import run_cells, run_cells_on_ray

    failures = 0
    execution = execution_config(args)
    with training_progress("if the same command is given again") as show:
        if args.ray is None:
            outcomes = run_cells(cells, execution, show.training)
        else:
            gpus = args.gpus if args.gpus is not None else float(args.device != "cpu")
            outcomes = run_cells_on_ray(cells, execution, args.ray or None, gpus=gpus)
        for done, (cell, error) in enumerate(outcomes, 1):
            show.close()
            seed = "" if cell.seed is None else f" seed {cell.seed}"
            state = f"failed: {error}" if error else "done"
            line = f"{done} of {len(cells)}: {cell.split} {cell.agent}{seed} {state}"
            note(line)
            failures += bool(error)
    return failures


MODES = ("deterministic", "stochastic", "all")


@command(
    "score",
    "compute tables of results from the episodes of studies and evaluations",
    option(
        "files FILE",
        "submission, table of a study, or a folder with such files at any depth",
        Path,
        nargs="+",
    ),
    option(
        "--mode",
        "policies that act by the mean of their actions, that sample them, or both",
        choices=MODES,
        default=MODES[0],
    ),
    flag("--markdown", "print the tables as Markdown"),
    opt.JSON,
    details="A row has a method over all of its training seeds. IQM is the interquartile mean over "
    "seeds and robots, with a 95% bootstrap interval over the seeds if there are two or more. A "
    "success rate has a 95% Wilson interval over all episodes. The last column of a side is the "
    "difference to jacobian (reach) or scripted (push) in the same episodes, with a 95% bootstrap "
    "interval over the episodes of each robot. Splits that come with morphgen are compared by "
    "their id and the hashes of their robots.",
    examples=(
        "score results/reach-30m",
        "score results/reach-24m results/graph-ablation --markdown",
    ),
    extra="rl",
)
def score(args: argparse.Namespace) -> None:
    """Print a table for every split and task."""
    from morphgen.benchmark.scores.results import NOTE, result_rows, result_tables, rows_data
    from morphgen.benchmark.scores.submission import read_submissions

    submissions = read_submissions(args.files)
    modes = {"", args.mode} if args.mode != "all" else {each.mode for each in submissions.values()}
    found = {where: each for where, each in submissions.items() if each.mode in modes}
    if not found:
        raise BenchmarkError(
            f"--mode {args.mode}: none of the {len(submissions)} submissions acts so; expected "
            f"--mode {' or '.join(mode for mode in MODES if mode != args.mode)}"
        )
    rows = result_rows(found)
    style = "github" if args.markdown else "simple"
    opt.print_result(args, rows_data(rows), lambda: f"{result_tables(rows, style)}\n{NOTE}")

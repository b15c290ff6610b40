"""``morphgen train``, ``finetune`` and ``study``."""

from __future__ import annotations

import argparse
import shlex
import sys
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from types import SimpleNamespace

from morphgen.api import training
from morphgen.benchmark.scores import study as studies
from morphgen.benchmark.scores.submission import EvalProtocol
from morphgen.cli import options as opt
from morphgen.cli.progress import note, status, training_progress
from morphgen.errors import TaskError, nearest, shortened
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import OBSERVATION_SWITCHES, SWITCHES, PPOConfig, parse_agent, parse_agents
from morphgen.rl.evaluation import EvalConfig
from morphgen.rl.runs.checkpoint import RunConfig, read_checkpoint
from morphgen.rl.runs.robot_source import (
    GrammarSource,
    OneRobot,
    RecordedSource,
    Source,
    other_side,
    tasks_of,
)
from morphgen.rl.runs.training import (
    ExecutionConfig,
    finetuning_config,
    is_done,
    require_runnable,
    subruns_of,
)
from morphgen.rl.shipped_policies import POLICIES
from morphgen.splits.split import read_split, split_names
from morphgen.tasks.registry import (
    DEFAULT_SIMULATOR,
    SIMULATORS,
    TASKS,
    evaluation_simulator,
    require_device,
)
from morphgen.tasks.scenes.env_specs import IN_EVERY_FILE, GoalConfig, default_configs

RESUME = "with --resume"
FINETUNING_STEPS = 100_000  # number of control steps of `finetune` by default
FINETUNING_ENVS = 64  # number of environments of `finetune` by default


def agent_text(args: argparse.Namespace) -> str:
    """Return the agent with the switches that were given."""
    switches = dict.fromkeys(filter(None, args.observe.split(",")), True)
    for name in switches:
        if name not in OBSERVATION_SWITCHES:
            raise TaskError(f"--observe {name}{nearest(name, OBSERVATION_SWITCHES)}")
    for name in set(SWITCHES).difference(OBSERVATION_SWITCHES):
        if (value := getattr(args, name.replace("-", "_"))) is not None:
            switches[name] = value
    spec = parse_agent(args.agent)
    return str(replace(spec, switches={**spec.switches, **switches}))


def train(args: argparse.Namespace) -> None:
    """Train and print the paths of the checkpoints."""
    args.agent = agent_text(args)
    with training_progress(RESUME) as display:
        given = opt.arguments(args, training.train)
        run = training.train(" ".join(args.words), show=display.training, **given)
    print_run(run, args.minutes)


def print_run(run: training.TrainingRun, minutes: int | None) -> None:
    """Print the paths of the checkpoints, and say how to go on."""
    if text := str(run):
        print(text)
    if run.unfinished:
        parts = len(run.parts)
        what = f" with {run.unfinished} of {parts} robots left" * (parts > 1)
        note(f"stopped after {minutes} minutes{what}; it continues with --resume")
    else:
        note(_next_command(run))


def _next_command(run: training.TrainingRun) -> str:
    """Return lines that say how to score or watch what was trained."""
    source, folder = run.config.source, str(run.folder)
    # Only the script that registered a task can play it.
    program = "morphgen"
    if not all(map(TASKS.is_installed, tasks_of(source))):
        program = f"python {shlex.quote(sys.argv[0])}"
    score = f"{program} eval {shlex.quote(folder)}"
    if isinstance(source, GrammarSource):
        return f"score it on fresh robots: {score}"
    if isinstance(source, RecordedSource):
        return f"score it on other robots: {score} --split SPLIT"
    if isinstance(source, OneRobot):
        words = [source.task, source.name, *["--obstacles"] * source.obstacles]
        words += ["--policy", folder, "--sim", run.config.sim]
        words += chain.from_iterable(("--library", str(each)) for each in source.library)
        score += f"\nwatch it: {program} play {shlex.join(words)} --out episode.mp4"
    return f"score it: {score}"


def finetune(args: argparse.Namespace) -> None:
    """Train and print the path of the checkpoint."""
    file = training.one_checkpoint(args.checkpoint)
    shipped = args.checkpoint in POLICIES
    parent = Path("runs") / args.checkpoint if shipped else file.parent
    folder = args.out or parent / "finetuned" / f"{args.on}-seed{args.seed}"
    with training_progress(RESUME) as display:
        given = SimpleNamespace(**vars(args), show=display.training)
        run = training.train_run(folder, _finetuning_config(file, folder, args), given)
    print_run(run, args.minutes)


def _finetuning_config(file: Path, folder: Path, args: argparse.Namespace) -> RunConfig:
    initial, _ = read_checkpoint(file)
    resumed = training.resumed_config(folder, resume=args.resume)
    steps, envs, sim = (
        (resumed.ppo.total_timesteps, resumed.num_envs, resumed.sim)
        if resumed
        else (FINETUNING_STEPS, FINETUNING_ENVS, initial.sim)
    )
    source: Source
    if args.words:
        given = SimpleNamespace(**vars(args), robots=" ".join(args.words))
        source = training.named_source(given, args.on)
    else:
        source = other_side(initial.source, args.on)  # drawn robots have none
    changes = training.read_constants(args.constants)
    if unknown := set(changes) - {field.name for field in fields(PPOConfig)}:
        raise TaskError(f"--set {min(unknown)}: the networks are those of the checkpoint")
    switches = {"bf16": args.bf16, "compile": args.compile}
    changes |= {name: value for name, value in switches.items() if value is not None}
    changes |= {"total_timesteps": args.steps or steps, "curriculum": args.curriculum}
    return replace(
        finetuning_config(initial, source, training.path_from(folder, file), changes),
        seed=args.seed,
        sim=args.sim or sim,
        num_envs=args.envs or envs,
        device=args.device,
        tasks=training.with_goal(initial.tasks, args.goal, tasks_of(source)),
    )


PAPER = "paper"  # word for all splits of the benchmark


def study(args: argparse.Namespace) -> int:
    """Train, evaluate, write tables, and print failures."""
    execution = ExecutionConfig(args.workers, args.tensorboard)
    cells = _cells(args)
    studies.require_cells(cells)
    args.out.mkdir(parents=True, exist_ok=True)
    failures = 0 if args.report else _run_cells(args, cells, execution)
    with status(args, "scoring"):
        written = studies.write_tables(args.out, cells)
    print((args.out / studies.TABLE).read_text(encoding="utf-8"))
    for path in written:
        print(path)
    return int(failures > 0)


def _cells(args: argparse.Namespace) -> list[studies.Cell]:
    """Return the cells of the study, baselines first."""
    sim = evaluation_simulator(args.sim or DEFAULT_SIMULATOR)
    options = SimpleNamespace(**vars(args), seed=0)
    agents, seeds = parse_agents(args.agents or ",".join(AGENTS)), _seeds(args.seeds)
    finetune = sorted(set(args.finetune))
    cells: list[studies.Cell] = []
    words: dict[str, str] = {}
    for name in dict.fromkeys(chain.from_iterable(map(_splits, args.words))):
        source = training.split_side(name, "train", args.goal_seed, args.library)
        opt.require_other_name(words, source.name, name)
        sides = tasks_of(source), tasks_of(other_side(source, "test"))
        tasks = training.with_goal(default_configs(), args.goal, chain(*sides))
        eval_config = EvalConfig(args.episodes, sim, tasks=tasks)
        if sim in SIMULATORS.builtin:  # the episodes become submissions, whose number is limited
            EvalProtocol(sim, args.episodes, goals=GoalConfig(source.goal_seed, tasks))
        cells += studies.baseline_cells(args.out, source, eval_config)
        for label, spec, side in agents:
            config = training.run_config(other_side(source, side), spec, options)
            for seed in seeds:
                seeded = studies.matched_budget(replace(config, seed=seed))
                cell = studies.agent_cell(args.out, label, seeded, eval_config, finetune)
                cells.append(cell)
                if not args.report:
                    _require_startable(cell, seeded, args)
    return cells


def _require_startable(cell: studies.Cell, config: RunConfig, args: argparse.Namespace) -> None:
    """Require that training and fine-tuning of a cell can begin, before any of them does."""
    parts = subruns_of(cell.folder, config)
    for part in parts:
        require_runnable(part.config)
    for steps in cell.finetune:
        try:
            require_runnable(studies.finetuning_run(cell, config, steps))
        except TaskError as error:
            raise TaskError(f"--finetune {steps}: {error}") from error
    if args.device != "cpu" and not all(map(is_done, parts)):
        require_device(args.device)  # policies are evaluated on the CPU


def _splits(word: str) -> tuple[str, ...]:
    """Return the split that a word names, or the splits of the benchmark: of reach and push."""
    if word != PAPER or Path(word).exists():
        return (word,)
    tasks = {name: {member.task for member in read_split(name).train} for name in split_names()}
    return tuple(name for name, used in tasks.items() if used <= {*IN_EVERY_FILE})


_SEED_DIGITS = 18  # largest number of digits of a seed: files hold whole numbers below 2^63
_MAX_SEEDS = 1000  # largest number of seeds of a range


def _seeds(text: str) -> list[int]:
    """Read ``0..2`` or ``0,3``."""
    seeds: list[int] = []
    for part in text.split(","):
        first, dots, last = part.partition("..")
        ends = [first, last if dots else first]
        if not all(end.isdecimal() and len(end) <= _SEED_DIGITS for end in ends):
            valid = f"such as 0..2 or 0,3, with at most {_SEED_DIGITS} digits"
            raise TaskError(f"--seeds {shortened(text)}: expected {valid}")
        low, high = map(int, ends)
        if high - low >= _MAX_SEEDS:
            raise TaskError(f"--seeds {text}: expected at most {_MAX_SEEDS} seeds")
        seeds += range(low, high + 1)
    if not seeds or len(set(seeds)) < len(seeds):
        raise TaskError(f"--seeds {text}: expected at least one seed, and none twice")
    return seeds


def _run_cells(
    args: argparse.Namespace, cells: list[studies.Cell], execution: ExecutionConfig
) -> int:
    """Run the cells and return how many failed."""
    failures = 0
    with training_progress("if the same command is given again") as show:
        outcomes = studies.run_cells(cells, execution, show.training)
        for done, (cell, error) in enumerate(outcomes, 1):
            show.close()
            seed = "" if cell.seed is None else f" seed {cell.seed}"
            state = f"failed: {error}" if error else "done"
            line = f"{done} of {len(cells)}: {cell.split} {cell.agent}{seed} {state}"
            note(line)
            failures += bool(error)
    return failures

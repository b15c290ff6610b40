"""``morphgen study``: train and score every agent with every seed on every split."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_library
from morphgen.cli.progress import shown
from morphgen.cli.train import add_training, count, execution_of
from morphgen.rl.agents import AGENTS

if TYPE_CHECKING:
    from morphgen.rl.study import Cell


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "study",
        help="train and score a matrix of agents, seeds and splits",
        description="Train and evaluate every agent with every seed on every split, and the "
        "baselines, and write tables and curves. Finished cells are not repeated; "
        "several processes started on one folder share the work. Exit code 1 "
        "if a cell failed.",
        epilog="examples: morphgen study interpolation/arm3/reach --agents se,me-mlp,me-tf "
        "--seeds 0..2 --out study; morphgen study interpolation/arm3/reach --agents ablation",
    )
    parser.add_argument(
        "words", nargs="+", metavar="SPLIT", help="a split's name, file or built folder"
    )
    parser.add_argument(
        "--agents",
        default=",".join(AGENTS),
        help="separated by commas; each may have switches, such as me-tf-symlog+task-reweighting, "
        "and se@test is trained on the test robots; ablation: the paper's (default: all)",
    )
    parser.add_argument("--seeds", default="0..2", help="such as 0..2 or 0,3 (default: 0..2)")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("study"))
    parser.add_argument(
        "--eval-steps", type=count, default=10_000, help="of each robot (default: 10,000)"
    )
    parser.add_argument(
        "--report", action="store_true", help="only write tables and curves of the finished cells"
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        nargs="?",
        const="",
        help="run on the Ray cluster at this address (without one: on a local Ray)",
    )
    parser.add_argument(
        "--gpus",
        type=float,
        help="with --ray: GPUs per cell (default: 1 with --device cuda, else 0)",
    )
    add_training(parser, steps=2e6, envs=128)
    add_library(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train, evaluate, write tables, and print failures."""
    from morphgen.rl.study import read_scores, require_cells
    from morphgen.rl.study_report import TABLE, write_tables

    execution_of(args)
    cells = cells_of(args)
    require_cells(cells)
    args.out.mkdir(parents=True, exist_ok=True)
    failed = 0 if args.report else _work(args, cells)
    written = write_tables(args.out, {cell: read_scores(cell) for cell in cells})
    print((args.out / TABLE).read_text(encoding="utf-8"))
    for path in written:
        print(path)
    return int(failed > 0)


def cells_of(args: argparse.Namespace) -> list[Cell]:
    """Return the cells of the study, baselines first.

    Raises:
        MorphgenError: If a split, agent or seed is invalid, or a run could not begin.
    """
    from dataclasses import replace

    from morphgen.cli.train import config_of, source_of
    from morphgen.errors import TaskError
    from morphgen.rl.agent_spec import parse_agents
    from morphgen.rl.evaluation import EvalConfig, episodes_for
    from morphgen.rl.robot_source import other_side
    from morphgen.rl.study import agent_cell, baseline_cells, matched_budget
    from morphgen.rl.training import require_device, require_runnable, subruns_of
    from morphgen.tasks.env_specs import default_configs

    if args.gpus is not None and args.ray is None:
        raise TaskError(f"--gpus {args.gpus:g} goes with --ray; without it, say --device cuda")
    if args.ray is None and not args.report:
        require_device(args.device)
    longest = max(config.max_episode_steps for config in default_configs())
    eval_config = EvalConfig(episodes_for(args.eval_steps, longest), args.sim)
    args.on, args.obstacles = "train", False
    agents, seeds = parse_agents(args.agents), seeds_of(args.seeds)
    made: list[Cell] = []
    for name in dict.fromkeys(args.words):
        source = source_of([name], args)
        made += baseline_cells(args.out, source, eval_config)
        for label, spec, side in agents:
            for seed in seeds:
                config = config_of(other_side(source, side), spec, _with(args, seed))
                config = matched_budget(replace(config, seed=seed))
                for part in () if args.report else subruns_of(args.out, config):
                    require_runnable(part.config)
                made.append(agent_cell(args.out, label, config, eval_config))
    return made


def seeds_of(text: str) -> list[int]:
    """Read ``0..2`` or ``0,3``.

    Raises:
        TaskError: If it is neither.
    """
    from morphgen.errors import TaskError

    found: list[int] = []
    for part in text.split(","):
        first, dots, last = part.partition("..")
        if not first.isdecimal() or (dots and not last.isdecimal()):
            raise TaskError(f"--seeds {text}: expected such as 0..2 or 0,3")
        found += range(int(first), int(last or first) + 1)
    if not found or len(set(found)) < len(found):
        raise TaskError(f"--seeds {text}: expected at least one seed, and none twice")
    return found


def _with(args: argparse.Namespace, seed: int) -> argparse.Namespace:
    return argparse.Namespace(**{**vars(args), "seed": seed})


def _work(args: argparse.Namespace, cells: list[Cell]) -> int:
    """Do the cells and return how many failed."""
    from morphgen.rl.study import run_cells, run_cells_on_ray

    failed = 0
    with shown("if the same command is given again") as show:
        if args.ray is None:
            outcomes = run_cells(cells, execution_of(args), show, show.counting)
        else:
            gpus = args.gpus if args.gpus is not None else float(args.device != "cpu")
            outcomes = run_cells_on_ray(args.ray or None, gpus=gpus)(cells, execution_of(args))
        for done, outcome in enumerate(outcomes, 1):
            show.close()
            cell = outcome.cell
            what = f"{cell.split} {cell.agent}" + (
                "" if cell.seed is None else f" seed {cell.seed}"
            )
            state = f"failed: {outcome.error}" if outcome.error else "done"
            print(f"{done} of {len(cells)}: {what} {state}", file=sys.stderr, flush=True)
            failed += bool(outcome.error)
    return failed

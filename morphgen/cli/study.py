"""``morphgen study``: agents times seeds times splits, into tables and curves."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_library
from morphgen.cli.progress import shown
from morphgen.cli.train import add_training, count, way_of

if TYPE_CHECKING:
    from morphgen.rl.study import Cell


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "study",
        help="train and score a matrix of agents, seeds and splits",
        description="Train and evaluate every agent with every seed on every split, beside the "
        "reference controllers, and write tables and curves. What is done is not done again; "
        "started several times at once on one folder, the processes share the work. Exit code 1 "
        "if a cell failed.",
        epilog="examples: morphgen study interpolation/arm3/reach --agents se,me-mlp,me-tf "
        "--seeds 0..2 --out study; morphgen study interpolation/arm3/reach --agents ablation",
    )
    parser.add_argument(
        "words", nargs="+", metavar="SPLIT", help="a split's name, file or built folder"
    )
    parser.add_argument(
        "--agents",
        default="se,me-mlp,me-tf",
        help="parted by commas; each may have switches, such as me-tf-symlog+task-reweighting, and "
        "se@test is trained on the test robots; ablation: the paper's (default: se,me-mlp,me-tf)",
    )
    parser.add_argument("--seeds", default="0..2", help="such as 0..2 or 0,3 (default: 0..2)")
    parser.add_argument("--out", metavar="DIR", type=Path, default=Path("study"))
    parser.add_argument(
        "--eval-steps", type=count, default=10_000, help="of each robot (default: 10,000)"
    )
    parser.add_argument(
        "--report", action="store_true", help="only write tables and curves of what is there"
    )
    parser.add_argument(
        "--ray",
        metavar="ADDRESS",
        nargs="?",
        const="",
        help="work on the Ray cluster at this address (without one: on a local Ray)",
    )
    parser.add_argument(
        "--gpus", type=float, help="with --ray: of a cell (default: 1 with --device cuda, else 0)"
    )
    add_training(parser, steps=2e6, envs=128)
    add_library(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Work, write tables, and say what failed."""
    from morphgen.rl.study import read_scores, require_cells
    from morphgen.rl.tables import TABLE, write_tables

    way_of(args)
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
    """The matrix, references first.

    Raises:
        MorphgenError: If a split, agent or seed is none, or a run could not begin.
    """
    from dataclasses import replace

    from morphgen.cli.train import config_of, source_of
    from morphgen.errors import TaskError
    from morphgen.rl.evaluation import Exam, episodes_for
    from morphgen.rl.sources import other_side
    from morphgen.rl.study import agent_cell, matched_budget, reference_cells
    from morphgen.rl.training import parts_of, require_device, require_runnable
    from morphgen.rl.variants import parse_agents
    from morphgen.tasks.env_specs import default_configs

    if args.gpus is not None and args.ray is None:
        raise TaskError(f"--gpus {args.gpus:g} goes with --ray; without it, say --device cuda")
    if args.ray is None and not args.report:
        require_device(args.device)
    exam = Exam(
        episodes_for(args.eval_steps, max(each.steps for each in default_configs())), args.sim
    )
    args.on, args.obstacles = "train", False
    agents, seeds = parse_agents(args.agents), seeds_of(args.seeds)
    made: list[Cell] = []
    for name in dict.fromkeys(args.words):
        source = source_of([name], args)
        made += reference_cells(args.out, source, exam)
        for text, variant, side in agents:
            for seed in seeds:
                config = config_of(other_side(source, side), variant, _with(args, seed))
                config = matched_budget(replace(config, seed=seed))
                for part in () if args.report else parts_of(args.out, config):
                    require_runnable(part.config)
                made.append(agent_cell(args.out, text, config, exam))
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
    """Do what is to do; returns how many cells failed."""
    from morphgen.rl.study import work_here, work_on_ray

    failed = 0
    with shown("if the same command is given again") as show:
        if args.ray is None:
            outcomes = work_here(cells, way_of(args), show, show.counting)
        else:
            gpus = args.gpus if args.gpus is not None else float(args.device != "cpu")
            outcomes = work_on_ray(args.ray or None, gpus=gpus)(cells, way_of(args))
        for done, outcome in enumerate(outcomes, 1):
            show.close()
            cell = outcome.cell
            what = f"{cell.split} {cell.agent}" + (
                "" if cell.seed is None else f" seed {cell.seed}"
            )
            state = f"failed: {outcome.why}" if outcome.why else "done"
            print(f"{done} of {len(cells)}: {what} {state}", file=sys.stderr, flush=True)
            failed += bool(outcome.why)
    return failed

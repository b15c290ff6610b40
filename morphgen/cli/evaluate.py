"""``morphgen eval``: score a policy or a baseline on each robot."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_json, add_library, add_sim
from morphgen.cli.progress import Shower
from morphgen.cli.train import count, require_words
from morphgen.rl.baselines import BASELINES

if TYPE_CHECKING:
    from morphgen.benchmark.split import Side
    from morphgen.rl.evaluation import EvalConfig, StartProgress
    from morphgen.rl.inference import Mode
    from morphgen.rl.robot_source import RobotSource
    from morphgen.rl.runs import RunConfig
    from morphgen.rl.scores import Score


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "eval",
        help="score a trained policy or a baseline, robot by robot",
        description="Run episodes of every robot and print scores with 95% bootstrap intervals "
        "over episodes. The score of reach is relative to the random policy; that of push is the "
        "success rate.",
        epilog="examples: morphgen eval runs/interpolation/arm3/reach/me-tf/seed0 --on test; "
        "morphgen eval ik --split interpolation/arm3/reach",
    )
    parser.add_argument(
        "checkpoint", help=f"a checkpoint or a run's folder; or one of {', '.join(BASELINES)}"
    )
    parser.add_argument(
        "--split",
        dest="words",
        nargs="+",
        metavar="SPLIT",
        default=[],
        help="robots for a baseline, or instead of the checkpoint's: as for morphgen train",
    )
    parser.add_argument("--on", choices=["train", "test"], help="side of the split (default: both)")
    parser.add_argument("--obstacles", action="store_true", help="one robot: among obstacles")
    parser.add_argument("--mode", choices=["deterministic", "stochastic"], help="default: both")
    amount = parser.add_mutually_exclusive_group()
    amount.add_argument("--episodes", type=int, help="least number of episodes per robot")
    amount.add_argument(
        "--steps",
        type=count,
        default=10_000,
        help="control steps per robot, in episodes of full length (default: 10,000)",
    )
    add_sim(parser, None)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episodes (default: 0)")
    parser.add_argument(
        "--goal-seed", type=int, help="with --split: of all goals (default: as shipped, else 0)"
    )
    parser.add_argument("--out", metavar="FILE", type=Path, help="a table: .csv, .json or .md")
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Evaluate and print."""
    from morphgen.rl.eval_report import require_table, score_table, summary, write_scores
    from morphgen.rl.scores import scores_to_json

    if args.out is not None:
        require_table(args.out)
    found = _baselines(args) if args.checkpoint in BASELINES else _policies(args)
    if args.json:
        print(json.dumps({mode: scores_to_json(scores) for mode, scores in found.items()}))
    else:
        print(score_table(found))
        print(summary(found))
    if args.out is not None:
        write_scores(args.out, found)
    return 0


def _baselines(args: argparse.Namespace) -> dict[str, list[Score]]:
    from morphgen.errors import TaskError
    from morphgen.rl.evaluation import EvalConfig, evaluate_baseline

    if not args.words:
        raise TaskError(f"{args.checkpoint}: name its robots with --split")
    if args.mode or args.device != "cpu":
        option = "--mode" if args.mode else "--device"
        raise TaskError(f"{option} is for policies; {args.checkpoint} has none")
    sources = _sources(args)
    config = EvalConfig(_episodes(args), args.sim or "pybullet", args.seed, args.workers)
    with closing(Shower()) as shower:
        found = [
            evaluate_baseline(
                args.checkpoint, source, config, progress=shower.counting(source.side)
            )
            for source in sources
        ]
    return {args.checkpoint: [score for scores in found for score in scores]}


def _policies(args: argparse.Namespace) -> dict[str, list[Score]]:
    from morphgen.rl.inference import MODES
    from morphgen.rl.runs import read_checkpoint
    from morphgen.rl.training import checkpoint_files, require_device

    require_words(args)
    require_device(args.device)
    files = list(checkpoint_files(Path(args.checkpoint)))
    for file in files:
        config, learner = read_checkpoint(file)
        if learner["update"] < config.num_updates:
            print(
                f"morphgen: {file} is not finished: update {learner['update']} of "
                f"{config.num_updates}",
                file=sys.stderr,
            )
    modes: tuple[Mode, ...] = (args.mode,) if args.mode else MODES
    with closing(Shower()) as shower:
        return {mode: _policy(args, files, config, mode, shower.counting) for mode in modes}


def _policy(
    args: argparse.Namespace, files: list[Path], config: RunConfig, mode: Mode, start: StartProgress
) -> list[Score]:
    from morphgen.rl.evaluation import evaluate_checkpoints, evaluate_run

    path, eval_config = Path(args.checkpoint), _eval_config(args, config)
    if args.words:
        sources = _sources(args)
        found = [
            evaluate_checkpoints(
                files,
                one,
                eval_config,
                mode,
                device=args.device,
                progress=start(f"{mode} on {one.side}"),
            )
            for one in sources
        ]
    else:
        sides: tuple[Side, ...] = ("train", "test") if config.source.split else ("train",)
        wanted = sides if args.on is None else (args.on,)
        found = [
            evaluate_run(
                path,
                side,
                eval_config,
                mode,
                device=args.device,
                progress=start(f"{mode} on {side}"),
            )
            for side in wanted
        ]
    return [score for scores in found for score in scores]


def _eval_config(args: argparse.Namespace, config: RunConfig) -> EvalConfig:
    from dataclasses import replace

    from morphgen.rl.evaluation import eval_config_of

    found = eval_config_of(config, _episodes(args), seed=args.seed, workers=args.workers)
    return replace(found, sim=args.sim) if args.sim else found


def _episodes(args: argparse.Namespace) -> int:
    from morphgen.rl.evaluation import episodes_for
    from morphgen.tasks.env_specs import default_configs

    if args.episodes is not None:
        return int(args.episodes)
    return episodes_for(args.steps, max(each.max_episode_steps for each in default_configs()))


def _sources(args: argparse.Namespace) -> list[RobotSource]:
    from morphgen.cli.train import source_of
    from morphgen.rl.robot_source import other_side

    args.on, wanted = "train", args.on
    source = source_of(args.words, args)
    args.on = wanted
    if not source.split:
        return [other_side(source, wanted or "train")]
    sides: tuple[Side, ...] = ("train", "test") if wanted is None else (wanted,)
    return [other_side(source, side) for side in sides]

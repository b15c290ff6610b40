"""``morphgen finetune``: train a trained policy further, on other robots."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.cli.options import Subparsers, add_library, add_sim
from morphgen.cli.train import OF_NETWORKS, add_learning, require_words, trained

if TYPE_CHECKING:
    from morphgen.rl.runs import RunConfig


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "finetune",
        help="train a policy further, on the test robots of its split",
        description="Begin a run with the networks of a checkpoint. Agent and algorithm are the "
        "checkpoint's unless given; optimiser and schedule begin anew.",
        epilog="example: morphgen finetune runs/interpolation/arm3/reach/me-tf/seed0 --on test "
        "--steps 30000",
    )
    parser.add_argument("checkpoint", type=Path, help="a checkpoint or a run's folder")
    parser.add_argument(
        "--split",
        dest="words",
        nargs="+",
        metavar="SPLIT",
        default=[],
        help="other robots than those of the checkpoint's split: as for morphgen train",
    )
    parser.add_argument(
        "--on", choices=["train", "test"], default="test", help="side of the split (default: test)"
    )
    parser.add_argument("--obstacles", action="store_true", help="one robot: among obstacles")
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    add_sim(parser, None)
    parser.add_argument(
        "--goal-seed",
        type=int,
        help="with --split: seed of all goals (default: as shipped, else 0)",
    )
    parser.add_argument(
        "--out", metavar="DIR", type=Path, help="default: finetuned/SIDE-seedN in the run's folder"
    )
    parser.add_argument("--resume", action="store_true", help="continue the run in the folder")
    for name, meaning in OF_NETWORKS.items():
        parser.add_argument(
            f"--{name}",
            action=argparse.BooleanOptionalAction,
            default=None,
            help=f"{meaning} (default: as the checkpoint's run)",
        )
    parser.add_argument(
        "--curriculum",
        action=argparse.BooleanOptionalAction,
        default=False,
        help="push: move the line from near to far again (default: it stays at its final place)",
    )
    add_learning(parser, steps=30_000, envs=16)
    add_library(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Train and print the path of the checkpoint."""
    from morphgen.errors import TaskError
    from morphgen.rl.runs import CHECKPOINT
    from morphgen.rl.training import checkpoint_files

    require_words(args)
    files = list(checkpoint_files(args.checkpoint))
    if len(files) > 1:
        raise TaskError(
            f"{args.checkpoint} has {len(files)} policies: name one, such as {files[0]}"
        )
    folder = args.out or files[0].parent / "finetuned" / f"{args.on}-seed{args.seed}"
    for part in trained(folder, _config(files[0], args), args):
        print(part.folder / CHECKPOINT)
    return 0


def _config(file: Path, args: argparse.Namespace) -> RunConfig:
    from dataclasses import fields, replace

    from morphgen.cli.train import source_of
    from morphgen.errors import TaskError
    from morphgen.rl.agent_spec import parse_constants
    from morphgen.rl.config import PPOConfig
    from morphgen.rl.robot_source import other_side
    from morphgen.rl.runs import read_checkpoint

    began, _ = read_checkpoint(file)
    source = source_of(args.words, args) if args.words else other_side(began.source, args.on)
    changes: dict[str, Any] = parse_constants(args.set)
    fixed = set(changes) - {field.name for field in fields(PPOConfig)}
    if fixed:
        raise TaskError(f"--set {min(fixed)}: the networks are those of the checkpoint")
    asked = {name: getattr(args, name) for name in OF_NETWORKS}
    changes |= {name: value for name, value in asked.items() if value is not None}
    changes |= {"total_timesteps": args.steps, "curriculum": args.curriculum}
    return replace(
        began,
        source=source,
        ppo=replace(began.ppo, **changes),
        seed=args.seed,
        sim=args.sim or began.sim,
        num_envs=args.envs,
        device=args.device,
        initial_checkpoint=str(file.resolve()),
    )

"""``morphgen finetune``: train a policy further."""

from __future__ import annotations

import argparse
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.cli import options as opt
from morphgen.cli.agent_options import on_off
from morphgen.cli.command import command, option, path_option
from morphgen.cli.train import MINUTES, NETWORK_SWITCHES, RESUME, learning_options, run_training
from morphgen.cli.training_robots import (
    GOAL_SEED,
    SIDES,
    require_split_for_options,
    robots_to_train,
    split_option,
)
from morphgen.errors import TaskError
from morphgen.rl.shipped_policies import POLICIES, checkpoint_path

if TYPE_CHECKING:
    from morphgen.rl.runs import RunConfig


@command(
    "finetune",
    "train a policy further, by default on the test robots of its split",
    option("checkpoint", help=f"a checkpoint, a run folder, or {', '.join(POLICIES)}"),
    split_option("other robots than those of the checkpoint's split"),
    option("--on", choices=SIDES, default="test", help="side of the split"),
    opt.OBSTACLES,
    opt.SEED,
    opt.sim_option("that of the training"),
    GOAL_SEED,
    opt.goal_option("that of the training"),
    path_option(
        "--out", "DIR", "run folder (default: finetuned/SIDE-seedN in the folder of the checkpoint)"
    ),
    RESUME,
    MINUTES,
    *(
        on_off(name, f"{help} (default: as the checkpoint's run)")
        for name, help in NETWORK_SWITCHES.items()
    ),
    on_off(
        "curriculum",
        "push: move the target line from near to far again (default: it stays far)",
        default=False,
    ),
    # 64 is NUM_ENVS of morphgen.rl.finetuning, whose import takes seconds.
    *learning_options(100_000, 64),
    opt.LIBRARY,
    details="The run begins with the networks of the checkpoint, and with a new optimiser and "
    "schedule. The agent and most hyperparameters are the checkpoint's. The learning rate follows "
    "the change of the policy, so that little of what it can do is lost.",
    examples=("finetune runs/interpolation/arm3/reach/me-tf/seed0 --on test --steps 300000",),
    extra="rl",
)
def finetune(args: argparse.Namespace) -> None:
    """Train and print the path of the checkpoint."""
    from morphgen.rl.training import checkpoint_files

    require_split_for_options(args)
    files = list(checkpoint_files(checkpoint_path(args.checkpoint)))
    if len(files) > 1:
        raise TaskError(
            f"{args.checkpoint} has {len(files)} policies: name one, such as {files[0]}"
        )
    shipped = args.checkpoint in POLICIES
    parent = Path("runs") / args.checkpoint if shipped else files[0].parent
    folder = args.out or parent / "finetuned" / f"{args.on}-seed{args.seed}"
    run_training(folder, _finetuning_config(files[0], args), args)


def _finetuning_config(file: Path, args: argparse.Namespace) -> RunConfig:
    from morphgen.rl.agent_spec import parse_constants
    from morphgen.rl.config import PPOConfig
    from morphgen.rl.finetuning import finetuning_config
    from morphgen.rl.robot_source import other_side, tasks_of
    from morphgen.rl.runs import read_checkpoint

    initial, _ = read_checkpoint(file)
    if args.words:
        source = robots_to_train(args.words, args)
    else:
        source = other_side(initial.source, args.on)
    changes: dict[str, Any] = parse_constants(args.set)
    if unknown := set(changes) - {field.name for field in fields(PPOConfig)}:
        raise TaskError(f"--set {min(unknown)}: the networks are those of the checkpoint")
    switches = {name: getattr(args, name) for name in NETWORK_SWITCHES}
    changes |= {name: value for name, value in switches.items() if value is not None}
    changes |= {"total_timesteps": args.steps, "curriculum": args.curriculum}
    return replace(
        finetuning_config(initial, source, str(file.resolve()), changes),
        seed=args.seed,
        sim=args.sim or initial.sim,
        num_envs=args.envs,
        device=args.device,
        tasks=opt.with_goal(initial.tasks, args.goal, tasks_of(source)),
    )

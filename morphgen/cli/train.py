"""``morphgen train``: train an agent on the robots of a split, or on one robot."""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_library, add_max_links, add_sim
from morphgen.cli.progress import shown
from morphgen.rl.agents import AGENTS

if TYPE_CHECKING:
    from morphgen.rl.agent_spec import AgentSpec
    from morphgen.rl.robot_source import RobotSource
    from morphgen.rl.runs import RunConfig
    from morphgen.rl.training import ExecutionConfig, Subrun
    from morphgen.tasks.task import TaskConfig

SWITCHES = {
    "symlog": "the critic predicts the symlog of returns (default: on)",
    "slow-critic": "compute returns with a moving average of the critic (default: on)",
    "discrete": "discrete actions (default: on if all robots reach)",
    "task-reweighting": "weight the robots randomly (default: off)",
    "curriculum": "push: move the line from near to far during training (default: on)",
    "fixed-deviation": "keep the initial standard deviation of continuous actions (default: off)",
    "mask-morphology": "hide the robot's morphology from the agent (default: off)",
    "tool-position": "show the tool's position to the agent (default: off)",
}
OF_NETWORKS = {
    "bf16": "run the networks in bfloat16",
    "compile": "run networks and losses by torch.compile",
}
"""Switches of how the networks are computed."""


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "train",
        help="train an agent on the robots of a split, or on one robot",
        description="Train a policy by PPO and write it to a run's folder. --resume continues an "
        "interrupted run, which ends with the same weights.",
        epilog="examples: morphgen train interpolation/arm3/reach --agent me-tf --sim mujoco; "
        "morphgen train arm=ur5 ee=stick task=reach --agent se",
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="SPLIT",
        help="a split's name, file or built folder; or words of compose, parts such as ur5-plane, "
        "a bundle's folder or a URDF, and its task such as task=reach",
    )
    parser.add_argument(
        "--agent", default="me-tf", help=f"one of {', '.join(AGENTS)} (default: me-tf)"
    )
    parser.add_argument("--seed", type=int, default=0, help="default: 0")
    parser.add_argument(
        "--on",
        choices=["train", "test"],
        default="train",
        help="side of the split (default: train)",
    )
    parser.add_argument("--obstacles", action="store_true", help="one robot: among obstacles")
    parser.add_argument("--out", metavar="DIR", type=Path, help="default: runs/SPLIT/AGENT/seedN")
    parser.add_argument("--resume", action="store_true", help="continue the run in the folder")
    for name, text in SWITCHES.items():
        parser.add_argument(
            f"--{name}", action=argparse.BooleanOptionalAction, default=None, help=text
        )
    add_training(parser, steps=2e6, envs=128)
    add_library(parser)
    parser.set_defaults(run=run)


def add_training(parser: argparse.ArgumentParser, *, steps: float, envs: int) -> None:
    """Add the options of commands that train from random weights."""
    add_learning(parser, steps=steps, envs=envs)
    add_sim(parser)
    parser.add_argument(
        "--goal-seed",
        type=int,
        help="seed of all goals (default: as shipped with the split, else 0)",
    )
    parser.add_argument(
        "--train-goals",
        type=count,
        metavar="N",
        help="goals of reach, and starts of push, per robot in training; evaluations have 100 "
        "(default: 100, as in the paper)",
    )
    parser.add_argument(
        "--whole",
        action="store_true",
        help="se on a split: give each robot all steps and environments, instead of a share",
    )
    add_max_links(parser)
    for name, meaning in OF_NETWORKS.items():
        parser.add_argument(f"--{name}", action="store_true", help=meaning)


def add_learning(parser: argparse.ArgumentParser, *, steps: float, envs: int) -> None:
    """Add the options of all commands that train."""
    parser.add_argument(
        "--steps",
        type=count,
        default=int(steps),
        help=f"control steps of all environments together (default: {steps:,.0f})",
    )
    parser.add_argument(
        "--envs",
        type=int,
        default=envs,
        help=f"number of environments, which the robots share (default: {envs})",
    )
    parser.add_argument(
        "--workers", type=int, default=1, help="processes of PyBullet, or threads of MuJoCo"
    )
    parser.add_argument("--device", default="cpu", help="device of the networks: cpu or cuda")
    parser.add_argument(
        "--set",
        metavar="NAME=VALUE",
        action="append",
        default=[],
        help="change a constant, such as learning_rate=1e-4 or num_steps=32; may be repeated",
    )
    parser.add_argument("--no-tensorboard", action="store_true", help="write no TensorBoard events")
    parser.add_argument(
        "--wandb", action="store_true", help="also send metrics to Weights & Biases"
    )


def count(text: str) -> int:
    """Read a whole number, also as 2e6."""
    value = float(text)
    if not (math.isfinite(value) and value.is_integer()):
        raise ValueError(text)
    return int(value)


def run(args: argparse.Namespace) -> int:
    """Train and print the paths of the checkpoints."""
    from morphgen.rl.robot_source import other_side
    from morphgen.rl.runs import CHECKPOINT

    source = other_side(source_of(args.words, args), args.on)
    spec = spec_of(args)
    config = config_of(source, spec, args)
    _require_meant(config, args)
    folder = args.out or Path("runs") / folder_of(source) / str(spec) / f"seed{args.seed}"
    parts = trained(folder, config, args)
    for part in parts:
        print(part.folder / CHECKPOINT)
    return 0


def trained(folder: Path, config: RunConfig, args: argparse.Namespace) -> list[Subrun]:
    """Train a run to its end, with a progress bar."""
    from morphgen.rl.training import train

    with shown() as show:
        return train(folder, config, resume=args.resume, execution=execution_of(args), show=show)


def require_words(args: argparse.Namespace) -> None:
    """Require that options which describe other robots come with ``--split``.

    Raises:
        TaskError: If they do not.
    """
    from morphgen.errors import TaskError

    for name in ("obstacles", "library", "goal_seed"):
        if not args.words and getattr(args, name) not in (None, False, []):
            raise TaskError(f"--{name.replace('_', '-')} goes with --split")


def source_of(words: list[str], args: argparse.Namespace) -> RobotSource:
    """Return the robots that the words of a command describe.

    Raises:
        TaskError: If a robot has no task, or the seed of the goals is invalid, or not the seed of
            the goals that a built split ships.
        MorphgenError: If there is no such split.
    """
    from morphgen.cli.goals import read_split_or_built
    from morphgen.errors import BenchmarkError, TaskError
    from morphgen.rl.robot_source import robot_source, split_source
    from morphgen.tasks.registry import TASKS
    from morphgen.tasks.split_goals import has_goals, read_split_goals

    seed = args.goal_seed or 0
    if seed < 0:
        raise TaskError(f"--goal-seed {seed}: expected 0 or more")
    library = tuple(args.library)
    choices = " or ".join(f"task={name}" for name in TASKS)
    given = [word for word in words if word.startswith("task=")]
    robot = [word for word in words if not word.startswith("task=")]
    if given:
        task = given[-1].partition("=")[2]
        if len(given) > 1 or not robot:
            raise TaskError(f"{' '.join(words)}: name a robot and one task, {choices}")
        TASKS[task]  # refuses one that is unknown
        return robot_source(
            " ".join(robot),
            task,
            obstacles=args.obstacles,
            goal_seed=seed,
            library=library,
        )
    if len(words) > 1 or "=" in words[0]:
        raise TaskError(f"{' '.join(words)}: a robot needs its task, {choices}")
    if args.obstacles:
        raise TaskError("--obstacles is for one robot; a split says which robots have any")
    try:
        split, home = read_split_or_built(words[0])
    except BenchmarkError as error:
        raise BenchmarkError(f"{error}; a robot needs {choices}") from error
    shipped = home if home is not None and has_goals(home) else None
    if shipped is not None:
        made_with = read_split_goals(shipped).config.seed
        if args.goal_seed not in (None, made_with):
            raise TaskError(f"--goal-seed {seed}: the goals in {shipped} are of seed {made_with}")
        seed = made_with
    return split_source(split, side=args.on, goal_seed=seed, goals=shipped, library=library)


def spec_of(args: argparse.Namespace) -> AgentSpec:
    """Return the agent with the switches that were given.

    Raises:
        TaskError: If it is unknown.
    """
    from dataclasses import replace

    from morphgen.rl.agent_spec import parse_agent

    given = {name: getattr(args, name.replace("-", "_")) for name in SWITCHES}
    spec = parse_agent(args.agent)
    switches = {name: on for name, on in given.items() if on is not None}
    return replace(spec, switches={**spec.switches, **switches})


def config_of(source: RobotSource, spec: AgentSpec, args: argparse.Namespace) -> RunConfig:
    """Return the config of the run that the options ask for.

    Raises:
        TaskError: If a number is out of its range.
    """
    from morphgen.benchmark.token_layout import MAX_LINKS
    from morphgen.rl.agent_spec import configs_of, parse_constants
    from morphgen.rl.robot_source import tasks_of
    from morphgen.rl.runs import RunConfig

    changes = {**parse_constants(args.set), "bf16": args.bf16, "compile": args.compile}
    policy, ppo = configs_of(spec, tasks_of(source), changes, args.steps)
    return RunConfig(
        source,
        policy,
        ppo,
        seed=args.seed,
        sim=args.sim,
        num_envs=args.envs,
        device=args.device,
        full_budget=args.whole and AGENTS[spec.agent].per_robot,
        max_links=MAX_LINKS if args.max_links is None else args.max_links,
        tasks=_tasks(source, args.train_goals),
    )


def _tasks(source: RobotSource, num_goals: int | None) -> tuple[TaskConfig, ...]:
    """Return constants with so many goals per robot; by default as many as in evaluations.

    Raises:
        TaskError: If they are too few, or the split ships its own goals.
    """
    from dataclasses import replace

    from morphgen.errors import TaskError
    from morphgen.rl.robot_source import tasks_of
    from morphgen.tasks.registry import TASKS

    names = dict.fromkeys((*TASKS.builtin, *tasks_of(source)))
    configs: list[TaskConfig] = [TASKS[name].config_type() for name in names]
    if num_goals is None:
        return tuple(configs)
    if num_goals < 2:
        raise TaskError(f"--train-goals {num_goals}: expected 2 or more")
    if source.goal_dir:
        raise TaskError(
            f"--train-goals {num_goals}: {source.goal_dir} ships the goals to train on; name the "
            f"split itself, {source.name}, to have others"
        )
    return tuple(replace(config, num_goals=num_goals) for config in configs)


def _require_meant(config: RunConfig, args: argparse.Namespace) -> None:
    """Require that no option is for another agent; a study may have options for some of its agents.

    Raises:
        TaskError: If one is.
    """
    from morphgen.errors import TaskError
    from morphgen.rl.agent_spec import owners_of, parse_constants

    agent = config.policy.agent
    if args.whole and not AGENTS[agent].per_robot:
        valid = " or ".join(name for name in AGENTS if AGENTS[name].per_robot)
        raise TaskError(f"--whole is for --agent {valid}, not for {agent}")
    changed = parse_constants(args.set)
    for name in changed:
        owners = owners_of(name)
        if agent not in owners:
            raise TaskError(f"--set {name}: {agent} has none; valid for {' and '.join(owners)}")
    if "logit_scale" in changed and not config.policy.discrete:
        raise TaskError(
            "--set logit_scale: continuous actions have no logits; it is for --discrete"
        )


def execution_of(args: argparse.Namespace) -> ExecutionConfig:
    """Return how runs are executed.

    Raises:
        TaskError: If the number of workers is below 1.
        MissingDependencyError: If Weights & Biases is asked for and not installed.
    """
    from morphgen.rl.training import ExecutionConfig

    return ExecutionConfig(args.workers, not args.no_tensorboard, args.wandb)


def folder_of(source: RobotSource) -> str:
    """Return the name of a run's folder for robots."""
    import re

    name = source.name if source.split else f"{Path(source.name).name}-{source.task}"
    if source.obstacles:
        name += "-obstacles"
    if source.side != "train":
        name += f"-{source.side}"
    return re.sub(r"[^\w./-]+", "-", name).strip("/.")

"""The robots that commands train and evaluate on: a split, or one robot with its task."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from morphgen.cli.command import Option, number, option
from morphgen.errors import BenchmarkError, TaskError
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.rl.robot_source import RobotSource

SPLIT_HELP = (
    "name of a split, its file or built folder; or a robot and its task, such as arm=ur5 ee=stick "
    "task=reach"
)
SIDES = ["train", "test"]
GOAL_SEED = number(
    "--goal-seed", "with --split: seed of all goals (default: as shipped, else 0)", least=0
)


def split_option(purpose: str) -> Option:
    """Return the option ``--split``, whose words ``robots_to_train`` reads.

    Args:
        purpose: Whose robots the option names.
    """
    return option(
        "--split",
        dest="words",
        nargs="+",
        metavar="SPLIT",
        default=[],
        help=f"{purpose}: {SPLIT_HELP}",
    )


def require_split_for_options(args: argparse.Namespace) -> None:
    """Require ``--split`` with options that describe other robots than the checkpoint's.

    Raises:
        TaskError: If it is missing.
    """
    for name in ("obstacles", "library", "goal_seed"):
        if not args.words and getattr(args, name) not in (None, False, []):
            raise TaskError(f"--{name.replace('_', '-')} goes with --split")


def robots_to_train(words: list[str], args: argparse.Namespace) -> RobotSource:
    """Return the robots that a split, or a robot and ``task=NAME``, describe.

    Raises:
        TaskError: If a robot has no task, or the seed of the goals differs from that of the goals
            that a built split ships.
        MorphgenError: If the split or the robot is unknown.
    """
    from morphgen.cli.goals import read_split_or_folder
    from morphgen.rl.robot_source import robot_source, split_source
    from morphgen.tasks.split_goals import has_goals, read_split_goals

    seed, library = args.goal_seed or 0, tuple(args.library)
    choices = " or ".join(f"task={name}" for name in TASKS)
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    robot = " ".join(word for word in words if not word.startswith("task="))
    if tasks:
        if len(tasks) > 1 or not robot:
            raise TaskError(f"{' '.join(words)}: name a robot and one task, {choices}")
        TASKS[tasks[0]]  # raises if the task is unknown
        return robot_source(
            robot, tasks[0], obstacles=args.obstacles, goal_seed=seed, library=library
        )
    if len(words) > 1 or "=" in words[0]:
        raise TaskError(f"{' '.join(words)}: a robot needs its task, {choices}")
    if args.obstacles:
        raise TaskError("--obstacles is for one robot; a split says which robots have obstacles")
    try:
        split, folder = read_split_or_folder(words[0])
    except BenchmarkError as error:
        raise BenchmarkError(f"{error}; a robot needs {choices}") from error
    goal_folder = folder if folder is not None and has_goals(folder) else None
    if goal_folder is not None:
        shipped_seed = read_split_goals(goal_folder).config.seed
        if args.goal_seed not in (None, shipped_seed):
            raise TaskError(
                f"--goal-seed {seed}: the goals in {goal_folder} are of seed {shipped_seed}"
            )
        seed = shipped_seed
    return split_source(split, side=args.on, goal_seed=seed, goals=goal_folder, library=library)

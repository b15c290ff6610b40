"""The robots that commands train and evaluate on: a split, one robot, or robots of grammars."""

from __future__ import annotations

import argparse
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.command import Option, number, option, repeated
from morphgen.cli.options import reject_idle
from morphgen.cli.progress import TrainingProgress
from morphgen.errors import BenchmarkError, TaskError
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.rl.robot_source import RobotSource
    from morphgen.tasks.env_specs import GoalConfig

SPLIT_HELP = (
    "name of a split, its file or built folder; or a robot and its task, such as arm=ur5 ee=stick "
    "task=reach"
)
SIDES = ["train", "test"]
GOAL_SEED = number(
    "--goal-seed", "with --split: seed of all goals (default: as shipped, else 0)", least=0
)

DRAWN_OPTIONS = (
    option(
        "--robots",
        metavar="GRAMMAR:N,...",
        help="train on N robots drawn from each grammar, such as arm3:300,chain:300, by as many "
        "processes as --workers; the test robots of the splits of morphgen are never drawn",
    ),
    number("--robot-seed", "with --robots: seed of the robots (default: 0)", least=0),
    repeated(
        "--held-out",
        "with --robots: a further split whose test robots are never drawn",
        metavar="SPLIT",
    ),
    number(
        "--slice-updates",
        "with more --robots than --envs: number of updates after which the next robots take the "
        "environments (default: those of two episodes)",
    ),
)
"""Options of robots that are drawn from grammars."""


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
    from morphgen.benchmark.split_source import read_split_or_folder
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
        if Path(words[0]).exists():
            raise
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


def robots_to_draw(args: argparse.Namespace) -> RobotSource:
    """Return the source that ``--robots`` describes; none of its robots is drawn yet.

    Raises:
        TaskError: If the positional arguments are not a task, or ``--on`` is given.
        MorphgenError: If a grammar or a split is unknown or faulty.
    """
    from morphgen.rl.drawn_robots import drawn_source

    choices = " or ".join(f"task={name}" for name in TASKS)
    words, task = " ".join(args.words), args.words[0].removeprefix("task=")
    if words != f"task={task}":
        raise TaskError(f"{words}: with --robots, name the task and nothing else: {choices}")
    if args.on != "train":
        raise TaskError(f"--on {args.on}: drawn robots have no sides; --on goes with a split")
    TASKS[task]  # raises if the task is unknown
    return drawn_source(
        args.robots,
        task,
        seed=args.robot_seed or 0,
        held_out=args.held_out,
        obstacles=args.obstacles,
        goal_seed=args.goal_seed or 0,
        library=args.library,
    )


def draw_robots(
    source: RobotSource, config: GoalConfig, args: argparse.Namespace
) -> tuple[RobotSource, int]:
    """Draw the robots of a source and print how many were skipped.

    Returns:
        The source with the hash of its robots, and the number of links that observations are
        padded to: ``--max-links`` if it is given, else the largest of the benchmark's number, those
        of the splits of ``--held-out`` and the links of the largest robot.
    """
    from morphgen.benchmark.split_file import read_split
    from morphgen.benchmark.token_layout import default_max_links
    from morphgen.rl.drawn_robots import draw

    with closing(TrainingProgress()) as display:
        robots = draw(source, config, jobs=args.workers, progress=display.goal_sets)
    if robots.skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in robots.skipped.items())
        print(f"morphgen: robots that were skipped: {reasons}", file=sys.stderr)
    held_out = (read_split(name).max_links for name in source.held_out)
    max_links = args.max_links or default_max_links([robots.most_links, *held_out])
    return replace(source, drawn_hash=robots.hash), max_links


def require_robots_for_options(args: argparse.Namespace) -> None:
    """Require ``--robots`` with the other options of drawn robots.

    Raises:
        MorphgenError: If it is missing.
    """
    if args.robots is None:
        given = {
            "--robot-seed": args.robot_seed is not None,
            "--held-out": bool(args.held_out),
            "--slice-updates": args.slice_updates is not None,
        }
        reject_idle(given, "only with --robots")

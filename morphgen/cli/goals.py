"""``morphgen goals``: goal sets of robots and splits."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, option
from morphgen.cli.progress import bar, status
from morphgen.errors import BenchmarkError
from morphgen.tasks.registry import TASKS

if TYPE_CHECKING:
    from morphgen.benchmark.split import Split
    from morphgen.tasks.env_specs import GoalConfig
    from morphgen.tasks.split_goals import GoalResult

HEADERS = ("robot", "side", "task", "goals", "acceptance", "obstacles", "certified")


@command(
    "goals",
    "sample the goal sets of robots, and certify that each goal can be reached",
    option(
        "words",
        nargs="+",
        metavar="SPLIT",
        help=f"name of a split, its file or built folder; with --task, a robot: {opt.ROBOT_HELP}",
    ),
    option("--task", choices=TASKS, metavar="TASK", help=f"one robot: its task, {opt.TASK_NAMES}"),
    opt.OBSTACLES,
    opt.SEED,
    flag("--certify", "verify every goal with the configuration that it was sampled from"),
    *opt.JOBS_LIBRARY_JSON,
    details="Goals of reach and starts of push are kept in the cache. The goals of reach are full "
    "poses, so the sets are the same for --goal position and --goal pose of other commands. Run "
    "the command again to continue an interrupted one. The exit code is 1 if a robot has too few "
    "goals, or if a goal fails --certify.",
    examples=("goals extrapolation/arms/reach --certify", "goals arm=ur5 ee=plane --task reach"),
)
def goals(args: argparse.Namespace) -> int:
    """Sample goal sets and print a table with the failures."""
    from morphgen.tasks.env_specs import GoalConfig

    if args.task is None:
        if args.obstacles:
            raise BenchmarkError(
                "--obstacles goes with --task; a split says which robots have obstacles"
            )
        if len(args.words) > 1:
            raise BenchmarkError(
                f"{' '.join(args.words)}: name one split, or say --task for a robot"
            )
        from morphgen.benchmark.split_source import read_split_or_folder

        split, _ = read_split_or_folder(args.words[0])
        results = make_goals(args, split, GoalConfig(args.seed), certify=args.certify)
    else:
        results = [_robot_goals(args, GoalConfig(args.seed))]
    passed = all(result.goals is not None and not result.certificate_errors for result in results)
    data = _data(results, args.seed) | {"passed": passed}
    opt.print_result(args, data, lambda: _text(results, args.seed))
    return int(not passed)


def _robot_goals(args: argparse.Namespace, config: GoalConfig) -> GoalResult:
    from morphgen.benchmark.split_file import split_names
    from morphgen.tasks.env_specs import load_robot
    from morphgen.tasks.split_goals import sample_robot_goals

    words = " ".join(args.words)
    if words in split_names():
        raise BenchmarkError(f"--task {args.task}: is for a robot; {words} is a split")
    with status(args, f"sampling goals of {args.task} for {words}"):
        robot = load_robot(words, library=args.library)
        return sample_robot_goals(
            robot, args.task, config, obstacles=args.obstacles, certified=args.certify
        )


def make_goals(
    args: argparse.Namespace, split: Split, config: GoalConfig, *, certify: bool = False
) -> list[GoalResult]:
    """Sample the goal sets of a split's robots, or read them from the cache."""
    from morphgen.tasks.split_goals import sample_split_goals

    with bar(args, "sampling goals") as update:
        return sample_split_goals(
            split, opt.library_of(args), config, jobs=args.jobs, certified=certify, progress=update
        )


def _text(results: Sequence[GoalResult], seed: int) -> str:
    from tabulate import tabulate

    lines = [tabulate([_row(result) for result in results], HEADERS, disable_numparse=True)]
    for result in results:
        robot = f"{result.side} robot {result.robot}" if result.side else f"robot {result.robot}"
        if result.goals is None:
            lines.append(f"{robot}: {result.error}")
        elif result.certificate_errors:
            more = (
                f" (and {len(result.certificate_errors) - 1} more)"
                if result.certificate_errors[1:]
                else ""
            )
            lines.append(f"{robot}: {result.certificate_errors[0]}{more}")
    complete = sum(result.goals is not None for result in results)
    return "\n".join([*lines, f"{complete} of {len(results)} goal sets are complete, seed {seed}"])


def _row(result: GoalResult) -> tuple[str, ...]:
    goals, certificate_errors = result.goals, result.certificate_errors
    certified = (
        "not tested" if certificate_errors is None else "NO" if certificate_errors else "yes"
    )
    rate = "" if result.acceptance is None else f"{result.acceptance:.3g}"
    count = "none" if goals is None else str(len(goals.q))
    boxes = str(len(goals.obstacles)) if goals else "yes" if result.obstacles else "0"
    return (result.robot, result.side or "", result.task, count, rate, boxes, certified)


def _data(results: Sequence[GoalResult], seed: int) -> dict[str, object]:
    from morphgen.tasks.split_goals import goal_record

    sets = [
        goal_record(result)
        | {
            "certified": None
            if result.certificate_errors is None
            else not result.certificate_errors,
            "unproven": list(result.certificate_errors or ()),
        }
        for result in results
        if result.goals
    ]
    failures = [
        {"robot": result.robot, "side": result.side, "task": result.task, "why": result.error}
        for result in results
        if result.goals is None
    ]
    return {"seed": seed, "sets": sets, "failures": failures}

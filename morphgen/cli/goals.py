"""``morphgen goals``: goals of robots and splits; also those of ``split build`` and ``audit``."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_jobs, add_json, add_library, add_task, library_of

if TYPE_CHECKING:
    from morphgen.benchmark.audit import Audit
    from morphgen.benchmark.split import Split
    from morphgen.processes import Progress
    from morphgen.tasks.env_specs import GoalConfig
    from morphgen.tasks.split_goals import GoalResult, SplitGoals

HEADERS = ("robot", "side", "task", "goals", "acceptance", "obstacles", "certified")


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "goals",
        help="make the goal sets of a split's robots, and prove that each goal can be reached",
        description="Make the goals of reach and the starts of push of every robot of a split, or "
        "of one robot, and keep them in the cache; interrupted, it goes on where it was. Exit code "
        "1 if a robot has too few, or (with --certify) a goal is not proven by its configuration.",
        epilog="examples: morphgen goals extrapolation/arms/reach --certify; "
        "morphgen goals arm=ur5 ee=plane --task reach",
    )
    parser.add_argument(
        "words",
        nargs="+",
        metavar="SPLIT",
        help="a split's file, name or built folder; with --task: words of compose, a bundle's "
        "folder or a URDF",
    )
    add_task(parser, "--task", "task of one robot: ")
    parser.add_argument("--obstacles", action="store_true", help="with --task: among obstacles")
    parser.add_argument("--seed", type=int, default=0, help="of all goals (default: 0)")
    parser.add_argument(
        "--certify", action="store_true", help="test every goal with the configuration it is from"
    )
    add_jobs(parser)
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Make, print the table and what failed."""
    from morphgen.errors import BenchmarkError

    if args.task is None:
        if args.obstacles:
            raise BenchmarkError("--obstacles goes with --task; a split says which robots have any")
        if len(args.words) > 1:
            raise BenchmarkError(
                f"{' '.join(args.words)}: name one split, or say --task for a robot"
            )
    config = goal_config(args.seed)
    made = _of_robot(args, config) if args.task else _of_split(args, config)
    failed = [one for one in made if one.goals is None or one.certificate_errors]
    if args.json:
        print(json.dumps(_data(made, config.seed) | {"passed": not failed}))
    else:
        print(_text(made, config.seed))
    return int(bool(failed))


def goal_config(seed: int) -> GoalConfig:
    """Return how the goals of a benchmark are made, with a seed.

    Raises:
        BenchmarkError: If the seed is none.
    """
    from morphgen.errors import BenchmarkError
    from morphgen.tasks.env_specs import GoalConfig

    if seed < 0:
        raise BenchmarkError(f"goal seed {seed}: expected 0 or more")
    return GoalConfig(seed)


def _of_robot(args: argparse.Namespace, config: GoalConfig) -> list[GoalResult]:
    from morphgen.tasks.env_specs import load_robot
    from morphgen.tasks.split_goals import sample_robot_goals

    robot = load_robot(" ".join(args.words), library=args.library)
    made = sample_robot_goals(
        robot, args.task, config, obstacles=args.obstacles, certified=args.certify
    )
    return [made]


def _of_split(args: argparse.Namespace, config: GoalConfig) -> list[GoalResult]:
    from morphgen.tasks.split_goals import sample_split_goals

    split, _ = read_split_or_built(args.words[0])
    with bar(args) as progress:
        return sample_split_goals(
            split,
            library_of(args),
            config,
            jobs=args.jobs,
            certified=args.certify,
            progress=progress,
        )


def read_split_or_built(name: str) -> tuple[Split, Path | None]:
    """A split, by its name, file, or the folder where it is built; and that folder.

    Raises:
        BenchmarkError: If there is none.
    """
    from morphgen.benchmark.split_file import read_split
    from morphgen.benchmark.split_folder import SPLIT_FILE, require_split_folder

    folder = Path(name)
    if not folder.is_dir():
        return read_split(name), None
    require_split_folder(folder)
    return read_split(folder / SPLIT_FILE), folder


def require_room_for(home: Path, wanted: bool) -> None:
    """Require that a build without goals does not leave those of another one in its folder.

    Raises:
        BenchmarkError: If it would.
    """
    from morphgen.errors import BenchmarkError

    if wanted or not home.is_dir():
        return
    from morphgen.tasks.split_goals import GOALS, has_goals

    if has_goals(home):
        raise BenchmarkError(
            f"{home} was built with goals: say --goals, delete {home / GOALS}, or name another "
            "folder"
        )


def ready_goals(args: argparse.Namespace, split: Split) -> list[GoalResult]:
    """The goal sets of a split that is to be built.

    Raises:
        BenchmarkError: If a robot has none.
    """
    from morphgen.tasks.split_goals import require_goal_sets, sample_split_goals

    config = goal_config(args.goal_seed or 0)
    with bar(args, "goals") as progress:
        made = sample_split_goals(
            split, library_of(args), config, jobs=args.jobs, progress=progress
        )
    require_goal_sets(made)
    return made


def ship_goals(args: argparse.Namespace, home: Path, made: Sequence[GoalResult]) -> None:
    """Write the goal sets of a split into the folder where it is built."""
    from morphgen.tasks.split_goals import write_goals

    write_goals(home, made, goal_config(args.goal_seed or 0))


def audit_with_goals(
    args: argparse.Namespace, done: Audit, split: Split, folder: Path | None
) -> tuple[Audit, SplitGoals | None]:
    """An audit with what is found of goal sets, and these, if there are any to look at."""
    accepts = any(code.startswith("goals-") for code in split.accepted)
    if folder is None and not args.goals and not accepts:
        return done, None
    from morphgen.tasks.goal_audit import audit_goals, with_goal_findings

    goals = _goals_to_audit(args, split, folder)
    if goals is None:
        return with_goal_findings(done, split, None), None
    with bar(args, "goals") as progress:
        findings = audit_goals(split, goals, library_of(args), jobs=args.jobs, progress=progress)
    return with_goal_findings(done, split, findings), goals


def _goals_to_audit(
    args: argparse.Namespace, split: Split, folder: Path | None
) -> SplitGoals | None:
    """Those that are shipped, else, if asked for, those that tasks would have."""
    from dataclasses import replace

    from morphgen.tasks.split_goals import (
        SplitGoals,
        has_goals,
        read_split_goals,
        sample_split_goals,
    )

    if folder is not None and has_goals(folder):
        found = read_split_goals(folder)
        seed = found.config.seed if args.goal_seed is None else goal_config(args.goal_seed).seed
        return replace(found, config=replace(found.config, seed=seed))
    if not args.goals:
        return None
    config = goal_config(args.goal_seed or 0)
    with bar(args, "goals") as progress:
        made = sample_split_goals(
            split, library_of(args), config, jobs=args.jobs, progress=progress
        )
    return SplitGoals.from_results(made, config)


@contextmanager
def bar(args: argparse.Namespace, title: str | None = None) -> Iterator[Progress]:
    """A bar on stderr, gone when done."""
    from tqdm import tqdm

    hidden = args.json or None
    with tqdm(desc=title, unit="robot", file=sys.stderr, disable=hidden, leave=False) as shown:

        def show(done: int, total: int) -> None:
            shown.total = total
            shown.update(done - shown.n)

        yield show


def _text(made: Sequence[GoalResult], seed: int) -> str:
    from tabulate import tabulate

    lines = [tabulate([_row(one) for one in made], HEADERS, disable_numparse=True)]
    for one in made:
        who = f"{one.side} robot {one.robot}" if one.side else f"robot {one.robot}"
        if one.goals is None:
            lines.append(f"{who}: {one.error}")
        elif one.certificate_errors:
            more = (
                f" (and {len(one.certificate_errors) - 1} more)"
                if one.certificate_errors[1:]
                else ""
            )
            lines.append(f"{who}: {one.certificate_errors[0]}{more}")
    ready = sum(one.goals is not None for one in made)
    lines.append(f"{ready} of {len(made)} goal sets are there, seed {seed}")
    return "\n".join(lines)


def _row(one: GoalResult) -> tuple[str, ...]:
    certified = "" if one.certificate_errors is None else "NO" if one.certificate_errors else "yes"
    rate = "" if one.acceptance is None else f"{one.acceptance:.3g}"
    count = "none" if one.goals is None else str(len(one.goals.q))
    boxes = str(len(one.goals.obstacles)) if one.goals else "yes" if one.obstacles else "0"
    return (one.robot, one.side or "", one.task, count, rate, boxes, certified)


def _data(made: Sequence[GoalResult], seed: int) -> dict[str, object]:
    from morphgen.tasks.split_goals import goal_record

    sets = [
        goal_record(one)
        | {
            "certified": None if one.certificate_errors is None else not one.certificate_errors,
            "unproven": list(one.certificate_errors or ()),
        }
        for one in made
        if one.goals
    ]
    failures = [
        {"robot": one.robot, "side": one.side, "task": one.task, "why": one.error}
        for one in made
        if one.goals is None
    ]
    return {"seed": seed, "sets": sets, "failures": failures}

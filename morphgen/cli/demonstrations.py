"""``morphgen record``, ``verify`` and ``clone``: demonstrations, and what is learned from them."""

from __future__ import annotations

import argparse
from dataclasses import asdict

from morphgen.api import demonstrations
from morphgen.benchmark.demonstrations import Verification, summarize, summary_text
from morphgen.cli import options as opt
from morphgen.cli.progress import bar, training_progress
from morphgen.cli.train import RESUME, print_run
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.recording import TOLERANCE
from morphgen.tables import table


def record(args: argparse.Namespace) -> None:
    """Record and print a summary of the data set."""
    with bar(args, "recording"):
        robots, given = " ".join(args.words) or None, opt.arguments(args, demonstrations.record)
        demos = demonstrations.record(robots, **given)
    print_summary(args, demos)


def print_summary(args: argparse.Namespace, demos: Demonstrations) -> None:
    """Print what a data set has."""
    size = sum(path.stat().st_size for path in demos.folder.rglob("*") if path.is_file())
    data = {
        "folder": str(demos.folder),
        "robots": len(demos.robot_hashes),
        "episodes": len(demos.episodes),
        "steps": len(demos),
        "bytes": size,
        "tasks": [asdict(each) for each in summarize(demos)],
    }
    head = (
        f"{demos.folder}: {_counted(len(demos.episodes), 'episode')} of "
        f"{_counted(len(demos.robot_hashes), 'robot')}, {len(demos):,} steps, {size / 1e6:,.1f} MB"
    )
    opt.print_result(args, data, lambda: f"{head}\n{summary_text(demos)}")


def _counted(number: int, what: str) -> str:
    return f"{number:,} {what}{'s' * (number != 1)}"


def clone(args: argparse.Namespace) -> None:
    """Learn demonstrations and print the path of the checkpoint."""
    with training_progress(RESUME) as display:
        given = opt.arguments(args, demonstrations.clone)
        run = demonstrations.clone(args.words, show=display.training, **given)
    print_run(run, args.minutes)


def verify(args: argparse.Namespace) -> int:
    """Simulate episodes again and print how far they are from the recorded ones."""
    with bar(args, "simulating the episodes again", "episode"):
        result = demonstrations.verify(**opt.arguments(args, demonstrations.verify))
    replays = [asdict(each) | {"agrees": each.agrees} for each in result.replays]
    data = {"replays": replays, "changed_files": result.changed_files}
    opt.print_result(args, data, lambda: _text(result))
    return int(not result.agrees)


def _text(result: Verification) -> str:
    headers = ("episode", "robot", "task", "joints", "object [m]", "reward", "success", "agrees")
    rows = [
        (
            each.episode.index,
            each.robot,
            each.episode.task,
            f"{each.joint_error:.1e}",
            f"{each.object_error:.1e}",
            f"{each.reward_error:.1e}",
            "yes" if each.success else "no",
            "yes" if each.agrees else "no",
        )
        for each in result.replays
    ]
    lines = [f"changed: {name}" for name in result.changed_files]
    lines += [fault for each in result.replays for fault in each.faults]
    agreeing = sum(each.agrees for each in result.replays)
    last = f"{agreeing} of {len(result.replays)} episodes agree within {TOLERANCE:g} rad or m"
    return "\n".join([table(rows, headers), *dict.fromkeys(lines), last])

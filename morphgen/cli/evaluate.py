"""``morphgen eval``, ``play``, ``zeroshot``, ``record``, ``verify`` and ``clone``: use policies."""

from __future__ import annotations

import argparse
import itertools
import math
from collections.abc import Mapping
from dataclasses import asdict, replace

from morphgen.api import demonstrations, evaluation
from morphgen.api.training import with_goal
from morphgen.benchmark.demonstrations import Verification, summarize, summary_text
from morphgen.cli import options as opt
from morphgen.cli.progress import bar, print_line, status, training_progress
from morphgen.cli.train import RESUME, print_run
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.recording import TOLERANCE
from morphgen.rl.evaluation import eval_config_of, zero_shot, zero_shot_data
from morphgen.rl.inference import Episode, note_unfinished
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.robot_source import robot_source
from morphgen.rl.scores import Score, require_table, success_of
from morphgen.rl.shipped_policies import checkpoint_path, zero_shot_policy
from morphgen.tables import table
from morphgen.tasks.registry import DEFAULT_SIMULATOR, GOAL_KINDS, TASKS
from morphgen.tasks.renderer import require_video_path
from morphgen.tasks.sim.base import CONTROL_PERIOD


def evaluate(args: argparse.Namespace) -> None:
    """Evaluate and print the scores."""
    if args.out is not None:
        require_table(args.out)
    with training_progress():
        robots, given = " ".join(args.words) or None, opt.arguments(args, evaluation.evaluate)
        result = evaluation.evaluate(args.checkpoint, robots, **given)
    opt.print_result(args, result.as_dict(), lambda: str(result))
    if args.out is not None:
        result.write(args.out)


def play(args: argparse.Namespace) -> None:
    """Run the episodes, print a line for each, and name the video."""
    robot, episodes = " ".join(args.words), itertools.count(1)

    def report(episode: Episode) -> None:
        angle = (
            "" if math.isnan(episode.angle) else f" and {math.degrees(episode.angle):.1f} degrees"
        )
        print_line(
            f"episode {next(episodes)}: {'success' if episode.success else 'failure'}, "
            f"{episode.distance:.3f} m{angle} from the {TASKS[args.task].target}, "
            f"score {episode.score:.2f}, {episode.seconds:.2f} s"
            f"{', the simulation diverged' * episode.diverged}"
        )

    with bar(args, f"preparing {robot} and its goals, and running the episodes"):
        evaluation.play(robot=robot, show=report, **opt.arguments(args, evaluation.play))
    if args.out is not None:
        print_line(str(args.out))


FILM_EPISODES = 3  # number of episodes in a video


def zeroshot(args: argparse.Namespace) -> None:
    """Run the episodes, print the table, and write the video."""
    if args.out is not None:
        require_video_path(args.out)
    TASKS[args.task]  # raises if the task is unknown
    with_goal((), args.goal, [args.task])  # raises if the goal is not for the task
    if args.policy is None:
        goal = args.goal or GOAL_KINDS[0]
        policy = zero_shot_policy(args.task, goal, obstacles=args.obstacles).file
    else:
        policy = checkpoint_path(args.policy)
    with status(args, "reading the robot"):
        source = robot_source(
            " ".join(args.words), args.task, obstacles=args.obstacles, library=tuple(args.library)
        )
        run, learner = read_checkpoint(policy)
        note_unfinished(policy, run, learner)
    config = eval_config_of(run, args.episodes, seed=args.seed, workers=args.workers)
    tasks = with_goal(config.tasks, args.goal, [args.task])
    config = replace(config, sim=args.sim or DEFAULT_SIMULATOR, tasks=tasks)
    with bar(args, "preparing the goals", "episode"):
        scores = zero_shot(source, policy, config)
    opt.print_result(args, zero_shot_data(scores), lambda: _table(scores, args.task))
    if args.out is not None:
        with status(args, "filming"):
            given = opt.arguments(args, evaluation.play)
            given |= {"policy": policy, "sim": config.sim, "episodes": FILM_EPISODES}
            one_second = round(1 / CONTROL_PERIOD)
            evaluation.play(robot=source.name, max_successes=one_second, **given)
        print_line(str(args.out))


def _table(scores: Mapping[str, Score], task: str) -> str:
    columns = {
        "controller": list(scores),
        "success": [success_of([score]).as_percent() for score in scores.values()],
        "distance [m]": [f"{score.distance:.3f}" for score in scores.values()],
    }
    if not any(math.isnan(score.angle) for score in scores.values()):
        angles = (math.degrees(score.angle) for score in scores.values())
        columns["angle [deg]"] = [f"{angle:.1f}" for angle in angles]
    if TASKS[task].relative_to_random:  # the score of others is their success
        columns["score"] = [f"{score.score:.1f}" for score in scores.values()]
    return table(list(zip(*columns.values(), strict=True)), list(columns), formats="g")


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

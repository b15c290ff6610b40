"""``morphgen play`` and ``morphgen speed``: run one robot at a task, and measure how fast it is."""

from __future__ import annotations

import argparse
import itertools
import math
from collections import deque
from collections.abc import Mapping
from contextlib import closing
from dataclasses import replace
from importlib import import_module
from math import degrees, isnan
from pathlib import Path

from tabulate import tabulate

from morphgen.cli import options as opt
from morphgen.cli.progress import bar, print_line, status
from morphgen.rl.evaluation import EvalConfig, eval_config_of, zero_shot, zero_shot_data
from morphgen.rl.inference import FPS, Episode, make_env_and_controller, read_controller
from morphgen.rl.inference import play as run_episodes
from morphgen.rl.runs.checkpoint import read_checkpoint
from morphgen.rl.runs.robot_source import OneRobot, robot_source
from morphgen.rl.scores import Score, success_of
from morphgen.rl.shipped_policies import checkpoint_path, zero_shot_policy
from morphgen.tasks.reach import GOAL_KINDS
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.render.renderer import require_video_path, write_video
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.scenes.make import make_batch
from morphgen.tasks.sim.base import CONTROL_PERIOD
from morphgen.tasks.speed import measure_speed


def play(args: argparse.Namespace) -> None:
    """Run the episodes, print a line for each, and write the video."""
    spec = read_controller(args.policy, args.task)
    if args.out is not None:
        require_video_path(args.out)
    (config,) = opt.with_goal([spec.task_config], args.goal, [args.task])
    robot, target = " ".join(args.words), TASKS[args.task].target
    episodes = itertools.count(1)

    def report(episode: Episode) -> None:
        angle = "" if isnan(episode.angle) else f" and {degrees(episode.angle):.1f} degrees"
        print_line(
            f"episode {next(episodes)}: {'success' if episode.success else 'failure'}, "
            f"{episode.distance:.3f} m{angle} from the {target}, score {episode.score:.2f}, "
            f"{episode.seconds:.2f} s{', the simulation diverged' * episode.diverged}"
        )

    with bar(args, f"preparing {robot} and its goals"):
        env, controller = make_env_and_controller(
            spec,
            robot,
            args.seed,
            kind=args.kind,
            sim=args.sim,
            obstacles=args.obstacles,
            config=config,
            library=args.library,
            render_mode=None if args.out is None else "rgb_array",
        )
    with closing(env), status(args, "running the episodes"):
        frames = run_episodes(env, controller, args.episodes, args.seed, report)
        if args.out is None:
            deque(frames, maxlen=0)  # runs the episodes and keeps no frame
        else:
            write_video(frames, args.out, FPS)
            print_line(str(args.out))


def speed(args: argparse.Namespace) -> None:
    """Measure the speed and print it."""
    robot, sim = " ".join(args.words), args.sim or DEFAULT_SIMULATOR
    with bar(args, f"preparing {robot} and its goals"):
        batch = make_batch(
            args.task,
            [robot],
            args.envs,
            sim=sim,
            workers=args.workers,
            device=args.device or SIMULATORS[sim].devices[0],
            obstacles=args.obstacles,
            max_links=None,
            library=args.library,
        )
    with closing(batch), status(args, "measuring"):
        step = SIMULATORS[sim].native_step
        # Other processes would not be timed.
        native_steps = [(import_module(step[0]), step[1])] if step and args.workers == 1 else []
        result = measure_speed(batch, args.seconds, own=native_steps)

    def text() -> str:
        shares = [(part, f"{share:.1%}") for part, share in result.shares.items()]
        return (
            f"{args.task}, {batch.specs[0].robot.name}, {args.envs} environments, {sim}, "
            f"{batch.device.type}, {args.workers} worker(s)\n"
            f"environment steps per second: {result.steps_per_second:,.0f}\n"
            f"physics steps per second:     {result.substeps_per_second:,.0f}\n"
            f"{tabulate(shares)}"
        )

    data = {"steps_per_second": result.steps_per_second, "shares": result.shares}
    opt.print_result(args, data, text)


FILM_EPISODES = 3
"""Number of episodes in a video."""


def zeroshot(args: argparse.Namespace) -> None:
    """Run the episodes, print the table, and write the video."""
    if args.out is not None:
        require_video_path(args.out)
    TASKS[args.task]  # raises if the task is unknown
    opt.with_goal((), args.goal, [args.task])  # raises if the goal is not for the task
    if args.policy is None:
        goal = args.goal or GOAL_KINDS[0]
        policy = zero_shot_policy(args.task, goal, obstacles=args.obstacles).file
    else:
        policy = checkpoint_path(args.policy)
    with status(args, "reading the robot"):
        source = robot_source(
            " ".join(args.words), args.task, obstacles=args.obstacles, library=tuple(args.library)
        )
        run, _ = read_checkpoint(policy)
    config = eval_config_of(run, args.episodes, seed=args.seed, workers=args.workers)
    tasks = opt.with_goal(config.tasks, args.goal, [args.task])
    config = replace(config, sim=args.sim or DEFAULT_SIMULATOR, tasks=tasks)
    with bar(args, "running the episodes"):
        scores = zero_shot(source, policy, config)
    opt.print_result(args, zero_shot_data(scores), lambda: _table(scores, args.task))
    if args.out is not None:
        with status(args, "filming"):
            _film(source, policy, config, args)
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
    return tabulate(columns, headers="keys")


def _film(source: OneRobot, policy: Path, config: EvalConfig, args: argparse.Namespace) -> None:
    env, controller = make_env_and_controller(
        read_controller(str(policy), args.task),
        source.name,
        args.seed,
        config=GoalConfig(tasks=config.tasks).task_config(args.task),
        sim=config.sim,
        obstacles=args.obstacles,
        library=args.library,
        render_mode="rgb_array",
    )
    with closing(env):
        one_second = round(1 / CONTROL_PERIOD)
        frames = run_episodes(
            env, controller, FILM_EPISODES, args.seed, lambda episode: None, one_second
        )
        write_video(frames, args.out, FPS)

"""``morphgen zeroshot``: a policy that comes with morphgen acts on a robot it never saw."""

from __future__ import annotations

import argparse
import math
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, number, option, path_option
from morphgen.cli.progress import bar, print_line, status

if TYPE_CHECKING:
    from morphgen.rl.evaluation import EvalConfig
    from morphgen.rl.robot_source import RobotSource
    from morphgen.rl.zeroshot import ZeroShotResult

FILM_EPISODES = 3
"""Number of episodes in a video."""


@command(
    "zeroshot",
    "let a policy that comes with morphgen act on any robot, without training",
    opt.ROBOT,
    option("--task", default="reach", help="task of the robot (default: reach)"),
    path_option("--policy", "CHECKPOINT", "another policy: a checkpoint, or a run folder"),
    number("--episodes", "number of episodes", default=20),
    opt.OBSTACLES,
    opt.goal_option("that of the policy's training; of the policies here, position"),
    opt.SEED,
    opt.sim_option(),
    opt.WORKERS,
    path_option(
        "--out",
        "FILE",
        "a video of three episodes, which end after 1 s of success: .mp4 or .gif",
    ),
    *opt.LIBRARY_JSON,
    details="There are policies for reach and --goal pose, each also with --obstacles, and for "
    "push. The success rate has a 95% Wilson interval, and stands beside controllers that do not "
    "learn, in episodes with the same starts and goals: for reach ik (inverse kinematics with a "
    "planned path) and jacobian (each joint along its own Jacobian column), for push scripted (a "
    "planned push), and random actions.",
    examples=(
        "zeroshot arm=ur5 ee=stick",
        "zeroshot arm=ur5 ee=stick --goal pose --obstacles",
        "zeroshot arm=ur5 ee=stick --task push --out push.mp4",
        "zeroshot my_robot.urdf --out reach.mp4",
    ),
    extra="rl",
)
def zeroshot(args: argparse.Namespace) -> None:
    """Run the episodes, print the table, and write the video."""
    from morphgen.rl.evaluation import eval_config_of
    from morphgen.rl.robot_source import robot_source
    from morphgen.rl.runs import read_checkpoint
    from morphgen.rl.scores import finite_or_none
    from morphgen.rl.shipped_policies import checkpoint_path, zero_shot_policy
    from morphgen.rl.zeroshot import zero_shot
    from morphgen.tasks.reach import GOAL_KINDS
    from morphgen.tasks.registry import DEFAULT_SIMULATOR, TASKS
    from morphgen.tasks.renderer import require_video_path

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
    with bar(args, "running the episodes") as progress:
        results = zero_shot(
            source,
            policy,
            config,
            progress=lambda name, done, total: progress(int(done), total),
        )
    rows = [finite_or_none(asdict(result)) for result in results]
    opt.print_result(args, rows, lambda: _table(results, args.task))
    if args.out is not None:
        with status(args, "filming"):
            _film(source, policy, config, args)
        print_line(str(args.out))


def _table(results: list[ZeroShotResult], task: str) -> str:
    from tabulate import tabulate

    from morphgen.tasks.registry import TASKS

    columns = {
        "controller": [result.controller for result in results],
        "success": [result.success.as_percent() for result in results],
        "distance [m]": [f"{result.distance:.3f}" for result in results],
    }
    if not any(math.isnan(result.angle) for result in results):
        columns["angle [deg]"] = [f"{math.degrees(result.angle):.1f}" for result in results]
    if TASKS[task].relative_to_random:  # the score of others is their success
        columns["score"] = [f"{result.score:.1f}" for result in results]
    return tabulate(columns, headers="keys")


def _film(source: RobotSource, policy: Path, config: EvalConfig, args: argparse.Namespace) -> None:
    from morphgen.rl.play import FPS, make_env_and_controller, play, read_controller
    from morphgen.tasks.env_specs import GoalConfig
    from morphgen.tasks.renderer import write_video
    from morphgen.tasks.sim.base import CONTROL_PERIOD

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
        frames = play(env, controller, FILM_EPISODES, args.seed, lambda episode: None, one_second)
        write_video(frames, args.out, FPS)

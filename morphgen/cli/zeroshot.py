"""``morphgen zeroshot``: a policy that comes with morphgen reaches with a robot it never saw."""

from __future__ import annotations

import argparse
from contextlib import closing
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, number, path_option
from morphgen.cli.progress import bar, print_line, status

if TYPE_CHECKING:
    from morphgen.rl.robot_source import RobotSource
    from morphgen.rl.zeroshot import ZeroShotResult

FILM_EPISODES = 3
"""Number of episodes in a video."""


@command(
    "zeroshot",
    "let a policy that comes with morphgen reach with any robot, without training",
    opt.ROBOT,
    path_option("--policy", "CHECKPOINT", "another policy: a checkpoint, or a run folder"),
    number("--episodes", "number of episodes", default=20),
    opt.OBSTACLES,
    opt.SEED,
    opt.sim_option("mujoco"),
    opt.WORKERS,
    path_option(
        "--out",
        "FILE",
        "a video of three episodes, which end when the tool has been at the goal for 1 s: .mp4 or "
        ".gif",
    ),
    *opt.LIBRARY_JSON,
    details="The success rate has a 95% Wilson interval, and stands beside controllers that do not "
    "learn: jacobian (each joint along its own Jacobian column), ik (inverse kinematics with a "
    "planned path) and random actions, in episodes with the same starts and goals.",
    examples=("zeroshot arm=ur5 ee=stick", "zeroshot my_robot.urdf --out reach.mp4"),
    extra="rl",
)
def zeroshot(args: argparse.Namespace) -> None:
    """Run the episodes, print the table, and write the video."""
    from morphgen.rl.evaluation import EvalConfig
    from morphgen.rl.robot_source import robot_source
    from morphgen.rl.shipped_policies import checkpoint_path, zero_shot_policy
    from morphgen.rl.zeroshot import zero_shot
    from morphgen.tasks.renderer import require_video_path

    if args.out is not None:
        require_video_path(args.out)
    policy = checkpoint_path(args.policy or zero_shot_policy(obstacles=args.obstacles).name)
    with status(args, "reading the robot"):
        source = robot_source(
            " ".join(args.words), "reach", obstacles=args.obstacles, library=tuple(args.library)
        )
    config = EvalConfig(args.episodes, args.sim or "mujoco", args.seed, args.workers)
    with bar(args, "running the episodes") as progress:
        results = zero_shot(
            source,
            config,
            policy=policy,
            progress=lambda name, done, total: progress(int(done), total),
        )
    opt.print_result(args, [asdict(result) for result in results], lambda: _table(results))
    if args.out is not None:
        with status(args, "filming"):
            _film(source, policy, args)
        print_line(str(args.out))


def _table(results: list[ZeroShotResult]) -> str:
    from tabulate import tabulate

    rows = [
        (
            result.controller,
            result.success.as_percent(),
            f"{result.distance:.3f}",
            f"{result.score:.1f}",
        )
        for result in results
    ]
    return tabulate(rows, headers=("controller", "success", "distance [m]", "score"))


def _film(source: RobotSource, policy: Path, args: argparse.Namespace) -> None:
    from morphgen.rl.play import FPS, make_env_and_controller, play, read_controller
    from morphgen.tasks.renderer import write_video
    from morphgen.tasks.sim.base import CONTROL_PERIOD

    env, controller = make_env_and_controller(
        read_controller(str(policy), "reach"),
        source.name,
        args.seed,
        sim=args.sim or "mujoco",
        obstacles=args.obstacles,
        library=args.library,
        render_mode="rgb_array",
    )
    with closing(env):
        one_second = round(1 / CONTROL_PERIOD)
        frames = play(env, controller, FILM_EPISODES, args.seed, lambda episode: None, one_second)
        write_video(frames, args.out, FPS)

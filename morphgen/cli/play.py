"""``morphgen play``: run episodes of a robot, print results, and render a video."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_library, add_robot, add_sim, add_task
from morphgen.rl.baselines import BASELINES

if TYPE_CHECKING:
    from morphgen.rl.rollouts import Episode


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "play",
        help="run a controller on one robot, and render a video",
        description="Run episodes of one robot; print a line for each, and render a video.",
        epilog="examples: morphgen play reach arm=ur5 ee=stick --policy ik --out ik.mp4; "
        "morphgen play push prims --policy scripted --episodes 3 --sim mujoco",
    )
    add_task(parser, "task")
    add_robot(parser)
    parser.add_argument(
        "--policy",
        type=_policy,
        default="random",
        metavar="POLICY",
        help="the controller: zero (no action), random, ik (inverse kinematics, for reach), "
        "scripted (for push), or a checkpoint or a run's folder (default: random)",
    )
    parser.add_argument("--out", metavar="FILE", type=Path, help="the video: .mp4 or .gif")
    add_sim(parser)
    parser.add_argument("--episodes", type=int, default=1, help="default: 1")
    parser.add_argument("--seed", type=int, default=0, help="seed of the episodes (default: 0)")
    parser.add_argument("--obstacles", action="store_true", help="among obstacles")
    parser.add_argument(
        "--kind",
        choices=["continuous", "discrete"],
        help="kind of actions (default: that of the checkpoint, else continuous)",
    )
    add_library(parser)
    parser.set_defaults(run=run)


def _policy(text: str) -> str:
    if text not in BASELINES and not Path(text).exists():
        raise argparse.ArgumentTypeError(
            f"unknown policy {text!r}: expected one of {', '.join(BASELINES)}, or a path"
        )
    return text


def run(args: argparse.Namespace) -> int:
    """Run the episodes, print a line for each, and write the video."""
    from collections import deque

    from morphgen.errors import TaskError
    from morphgen.rl.play import FPS, interface_of, make_controller, play, require_policy
    from morphgen.tasks.gym_env import TaskEnv
    from morphgen.tasks.registry import TASKS
    from morphgen.tasks.renderer import require_video_path, write_video

    if args.episodes < 1 or args.seed < 0:
        raise TaskError(
            f"--episodes {args.episodes} --seed {args.seed}: at least one, and no negative seed"
        )
    require_policy(args.policy, args.task)
    if args.out is not None:
        require_video_path(args.out)
    interface = interface_of(args.policy)
    env = TaskEnv(
        args.task,
        " ".join(args.words),
        sim=args.sim,
        obstacles=args.obstacles,
        kind=args.kind or interface.kind,
        observe=interface.channels,
        max_links=interface.max_links,
        library=args.library,
        render_mode=None if args.out is None else "rgb_array",
    )
    try:
        acting = make_controller(args.policy, env, args.seed)
        frames = play(env, acting, args.episodes, args.seed, _Report(TASKS[args.task].target))
        if args.out is None:
            deque(frames, maxlen=0)
        else:
            write_video(frames, args.out, FPS)
            print(args.out)
    finally:
        env.close()
    return 0


class _Report:
    """Prints a line per episode."""

    def __init__(self, target: str) -> None:
        self._number, self._target = 0, target

    def __call__(self, episode: Episode) -> None:
        self._number += 1
        print(
            f"episode {self._number}: {'success' if episode.success else 'failure'}, "
            f"{episode.distance:.3f} m from the {self._target}, score {episode.score:.2f}, "
            f"{episode.seconds:.2f} s{', the simulation became unstable' * episode.unstable}",
            flush=True,
        )

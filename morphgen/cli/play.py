"""``morphgen play``: a robot at a task, with its results and a film."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli.options import Subparsers, add_library, add_sim, add_task
from morphgen.rl.names import REFERENCES

if TYPE_CHECKING:
    from morphgen.rl.rollouts import Episode


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "play",
        help="put a robot to work at a task, and film it",
        description="Run episodes of one robot; print a line for each, and film them.",
        epilog="examples: morphgen play reach arm=ur5 ee=stick --policy ik --out ik.mp4; "
        "morphgen play push prims --policy scripted --episodes 3 --sim mujoco",
    )
    add_task(parser, "task")
    parser.add_argument(
        "words",
        nargs="+",
        metavar="ROBOT",
        help="words of morphgen compose, parts such as ur5-plane, a bundle's folder or a URDF",
    )
    parser.add_argument(
        "--policy",
        type=_policy,
        default="random",
        metavar="POLICY",
        help="what acts: zero (nothing), random, ik (inverse kinematics, for reach), scripted (for "
        "push), or a checkpoint or a run's folder (default: random)",
    )
    parser.add_argument("--out", metavar="FILE", type=Path, help="the film: .mp4 or .gif")
    add_sim(parser)
    parser.add_argument("--episodes", type=int, default=1, help="default: 1")
    parser.add_argument("--seed", type=int, default=0, help="of the episodes (default: 0)")
    parser.add_argument("--obstacles", action="store_true", help="among obstacles")
    parser.add_argument(
        "--kind",
        choices=["continuous", "discrete"],
        help="of actions (default: a checkpoint's own, else continuous)",
    )
    add_library(parser)
    parser.set_defaults(run=run)


def _policy(text: str) -> str:
    if text not in REFERENCES and not Path(text).exists():
        raise argparse.ArgumentTypeError(
            f"{text!r} is none of {', '.join(REFERENCES)}, and no file"
        )
    return text


def run(args: argparse.Namespace) -> int:
    """Play, print a line an episode, and write the film."""
    from collections import deque

    from morphgen.errors import TaskError
    from morphgen.rl.play import FPS, controller, demands, play, require_policy
    from morphgen.tasks.gym_env import TaskEnv
    from morphgen.tasks.registry import TASKS
    from morphgen.tasks.renderer import require_film, write_film

    if args.episodes < 1 or args.seed < 0:
        raise TaskError(
            f"--episodes {args.episodes} --seed {args.seed}: at least one, and no negative seed"
        )
    require_policy(args.policy, args.task)
    if args.out is not None:
        require_film(args.out)
    wanted = demands(args.policy)
    env = TaskEnv(
        args.task,
        " ".join(args.words),
        sim=args.sim,
        obstacles=args.obstacles,
        kind=args.kind or wanted.kind,
        observe=wanted.channels,
        max_links=wanted.max_links,
        library=args.library,
        render_mode=None if args.out is None else "rgb_array",
    )
    try:
        acting = controller(args.policy, env, args.seed)
        frames = play(env, acting, args.episodes, args.seed, _Report(TASKS[args.task].target))
        if args.out is None:
            deque(frames, maxlen=0)
        else:
            write_film(frames, args.out, FPS)
            print(args.out)
    finally:
        env.close()
    return 0


class _Report:
    """Prints a line an episode."""

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

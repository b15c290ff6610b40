"""``morphgen speed``: how fast a task runs on this machine, and where its time goes."""

from __future__ import annotations

import argparse
import json

from morphgen.cli.options import Subparsers, add_json, add_library, add_sim, add_task


def add_parser(commands: Subparsers) -> None:
    """Declare the command."""
    parser = commands.add_parser(
        "speed",
        help="measure how fast a task runs here, and where its time goes",
        description="Step environments of one robot with random actions for some seconds; print "
        "environment steps (50 Hz) and physics steps (200 Hz) a second, and shares of the time. "
        "That of the simulator is its own step alone, if it runs in this one process or thread.",
        epilog="examples: morphgen speed reach arm=ur5 ee=plane --envs 128 --sim mujoco; "
        "morphgen speed push arm=panda ee=panda_hand --workers 2",
    )
    add_task(parser, "task")
    parser.add_argument(
        "robot", nargs="+", help="words of compose, the name of parts, a bundle's folder or a URDF"
    )
    parser.add_argument("--envs", type=int, default=64, help="environments (default: 64)")
    add_sim(parser)
    parser.add_argument(
        "--workers", type=int, default=1, help="processes of PyBullet, threads of MuJoCo"
    )
    parser.add_argument("--obstacles", action="store_true", help="among obstacles")
    parser.add_argument("--seconds", type=float, default=5.0, help="at least (default: 5)")
    add_library(parser)
    add_json(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    """Measure and print."""
    from importlib import import_module

    from tabulate import tabulate

    from morphgen.errors import TaskError
    from morphgen.tasks.make import make_batch
    from morphgen.tasks.registry import SIMULATORS
    from morphgen.tasks.speed import measure_speed

    if not args.seconds > 0:
        raise TaskError(f"--seconds {args.seconds:g}: expected more than 0")
    batch = make_batch(
        args.task,
        [" ".join(args.robot)],
        args.envs,
        sim=args.sim,
        workers=args.workers,
        obstacles=args.obstacles,
        max_links=None,
        library=args.library,
    )
    try:
        module, step = SIMULATORS[args.sim].native_step
        own = [(import_module(module), step)] if args.workers == 1 else []
        found = measure_speed(batch, args.seconds, own=own)
    finally:
        batch.close()
    if args.json:
        facts = {"steps_per_second": found.steps_per_second, "shares": found.shares}
        print(json.dumps(facts, indent=2))
        return 0
    name = batch.specs[0].robot.name
    print(f"{args.task}, {name}, {args.envs} environments, {args.sim}, {args.workers} worker(s)")
    print(f"environment steps a second: {found.steps_per_second:,.0f}")
    print(f"physics steps a second:     {found.substeps_per_second:,.0f}")
    print(tabulate([(part, f"{share:.1%}") for part, share in found.shares.items()]))
    return 0

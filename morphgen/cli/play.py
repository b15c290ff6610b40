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
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.command import command, flag, number, option, positive
from morphgen.cli.progress import bar, print_line, status
from morphgen.rl.baselines import BASELINES
from morphgen.rl.shipped_policies import POLICIES, checkpoint_path, zero_shot_policy
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS

if TYPE_CHECKING:
    from morphgen.rl.evaluation import EvalConfig
    from morphgen.rl.inference import Episode
    from morphgen.rl.runs.robot_source import RobotSource
    from morphgen.rl.scores import Score


OBSTACLES = flag("--obstacles", "place the robot among obstacles")


def _policy(text: str) -> str:
    names = (*BASELINES, *POLICIES)
    if text not in names and not Path(text).exists():
        raise argparse.ArgumentTypeError(
            f"unknown policy {text!r}: expected one of {', '.join(names)}, or a path"
        )
    return text


@command(
    "play",
    "run a controller on one robot, and render a video",
    opt.TASK,
    opt.ROBOT,
    option(
        "--policy POLICY",
        "the controller: zero (no action), random, jacobian (each joint along its own "
        "Jacobian column, for reach), ik (inverse kinematics, for reach), scripted (for push), "
        "zero-shot and zero-shot-obstacles (policies for reach that come with morphgen); or a "
        "checkpoint or run folder",
        _policy,
        default="random",
    ),
    option("--out FILE", "the video: .mp4 or .gif", Path),
    opt.sim_option(),
    opt.goal_option("that of the checkpoint, else position"),
    number("--episodes", "number of episodes", default=1),
    opt.SEED,
    OBSTACLES,
    option(
        "--kind",
        "kind of actions (default: that of the checkpoint, else continuous)",
        choices=["continuous", "discrete"],
    ),
    opt.LIBRARY,
    details="The result of each episode is printed.",
    examples=(
        "play reach arm=ur5 ee=stick --policy ik --out ik.mp4",
        "play push prims --policy scripted --episodes 3 --sim mujoco",
    ),
)
def play(args: argparse.Namespace) -> None:
    """Run the episodes, print a line for each, and write the video."""
    with status(args, "loading"):
        from morphgen.rl.inference import FPS, make_env_and_controller, play, read_controller
        from morphgen.tasks.render.renderer import require_video_path, write_video

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
            f"{episode.seconds:.2f} s{', the simulation diverged' * episode.unstable}"
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
        frames = play(env, controller, args.episodes, args.seed, report)
        if args.out is None:
            deque(frames, maxlen=0)  # runs the episodes and keeps no frame
        else:
            write_video(frames, args.out, FPS)
            print_line(str(args.out))


@command(
    "speed",
    "measure how fast a task runs on this machine, and where the time goes",
    opt.TASK,
    opt.ROBOT,
    number("--envs", "number of environments", default=64),
    opt.sim_option(),
    opt.WORKERS,
    option(
        "--device",
        "device of the environments: cpu, or cuda with --sim warp or kinematic (default: cpu; "
        "warp: cuda)",
    ),
    OBSTACLES,
    option("--seconds S", "least duration of the measurement", positive, default=5.0),
    *opt.LIBRARY_JSON,
    details="Environments of one robot are stepped with random actions. Environment steps are at "
    "50 Hz, physics steps at 200 Hz. The share of the simulator is its library's step alone, if it "
    "has one that runs in one process or thread.",
    examples=(
        "speed reach arm=ur5 ee=plane --envs 128 --sim mujoco",
        "speed push arm=panda ee=panda_hand --workers 2",
        "speed reach arm3 --envs 4096 --sim warp",
    ),
)
def speed(args: argparse.Namespace) -> None:
    """Measure the speed and print it."""
    with status(args, "loading"):
        from morphgen.tasks.scenes.make import make_batch
        from morphgen.tasks.speed import measure_speed

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
            f"{opt.table(shares)}"
        )

    data = {"steps_per_second": result.steps_per_second, "shares": result.shares}
    opt.print_result(args, data, text)


FILM_EPISODES = 3
"""Number of episodes in a video."""


@command(
    "zeroshot",
    "let a policy that comes with morphgen act on any robot, without training",
    opt.ROBOT,
    option("--task", "task of the robot (default: reach)", default="reach"),
    option("--policy CHECKPOINT", "another policy: a checkpoint, or a run folder", Path),
    number("--episodes", "number of episodes", default=20),
    opt.OBSTACLES,
    opt.goal_option("that of the policy's training; of the policies here, position"),
    opt.SEED,
    opt.sim_option(),
    opt.WORKERS,
    option(
        "--out FILE",
        "a video of three episodes, which end after 1 s of success: .mp4 or .gif",
        Path,
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
    from morphgen.rl.evaluation import eval_config_of, zero_shot, zero_shot_data
    from morphgen.rl.runs.checkpoint import read_checkpoint
    from morphgen.rl.runs.robot_source import robot_source
    from morphgen.tasks.reach import GOAL_KINDS
    from morphgen.tasks.render.renderer import require_video_path

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
    from morphgen.rl.scores import success_of

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
    return opt.table(columns, headers="keys")


def _film(source: RobotSource, policy: Path, config: EvalConfig, args: argparse.Namespace) -> None:
    from morphgen.rl.inference import FPS, make_env_and_controller, play, read_controller
    from morphgen.tasks.render.renderer import write_video
    from morphgen.tasks.scenes.env_specs import GoalConfig
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

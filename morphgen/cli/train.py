"""``morphgen train``: train an agent on the robots of a split, on one, or on drawn ones."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from morphgen.cli import options as opt
from morphgen.cli.agent_options import AGENT, AGENT_OPTIONS, agent_spec
from morphgen.cli.command import Option, command, flag, number, option, path_option, repeated
from morphgen.cli.progress import status, training_progress
from morphgen.cli.training_robots import (
    DRAWN_OPTIONS,
    SIDES,
    SPLIT_HELP,
    draw_robots,
    require_robots_for_options,
    robots_to_draw,
    robots_to_train,
)
from morphgen.errors import TaskError
from morphgen.rl.agents import AGENTS
from morphgen.rl.presets import PRESETS, preset_of
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.sim.base import COLLISION_GEOMETRIES

if TYPE_CHECKING:
    from morphgen.rl.agent_spec import AgentSpec
    from morphgen.rl.robot_source import RobotSource
    from morphgen.rl.runs import RunConfig
    from morphgen.rl.training import ExecutionConfig
    from morphgen.tasks.task import TaskConfig

NETWORK_SWITCHES = {
    "bf16": "run the networks in bfloat16",
    "compile": "run networks and losses with torch.compile",
}


def learning_options(num_steps: int | None, num_envs: int | None) -> tuple[Option, ...]:
    """Return the options of all commands that train.

    Args:
        num_steps: Default of ``--steps``; None if the preset determines it.
        num_envs: Default of ``--envs``; None if the preset determines it.
    """
    preset = "" if num_steps else " (default: the preset's)"
    return (
        number(
            "--steps",
            f"number of control steps of all environments together{preset}",
            default=num_steps,
        ),
        number(
            "--envs", f"number of environments, which the robots share{preset}", default=num_envs
        ),
        opt.WORKERS,
        opt.DEVICE,
        repeated(
            "--set",
            "set a hyperparameter, such as learning_rate=1e-4 or num_steps=32",
            metavar="NAME=VALUE",
        ),
        flag("--no-tensorboard", "write no TensorBoard events"),
        flag("--wandb", "also log metrics to Weights & Biases"),
    )


TRAINING_OPTIONS = (
    *learning_options(None, None),
    option(
        "--preset",
        choices=list(PRESETS),
        help="; ".join(f"{name}: {preset.summary}" for name, preset in PRESETS.items())
        + " (default: the agent's, fast for me-graph and paper for the agents of the paper)",
    ),
    opt.sim_option(),
    number(
        "--goal-seed", "seed of all goals (default: as shipped with the split, else 0)", least=0
    ),
    opt.goal_option(),
    number(
        "--train-goals",
        "number of goals of reach, or starts of push, per robot in training; evaluations "
        "have 100 (default: 100, as in the paper)",
        least=2,
    ),
    flag(
        "--whole",
        "agent se on a split: give each robot all steps and environments instead of a share",
    ),
    opt.MAX_LINKS,
    option(
        "--geometry",
        choices=COLLISION_GEOMETRIES,
        default=COLLISION_GEOMETRIES[0],
        help="collision shapes of the robots in training: all primitives, one for each link, "
        "which is faster (light), or convex pieces of the meshes (convex); evaluations have all "
        "primitives (default: primitive)",
    ),
    *(flag(f"--{name}", help) for name, help in NETWORK_SWITCHES.items()),
)
"""Options of the commands that train from random weights."""
RESUME = flag("--resume", "continue the run in the output folder")
MINUTES = number(
    "--minutes", "stop with a checkpoint after the update in which so many minutes are over"
)


@command(
    "train",
    "train an agent on the robots of a split, or on one robot",
    option(
        "words", nargs="+", metavar="SPLIT", help=f"{SPLIT_HELP}. The robot is {opt.ROBOT_HELP}"
    ),
    AGENT,
    opt.SEED,
    option("--on", choices=SIDES, default="train", help="side of the split"),
    opt.OBSTACLES,
    path_option("--out", "DIR", "run folder (default: runs/SPLIT/AGENT/seedN)"),
    RESUME,
    MINUTES,
    *DRAWN_OPTIONS,
    *AGENT_OPTIONS,
    *TRAINING_OPTIONS,
    opt.LIBRARY,
    details="The algorithm is PPO. The policy is written to the run folder. Ctrl-C, SIGTERM and "
    "--minutes stop after the running update, with a checkpoint; --resume continues from there.",
    examples=(
        "train interpolation/arm3/reach --agent me-tf --sim mujoco",
        "train arm=ur5 ee=stick task=reach --agent se",
        "train task=reach --robots arm3:300,chain:300 --agent me-tf --workers 4",
    ),
    extra="rl",
)
def train(args: argparse.Namespace) -> None:
    """Train and print the paths of the checkpoints."""
    with status(args, "loading"):
        from morphgen.rl.robot_source import other_side
        from morphgen.tasks.device import batch_device, require_simulator_device

    require_robots_for_options(args)
    sim = args.sim or DEFAULT_SIMULATOR
    require_simulator_device(sim, batch_device(sim, args.device))
    with status(args, "reading the robots"):
        spec = agent_spec(args)
        if args.robots is None:
            source = other_side(robots_to_train(args.words, args), args.on)
        else:
            source = robots_to_draw(args)
    config = run_config(source, spec, args)
    _require_used(config, args)
    if source.grammars:
        config = _drawn(config, args)
    name = _folder_name(source) + "-pose" * (args.goal == "pose")
    folder = args.out or Path("runs") / name / str(spec) / f"seed{args.seed}"
    run_training(folder, config, args)


def run_training(folder: Path, config: RunConfig, args: argparse.Namespace) -> None:
    """Train in a folder with a progress bar, and print the paths of the checkpoints."""
    from morphgen.rl.runs import CHECKPOINT
    from morphgen.rl.training import is_done, train

    with training_progress() as show:
        execution = execution_config(args)
        if config.source.grammars and not SIMULATORS[config.sim].takes_workers:
            execution = replace(execution, workers=1)  # those of --workers have drawn the robots
        subruns = train(
            folder,
            config,
            resume=args.resume,
            execution=execution,
            show=show,
            prepare=show.goal_sets,
        )
    for subrun in subruns:
        if (subrun.folder / CHECKPOINT).is_file():
            print(subrun.folder / CHECKPOINT)
    if subruns:  # of the processes of torchrun, the first one says it
        left = sum(not is_done(subrun) for subrun in subruns)
        if left:
            what = f" with {left} of {len(subruns)} robots left" * (len(subruns) > 1)
            text = f"stopped after {args.minutes} minutes{what}; it continues with --resume"
        else:
            text = _next_command(folder, config)
        print(text, file=sys.stderr)


def _next_command(folder: Path, config: RunConfig) -> str:
    """Return a line that says how to watch, or to score, what was trained."""
    source = config.source
    # Only the script that registered a task can play it.
    program = "morphgen"
    if source.task is not None and not TASKS.is_installed(source.task):
        program = f"python {shlex.quote(sys.argv[0])}"
    if source.grammars:
        return f"score it on fresh robots: {program} eval {shlex.quote(str(folder))}"
    if source.task is not None:
        words = [source.task, source.name, *["--obstacles"] * source.obstacles]
        words += ["--policy", str(folder), "--sim", config.sim]
        for library in source.library:
            words += ["--library", str(library)]
        return f"watch it: {program} play {shlex.join(words)} --out episode.mp4"
    return f"score it: {program} eval {shlex.quote(str(folder))}"


def run_config(source: RobotSource, spec: AgentSpec, args: argparse.Namespace) -> RunConfig:
    """Return the configuration of a run from the options.

    Raises:
        TaskError: If a number is out of its range.
    """
    from morphgen.rl.agent_spec import configs_of, parse_constants
    from morphgen.rl.robot_source import tasks_of
    from morphgen.rl.runs import RunConfig

    preset = preset_of(args.preset, spec.agent)
    changes = {**preset.constants, **parse_constants(args.set)}
    changes |= {"bf16": args.bf16, "compile": args.compile}
    spec = replace(spec, switches={**preset.switches, **spec.switches})
    steps = args.steps or preset.total_timesteps
    policy, ppo = configs_of(spec, tasks_of(source), changes, steps)
    return RunConfig(
        source,
        policy,
        ppo,
        seed=args.seed,
        sim=args.sim or DEFAULT_SIMULATOR,
        geometry=args.geometry,
        num_envs=args.envs or preset.num_envs,
        device=args.device,
        full_budget=args.whole and AGENTS[spec.agent].per_robot,
        max_links=args.max_links or _max_links(source),
        tasks=_task_configs(source, args),
    )


def _drawn(config: RunConfig, args: argparse.Namespace) -> RunConfig:
    """Draw the robots of a run, after all that can be checked before; return its configuration.

    Raises:
        TaskError: If a number is out of its range or has no effect.
        MorphgenError: If a robot cannot be drawn.
    """
    from morphgen.rl.training import require_runnable
    from morphgen.rl.training_batches import default_slice_updates, num_slices
    from morphgen.tasks.env_specs import GoalConfig

    if args.slice_updates is not None and num_slices(config) == 1:
        raise TaskError(
            f"--slice-updates {args.slice_updates}: {config.source.name} has an environment for "
            "every robot at all times"
        )
    slice_updates = args.slice_updates or default_slice_updates(config)
    config = replace(config, slice_updates=slice_updates)
    require_runnable(config)
    source, max_links = draw_robots(config.source, GoalConfig(tasks=config.tasks), args)
    return replace(config, source=source, max_links=max_links)


def _max_links(source: RobotSource) -> int:
    """Return the number of links that observations are padded to, unless ``--max-links`` is given.

    For a split it is the split's number. For drawn robots, of which the largest is not known yet,
    it is the benchmark's. For one robot it is the benchmark's, or the number of the
    robot's links if these are more, as for a robot with two arms.
    """
    from morphgen.benchmark.token_layout import default_max_links
    from morphgen.rl.robot_source import split_of
    from morphgen.tasks.env_specs import load_robot

    if source.split:
        return split_of(source).max_links
    if source.grammars:
        return default_max_links([])
    robot = load_robot(source.name, library=map(Path, source.library))
    return default_max_links([len(robot.links)])


def _task_configs(source: RobotSource, args: argparse.Namespace) -> tuple[TaskConfig, ...]:
    """Return the configurations of the tasks from ``--goal`` and ``--train-goals``.

    Raises:
        TaskError: If the split ships its own goals, or no robot has the task of ``--goal``.
    """
    from morphgen.rl.robot_source import tasks_of

    tasks, num_goals = tasks_of(source), args.train_goals
    names = dict.fromkeys((*TASKS.builtin, *tasks))
    configs = opt.with_goal((TASKS[name].config_type() for name in names), args.goal, tasks)
    if num_goals is None:
        return configs
    if source.goal_dir:
        raise TaskError(
            f"--train-goals {num_goals}: {source.goal_dir} ships the goals to train on; name the "
            f"split itself, {source.name}, to have others"
        )
    return tuple(replace(config, num_goals=num_goals) for config in configs)


def _require_used(config: RunConfig, args: argparse.Namespace) -> None:
    """Require that the agent uses all options that were given.

    A study does not require it: its options may be for some of its agents.

    Raises:
        TaskError: If an option has no effect.
    """
    from morphgen.rl.agent_spec import owners_of, parse_constants

    agent = config.policy.agent
    if args.whole and not AGENTS[agent].per_robot:
        valid = " or ".join(name for name in AGENTS if AGENTS[name].per_robot)
        raise TaskError(f"--whole is for --agent {valid}, not for {agent}")
    changed = parse_constants(args.set)
    for name in changed:
        owners = owners_of(name)
        if agent not in owners:
            raise TaskError(f"--set {name}: {agent} has none; valid for {' and '.join(owners)}")
    if "logit_scale" in changed and not config.policy.discrete:
        raise TaskError(
            "--set logit_scale: continuous actions have no logits; it is for --discrete"
        )


def execution_config(args: argparse.Namespace) -> ExecutionConfig:
    """Return how runs are executed.

    Raises:
        MissingDependencyError: If ``--wandb`` is given and Weights & Biases is not installed.
    """
    from morphgen.rl.training import ExecutionConfig

    minutes = getattr(args, "minutes", None)  # a study has none
    return ExecutionConfig(args.workers, not args.no_tensorboard, args.wandb, minutes)


def _folder_name(source: RobotSource) -> str:
    name = source.name if source.split else f"{Path(source.name).name}-{source.task}"
    if source.obstacles:
        name += "-obstacles"
    if source.side != "train":
        name += f"-{source.side}"
    return re.sub(r"[^\w./-]+", "-", name).strip("/.")

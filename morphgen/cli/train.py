"""``morphgen train``: train an agent on the robots of a split, on one, or on drawn ones."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from morphgen.cli import options as opt
from morphgen.cli.command import Option, command, flag, number, option, repeated
from morphgen.cli.progress import note, status, training_progress
from morphgen.errors import BenchmarkError, TaskError, nearest
from morphgen.rl.agents import AGENTS, PRESETS, preset_of
from morphgen.rl.shipped_policies import POLICIES, checkpoint_path
from morphgen.tasks.registry import (
    CHANNELS,
    COLLISION_GEOMETRIES,
    DEFAULT_SIMULATOR,
    SIMULATORS,
    TASKS,
)

if TYPE_CHECKING:
    from morphgen.rl.config import AgentSpec
    from morphgen.rl.runs.checkpoint import RunConfig
    from morphgen.rl.runs.robot_source import RobotSource
    from morphgen.rl.runs.training import ExecutionConfig
    from morphgen.tasks.scenes.env_specs import GoalConfig
    from morphgen.tasks.task import TaskConfig


AGENT = option("--agent", f"one of {', '.join(AGENTS)} (default: me-graph)", default="me-graph")
SWITCHES = {
    "symlog": ("the critic predicts the symlog of returns", "on"),
    "slow-critic": ("compute returns with a moving average of the critic", "on"),
    "discrete": ("discrete actions", "on if the task of all robots is reach"),
    "task-reweighting": ("weight the robots randomly", "off"),
    "curriculum": ("push: move the target line from near to far during training", "on"),
    "fixed-deviation": ("keep the initial standard deviation of continuous actions", "off"),
    "mask-morphology": ("hide the robot's morphology from the agent", "off"),
    "tool-position": ("add the tool's position to the observations", "off"),
    "residual": ("add the actions to the steps that the channel ik shows", "off"),
    "normalize": ("normalize the kinematic channels of observations", "off"),
    "robot-advantages": ("normalize advantages robot by robot", "off"),
    "joint-entropy": ("weigh the mean entropy of the joints instead of their sum", "off"),
}
"""Purpose of each switch, and its default without a preset that sets it."""


def switch_help(name: str) -> str:
    """Return the help of a switch, with its default in every preset."""
    purpose, default = SWITCHES[name]
    others = [
        f"{'on' if preset.switches[name] else 'off'} with --preset {label}"
        for label, preset in PRESETS.items()
        if name in preset.switches
    ]
    return f"{purpose} (default: {'; '.join([default, *others])})"


def on_off(name: str, help: str, default: bool | None = None) -> Option:
    """Return an option ``--name`` with its opposite ``--no-name``."""
    return Option(
        (f"--{name}",), {"action": argparse.BooleanOptionalAction, "default": default, "help": help}
    )


OBSERVE = option(
    "--observe A,B,...",
    "further channels of the observations: "
    + ", ".join(CHANNELS).replace("_", "-")
    + "".join(
        f"; --preset {label} has {', '.join(names)} already, and --agent AGENT-NAME drops one"
        for label, preset in PRESETS.items()
        if (names := [name for name in preset.switches if name.replace("-", "_") in CHANNELS])
    ),
    default="",
)
AGENT_OPTIONS = (*(on_off(name, switch_help(name)) for name in SWITCHES), OBSERVE)


def agent_spec(args: argparse.Namespace) -> AgentSpec:
    """Return the agent with the switches that were given."""
    from morphgen.rl.config import OBSERVATION_SWITCHES, parse_agent

    values = {name: getattr(args, name.replace("-", "_")) for name in SWITCHES}
    spec = parse_agent(args.agent)
    switches = {name: value for name, value in values.items() if value is not None}
    observed = [name for name in args.observe.split(",") if name]
    for name in observed:
        if name not in OBSERVATION_SWITCHES:
            raise TaskError(f"--observe {name}{nearest(name, OBSERVATION_SWITCHES)}")
    return replace(spec, switches={**spec.switches, **switches, **dict.fromkeys(observed, True)})


SPLIT_HELP = (
    "name of a split, its file or built folder; or a robot and its task, such as arm=ur5 ee=stick "
    "task=reach"
)
SIDES = ["train", "test"]
GOAL_SEED = number(
    "--goal-seed", "with --split: seed of all goals (default: as shipped, else 0)", least=0
).needing("--split")

DRAWN_OPTIONS = (
    option(
        "--robots GRAMMAR:N,...",
        "train on N robots drawn from each grammar, such as arm3:300,chain:300, by as many "
        "processes as --workers; the test robots of the splits of morphgen are never drawn",
    ),
    number("--robot-seed", "with --robots: seed of the robots (default: 0)", least=0).needing(
        "--robots"
    ),
    repeated(
        "--held-out SPLIT", "with --robots: a further split whose test robots are never drawn"
    ).needing("--robots"),
    number(
        "--slice-updates",
        "with more --robots than --envs: number of updates after which the next robots take the "
        "environments (default: those of two episodes)",
    ).needing("--robots"),
)
"""Options of robots that are drawn from grammars."""


def split_option(purpose: str) -> Option:
    """Return the option ``--split``, whose words ``robots_to_train`` reads."""
    return option("--split SPLIT", f"{purpose}: {SPLIT_HELP}", dest="words", nargs="+", default=[])


def robots_to_train(words: list[str], args: argparse.Namespace) -> RobotSource:
    """Return the robots that a split, or a robot and ``task=NAME``, describe."""
    from morphgen.benchmark.split_folder import read_split_or_folder
    from morphgen.rl.runs.robot_source import robot_source, split_source
    from morphgen.tasks.goals.split_goals import has_goals, read_split_goals

    seed, library = args.goal_seed or 0, tuple(args.library)
    choices = " or ".join(f"task={name}" for name in TASKS)
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    robot = " ".join(word for word in words if not word.startswith("task="))
    if tasks:
        if len(tasks) > 1 or not robot:
            raise TaskError(f"{' '.join(words)}: name a robot and one task, {choices}")
        TASKS[tasks[0]]  # raises if the task is unknown
        return robot_source(
            robot, tasks[0], obstacles=args.obstacles, goal_seed=seed, library=library
        )
    if len(words) > 1 or "=" in words[0]:
        raise TaskError(f"{' '.join(words)}: a robot needs its task, {choices}")
    if args.obstacles:
        raise TaskError("--obstacles is for one robot; a split says which robots have obstacles")
    try:
        split, folder = read_split_or_folder(words[0])
    except BenchmarkError as error:
        if Path(words[0]).exists():
            raise
        raise BenchmarkError(f"{error}; a robot needs {choices}") from error
    goal_folder = folder if folder is not None and has_goals(folder) else None
    if goal_folder is not None:
        shipped_seed = read_split_goals(goal_folder).config.seed
        if args.goal_seed not in (None, shipped_seed):
            raise TaskError(
                f"--goal-seed {seed}: the goals in {goal_folder} are of seed {shipped_seed}"
            )
        seed = shipped_seed
    return split_source(split, side=args.on, goal_seed=seed, goals=goal_folder, library=library)


def robots_to_draw(args: argparse.Namespace) -> RobotSource:
    """Return the source that ``--robots`` describes; none of its robots is drawn yet."""
    from morphgen.rl.runs.robot_source import drawn_source

    choices = " or ".join(f"task={name}" for name in TASKS)
    words, task = " ".join(args.words), args.words[0].removeprefix("task=")
    if words != f"task={task}":
        raise TaskError(f"{words}: with --robots, name the task and nothing else: {choices}")
    if args.on != "train":
        raise TaskError(f"--on {args.on}: drawn robots have no sides; --on goes with a split")
    TASKS[task]  # raises if the task is unknown
    return drawn_source(
        args.robots,
        task,
        seed=args.robot_seed or 0,
        held_out=args.held_out,
        obstacles=args.obstacles,
        goal_seed=args.goal_seed or 0,
        library=args.library,
    )


def draw_robots(
    source: RobotSource, config: GoalConfig, args: argparse.Namespace
) -> tuple[RobotSource, int]:
    """Draw the robots of a source and print how many were skipped.

    Returns:
        The source with the hash of its robots, and the number of links that observations are
        padded to: ``--max-links`` if it is given, else the largest of the benchmark's number, those
        of the splits of ``--held-out`` and the links of the largest robot.
    """
    from morphgen.encoding.tokens import default_max_links
    from morphgen.rl.runs.robot_source import draw
    from morphgen.splits.split_file import read_split

    with training_progress():
        robots = draw(source, config, jobs=args.workers)
    if robots.skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in robots.skipped.items())
        note(f"morphgen: robots that were skipped: {reasons}")
    held_out = (read_split(name).max_links for name in source.held_out)
    max_links = args.max_links or default_max_links([robots.most_links, *held_out])
    return replace(source, drawn_hash=robots.hash), max_links


NETWORK_SWITCHES = {
    "bf16": "run the networks in bfloat16",
    "compile": "run networks and losses with torch.compile",
}


def learning_options(num_steps: int | None, num_envs: int | None) -> tuple[Option, ...]:
    """Return the options of all commands that train."""
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
            "--set NAME=VALUE", "set a hyperparameter, such as learning_rate=1e-4 or num_steps=32"
        ),
        flag("--no-tensorboard", "write no TensorBoard events"),
        flag("--wandb", "also log metrics to Weights & Biases"),
    )


TRAINING_OPTIONS = (
    *learning_options(None, None),
    option(
        "--preset",
        "; ".join(f"{name}: {preset.summary}" for name, preset in PRESETS.items())
        + " (default: the agent's, fast for me-graph and paper for the agents of the paper)",
        choices=list(PRESETS),
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
        "collision shapes of the robots in training: primitives, or convex pieces of the "
        "meshes; evaluations have primitives (default: primitive)",
        choices=COLLISION_GEOMETRIES,
        default=COLLISION_GEOMETRIES[0],
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
    option("words SPLIT", f"{SPLIT_HELP}. The robot is {opt.ROBOT_HELP}", nargs="+"),
    AGENT,
    opt.SEED,
    option("--on", "side of the split", choices=SIDES, default="train"),
    opt.OBSTACLES,
    option("--out DIR", "run folder (default: runs/SPLIT/AGENT/seedN)", Path),
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
        from morphgen.rl.runs.robot_source import other_side
        from morphgen.tasks.registry import batch_device, require_simulator_device

    sim = args.sim or DEFAULT_SIMULATOR
    require_simulator_device(sim, batch_device(sim, args.device))
    with status(args, "reading the robots"):
        spec = agent_spec(args)
        if args.robots is None:
            source = other_side(robots_to_train(args.words, args), args.on)
        else:
            source = robots_to_draw(args)
    config = run_config(source, spec, args)  # before robots are drawn, which takes minutes
    _require_used(config, args)
    if source.grammars:
        config = _drawn(config, args)
    # Positions came first and have no suffix.
    name = _folder_name(source) + "-pose" * (args.goal == "pose")
    folder = args.out or Path("runs") / name / str(spec) / f"seed{args.seed}"
    run_training(folder, config, args)


def run_training(folder: Path, config: RunConfig, args: argparse.Namespace) -> None:
    """Train in a folder with a progress bar, and print the paths of the checkpoints."""
    from morphgen.rl.runs.checkpoint import CHECKPOINT
    from morphgen.rl.runs.training import is_done, train

    with training_progress("with --resume") as show:
        execution = execution_config(args)
        if config.source.grammars and not SIMULATORS[config.sim].takes_workers:
            execution = replace(execution, workers=1)  # those of --workers have drawn the robots
        subruns = train(folder, config, resume=args.resume, execution=execution, show=show.training)
    for subrun in subruns:
        if (subrun.folder / CHECKPOINT).is_file():
            print(subrun.folder / CHECKPOINT)
    if subruns:  # the first process of torchrun alone says it
        left = sum(not is_done(subrun) for subrun in subruns)
        if left:
            what = f" with {left} of {len(subruns)} robots left" * (len(subruns) > 1)
            text = f"stopped after {args.minutes} minutes{what}; it continues with --resume"
        else:
            text = _next_command(folder, config)
        note(text)


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
    """Return the configuration of a run from the options."""
    from morphgen.rl.config import configs_of, parse_constants
    from morphgen.rl.runs.checkpoint import RunConfig
    from morphgen.rl.runs.robot_source import tasks_of

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
    """Draw the robots of a run, after all that can be checked before; return its configuration."""
    from morphgen.rl.runs.training import default_slice_updates, num_slices, require_runnable
    from morphgen.tasks.scenes.env_specs import GoalConfig

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
    from morphgen.encoding.tokens import default_max_links
    from morphgen.rl.runs.robot_source import split_of
    from morphgen.tasks.scenes.env_specs import load_robot

    if source.split:
        return split_of(source).max_links
    if source.grammars:
        return default_max_links([])
    robot = load_robot(source.name, library=map(Path, source.library))
    return default_max_links([len(robot.links)])


def _task_configs(source: RobotSource, args: argparse.Namespace) -> tuple[TaskConfig, ...]:
    """Return the configurations of the tasks from ``--goal`` and ``--train-goals``."""
    from morphgen.rl.runs.robot_source import tasks_of

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
    """
    from morphgen.rl.config import owners_of, parse_constants

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
    """Return how runs are executed."""
    from morphgen.rl.runs.training import ExecutionConfig

    minutes = getattr(args, "minutes", None)  # a study has none
    return ExecutionConfig(args.workers, not args.no_tensorboard, args.wandb, minutes)


def _folder_name(source: RobotSource) -> str:
    name = source.name if source.split else f"{Path(source.name).name}-{source.task}"
    if source.obstacles:
        name += "-obstacles"
    if source.side != "train":
        name += f"-{source.side}"
    return re.sub(r"[^\w./-]+", "-", name).strip("/.")


@command(
    "finetune",
    "train a policy further, by default on the test robots of its split",
    option("checkpoint", f"a checkpoint, a run folder, or {', '.join(POLICIES)}"),
    split_option("other robots than those of the checkpoint's split"),
    option("--on", "side of the split", choices=SIDES, default="test"),
    opt.OBSTACLES.needing("--split"),
    opt.SEED,
    opt.sim_option("that of the training"),
    GOAL_SEED,
    opt.goal_option("that of the training"),
    option(
        "--out DIR",
        "run folder (default: finetuned/SIDE-seedN in the folder of the checkpoint)",
        Path,
    ),
    RESUME,
    MINUTES,
    *(
        on_off(name, f"{help} (default: as the checkpoint's run)")
        for name, help in NETWORK_SWITCHES.items()
    ),
    on_off(
        "curriculum",
        "push: move the target line from near to far again (default: it stays far)",
        default=False,
    ),
    # 64 is NUM_ENVS of morphgen.rl.runs.training, whose import takes seconds.
    *learning_options(100_000, 64),
    opt.LIBRARY.needing("--split"),
    details="The run begins with the networks of the checkpoint, and with a new optimiser and "
    "schedule. The agent and most hyperparameters are the checkpoint's. The learning rate follows "
    "the change of the policy, so that little of what it can do is lost.",
    examples=("finetune runs/interpolation/arm3/reach/me-tf/seed0 --on test --steps 300000",),
    extra="rl",
)
def finetune(args: argparse.Namespace) -> None:
    """Train and print the path of the checkpoint."""
    from morphgen.rl.runs.training import checkpoint_files

    files = list(checkpoint_files(checkpoint_path(args.checkpoint)))
    if len(files) > 1:
        raise TaskError(
            f"{args.checkpoint} has {len(files)} policies: name one, such as {files[0]}"
        )
    shipped = args.checkpoint in POLICIES
    parent = Path("runs") / args.checkpoint if shipped else files[0].parent
    folder = args.out or parent / "finetuned" / f"{args.on}-seed{args.seed}"
    run_training(folder, _finetuning_config(files[0], args), args)


def _finetuning_config(file: Path, args: argparse.Namespace) -> RunConfig:
    from morphgen.rl.config import PPOConfig, parse_constants
    from morphgen.rl.runs.checkpoint import read_checkpoint
    from morphgen.rl.runs.robot_source import other_side, tasks_of
    from morphgen.rl.runs.training import finetuning_config

    initial, _ = read_checkpoint(file)
    if args.words:
        source = robots_to_train(args.words, args)
    else:
        source = other_side(initial.source, args.on)
    changes: dict[str, Any] = parse_constants(args.set)
    if unknown := set(changes) - {field.name for field in fields(PPOConfig)}:
        raise TaskError(f"--set {min(unknown)}: the networks are those of the checkpoint")
    switches = {name: getattr(args, name) for name in NETWORK_SWITCHES}
    changes |= {name: value for name, value in switches.items() if value is not None}
    changes |= {"total_timesteps": args.steps, "curriculum": args.curriculum}
    return replace(
        finetuning_config(initial, source, str(file.resolve()), changes),
        seed=args.seed,
        sim=args.sim or initial.sim,
        num_envs=args.envs,
        device=args.device,
        tasks=opt.with_goal(initial.tasks, args.goal, tasks_of(source)),
    )

"""Train policies: which robots, with which configuration."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from morphgen.benchmark.split_folder import read_split_or_folder
from morphgen.encoding.tokens import default_max_links, require_max_links
from morphgen.errors import BenchmarkError, TaskError, require_types
from morphgen.formats.bundle import SUFFIXES
from morphgen.grammar.library import LibraryFolders, library_folders
from morphgen.grammar.robot_source import is_robot_folder, is_set_folder
from morphgen.grammar.sampling import GRAMMAR
from morphgen.processes import usable_cores
from morphgen.progress import note
from morphgen.rl.agents import AGENTS, ME_GRAPH, preset_of
from morphgen.rl.config import AgentSpec, configs_of, owners_of, parse_agent, parse_constants
from morphgen.rl.runs import robot_source
from morphgen.rl.runs.checkpoint import CHECKPOINT, CONFIG, RunConfig, read_checkpoint, read_config
from morphgen.rl.runs.training import (
    ExecutionConfig,
    ShowMetrics,
    Subrun,
    checkpoint_files,
    default_slice_updates,
    is_done,
    require_runnable,
)
from morphgen.rl.runs.training import train as train_parts
from morphgen.rl.shipped_policies import checkpoint_path
from morphgen.splits.split import Side, read_split, require_side
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.registry import (
    DEFAULT_SIMULATOR,
    SIMULATORS,
    TASKS,
    batch_device,
    require_simulator_device,
)
from morphgen.tasks.scenes.env_specs import IN_EVERY_FILE, GoalConfig, load_robot
from morphgen.tasks.split_goals import has_goals, read_split_goals
from morphgen.tasks.task import TaskConfig


@dataclass(frozen=True)
class TrainingRun:
    """A run of training, which ended or was stopped."""

    folder: Path
    """Folder of the run; ``morphgen.evaluate`` and ``load_policy`` take it."""
    config: RunConfig = field(repr=False)
    """All that determines the weights."""
    parts: tuple[Subrun, ...] = field(repr=False)
    """The run, or a part for each robot."""

    @property
    def checkpoints(self) -> tuple[Path, ...]:
        """Checkpoints that the run has so far."""
        files = (part.folder / CHECKPOINT for part in self.parts)
        return tuple(file for file in files if file.is_file())

    @property
    def unfinished(self) -> int:
        """Number of parts that continue with ``resume``."""
        return sum(not is_done(part) for part in self.parts)

    def __str__(self) -> str:
        """Return the paths of the checkpoints, a line each."""
        return "\n".join(map(str, self.checkpoints))


def train(
    robots: str | PathLike[str],
    *,
    agent: str = "me-graph",
    preset: str | None = None,
    steps: int | None = None,
    envs: int | None = None,
    sim: str | None = None,
    workers: int | None = None,
    device: str = "cpu",
    seed: int = 0,
    out: str | PathLike[str] | None = None,
    resume: bool = False,
    minutes: int | None = None,
    on: Side = "train",
    obstacles: bool = False,
    drawn: str | None = None,
    robot_seed: int | None = None,
    held_out: Sequence[str | Path] = (),
    initial: str | PathLike[str] | None = None,
    constants: Mapping[str, float] | Sequence[str] = (),
    tensorboard: bool = True,
    goal_seed: int | None = None,
    goal: str | None = None,
    train_goals: int | None = None,
    whole: bool = False,
    max_links: int | None = None,
    bf16: bool = False,
    compile: bool = False,
    library: LibraryFolders = (),
    show: Callable[[Subrun], ShowMetrics] | None = None,
) -> TrainingRun:
    """Train an agent by PPO on the robots of a split, or on one robot.

    Ctrl-C stops after the running update, with a checkpoint; ``resume`` continues from there.

    Examples:
        >>> small = {"num_steps": 16, "minibatches": 2}
        >>> run = morphgen.train("prims task=reach", steps=256, envs=8, constants=small)
        >>> print(run)
        runs/prims-reach/me-graph/seed0/checkpoint.pt
        >>> (score,) = morphgen.evaluate(run.folder, episodes=2).scores["deterministic"]
        >>> score.robot, score.episodes
        ('prims', 2)

    Args:
        robots: Name of a split, its file or built folder; or a robot and its task, such as
            ``arm=ur5 ee=stick task=reach``; or with ``drawn`` the task alone, ``task=reach``.
        agent: ``se``, ``me-mlp``, ``me-tf`` or ``me-graph``, with switches that are on (+) or
            off (-) and channels of observations: ``me-tf-symlog+task-reweighting+ik``.
        preset: Constants and switches to begin with: ``fast`` or ``paper``; by default the agent's.
        steps: Number of control steps of all environments together; by default the preset's, or
            with ``resume`` that of the run, as for ``envs`` and ``sim``.
        envs: Number of environments, which the robots share; by default the preset's.
        sim: Name of the simulator, by default ``mujoco``.
        workers: Number of threads of MuJoCo; by default as many as the environments and the cores
            allow.
        device: Device of the networks: ``cpu`` or ``cuda``.
        seed: Seed of weights, actions and episodes.
        out: Folder of the run, by default ``runs/SPLIT/AGENT/seedN``.
        resume: Whether to continue the run in the folder.
        minutes: Stop with a checkpoint after the update in which so many minutes are over.
        on: Side of the split, ``train`` or ``test``.
        obstacles: Whether one robot is among obstacles.
        drawn: Numbers of robots to draw from grammars, such as ``arm3:300,chain:300``.
        robot_seed: Seed of the drawn robots, by default 0.
        held_out: Splits whose test robots are never drawn, besides those of morphgen.
        initial: A checkpoint, a run folder or a policy that comes with morphgen, whose networks
            the run begins with.
        constants: Hyperparameters, such as ``{"learning_rate": 1e-4}``, or ``NAME=VALUE`` texts.
        tensorboard: Whether to write TensorBoard events.
        goal_seed: Seed of all goals; by default as shipped with the split, else 0.
        goal: Goal of reach: ``position`` (default), within 3 cm, or ``pose``, also 10 degrees.
        train_goals: Number of goals or starts per robot; by default 100, as in evaluations.
        whole: Whether ``se`` trains each robot of a split with all steps and environments.
        max_links: Number of links that observations have room for; by default at least 23.
        bf16: Whether to run the networks in bfloat16.
        compile: Whether to run networks and losses with ``torch.compile``.
        library: Folders of your own parts.
        show: Function that begins to show a part of the run, and returns one that receives the
            metrics of each update and the number of all updates.

    Returns:
        The folder of the run, and its checkpoints.

    Raises:
        TaskError: If an argument is unknown or invalid, or the folder has another run.
        MorphgenError: If a split or a robot cannot be read, or a robot cannot do the task.
    """
    given = SimpleNamespace(**locals())
    texts = ("agent", "preset", "sim", "device", "drawn", "goal")
    least = {"minutes": 1, "robot_seed": 0, "train_goals": 2, "max_links": 2}
    least |= {"steps": 1, "envs": 1, "workers": 1, "seed": 0, "goal_seed": 0}
    require_types(train, given, *texts, **least)
    require_side(on)
    spec = parse_agent(agent)
    if drawn is None:
        if robot_seed is not None or held_out:
            raise TaskError("robot_seed and held_out: only with drawn")
        source: robot_source.Source = robot_source.other_side(named_source(given), on)
    else:
        source = _source_to_draw(given)
    # Positions came first and have no suffix.
    name = folder_name(source) + "-pose" * (goal == "pose")
    folder = Path(out) if out is not None else Path("runs") / name / str(spec) / f"seed{seed}"
    if resumed := resumed_config(folder, resume=resume):
        given.steps = steps or resumed.ppo.total_timesteps
        given.envs = envs or resumed.num_envs
        given.sim = sim or resumed.sim
    config = _with_networks_of(initial, agent, run_config(source, spec, given), folder)
    require_simulator_device(config.sim, batch_device(config.sim, device))
    _require_used(config, given)
    if isinstance(source, robot_source.GrammarSource):
        config = _with_drawn_robots(config, source, given)  # which takes minutes
    return train_run(folder, config, given)


def _with_networks_of(
    initial: str | PathLike[str] | None, agent: str, config: RunConfig, folder: Path
) -> RunConfig:
    """Return the configuration of a run in a folder that begins with a checkpoint's networks."""
    if initial is None:
        return config
    if agent != ME_GRAPH.name:
        raise TaskError(
            f"agent {agent}: the networks are those of {initial}; leave out agent, preset, observe"
        )
    file = one_checkpoint(initial)
    policy = read_checkpoint(file)[0].policy
    return replace(config, policy=policy, initial_checkpoint=path_from(folder, file))


def path_from(folder: Path, file: Path) -> str:
    """Return the path of a file from a run's folder.

    Checkpoints are published, and an absolute path names its user.
    """
    return os.path.relpath(file.resolve(), folder.resolve())


def one_checkpoint(policy: str | PathLike[str]) -> Path:
    """Return the checkpoint of a file, a run folder or a shipped policy, which must have one."""
    path = checkpoint_path(Path(policy) if isinstance(policy, PathLike) else policy)
    file, *others = checkpoint_files(path)
    if others:
        raise TaskError(f"{policy} has {len(others) + 1} policies: name one, such as {file}")
    return file


def resumed_config(folder: Path, *, resume: bool) -> RunConfig | None:
    """Return the configuration of the run that ``resume`` continues, if there is one."""
    return read_config(folder) if resume and (folder / CONFIG).is_file() else None


def named_source(
    given: SimpleNamespace, side: Side = "train"
) -> robot_source.SplitSource | robot_source.OneRobot:
    """Return the robots that a split, or the words of a robot and ``task=NAME``, describe."""
    text, folders = str(given.robots), library_folders(given.library)
    words = [text] if Path(text).exists() else text.split() or [text]
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    robot = " ".join(word for word in words if not word.startswith("task="))
    if tasks:
        if len(tasks) > 1 or not robot:
            raise TaskError(f"{text}: name a robot and one task, {_task_choices()}")
        TASKS[tasks[0]]  # raises if the task is unknown
        return robot_source.robot_source(
            robot,
            tasks[0],
            obstacles=given.obstacles,
            goal_seed=given.goal_seed or 0,
            library=folders,
        )
    path = Path(text)
    if len(words) > 1 or "=" in text or is_robot_folder(path) or path.suffix in SUFFIXES:
        raise TaskError(f"{text}: a robot needs its task, {_task_choices()}")
    if is_set_folder(path):
        raise TaskError(
            f"{text} is a set of robots; expected a split, such as one that morphgen split new "
            f"interpolation --grammar {path / GRAMMAR} makes"
        )
    if given.obstacles:
        raise TaskError("--obstacles is for one robot; a split says which robots have obstacles")
    try:
        return split_side(text, side, given.goal_seed, folders)
    except BenchmarkError as error:
        if Path(text).exists():
            raise
        raise BenchmarkError(f"{error}; a robot needs {_task_choices()}") from error


def _task_choices() -> str:
    return " or ".join(f"task={name}" for name in TASKS)


def split_side(
    split: str | PathLike[str], side: Side, goal_seed: int | None, library: Sequence[Path]
) -> robot_source.SplitSource:
    """Return a side of a split, with the goals that its folder ships."""
    definition, folder = read_split_or_folder(split)
    goals = folder if folder is not None and has_goals(folder) else None
    seed = goal_seed or 0
    if goals is not None:
        shipped = read_split_goals(goals).config.seed
        if goal_seed not in (None, shipped):
            raise TaskError(f"--goal-seed {seed}: the goals in {goals} are of seed {shipped}")
        seed = shipped
    folders = tuple(library)
    return robot_source.split_source(
        definition, side=side, goal_seed=seed, goals=goals, library=folders
    )


def _source_to_draw(given: SimpleNamespace) -> robot_source.GrammarSource:
    """Return the source of the drawn robots of ``train``; none of them is drawn yet."""
    words, task = str(given.robots), str(given.robots).partition(" ")[0].removeprefix("task=")
    if words != f"task={task}":
        raise TaskError(
            f"{words}: with --robots, name the task and nothing else: {_task_choices()}"
        )
    if given.on != "train":
        raise TaskError(f"--on {given.on}: drawn robots have no sides; --on goes with a split")
    for each in task.split(","):
        TASKS[each]  # raises if the task is unknown
    return robot_source.drawn_source(
        given.drawn,
        task,
        seed=given.robot_seed or 0,
        held_out=given.held_out,
        obstacles=given.obstacles,
        goal_seed=given.goal_seed or 0,
        library=library_folders(given.library),
    )


def run_config(source: robot_source.Source, spec: AgentSpec, given: SimpleNamespace) -> RunConfig:
    """Return the configuration of a run from arguments of ``train``."""
    preset = preset_of(given.preset, spec.agent)
    changes = {**preset.constants, **read_constants(given.constants)}
    changes |= {"bf16": given.bf16, "compile": given.compile}
    spec = replace(spec, switches={**preset.switches, **spec.switches})
    steps = given.steps or preset.total_timesteps
    policy, ppo = configs_of(spec, robot_source.tasks_of(source), changes, steps)
    return RunConfig(
        source,
        policy,
        ppo,
        seed=given.seed,
        sim=given.sim or DEFAULT_SIMULATOR,
        num_envs=given.envs or preset.num_envs,
        device=given.device,
        full_budget=given.whole and AGENTS[spec.agent].per_robot,
        max_links=given.max_links or _max_links(source),
        tasks=_task_configs(source, given.goal, given.train_goals),
    )


def read_constants(constants: Mapping[str, float] | Sequence[str]) -> dict[str, Any]:
    """Return hyperparameters whose names and types are valid."""
    if isinstance(constants, Mapping):
        constants = [f"{name}={value}" for name, value in constants.items()]
    return parse_constants(constants)


def _max_links(source: robot_source.Source) -> int:
    """Return the split's number of links; else the benchmark's, or more for one larger robot."""
    if isinstance(source, robot_source.SplitSource):
        return robot_source.split_of(source).max_links
    if isinstance(source, robot_source.GrammarSource):
        return default_max_links([])
    robot = load_robot(source.name, library=map(Path, source.library))
    return default_max_links([len(robot.links)])


def _task_configs(
    source: robot_source.Source, goal: str | None, num_goals: int | None
) -> tuple[TaskConfig, ...]:
    """Return the configurations of the tasks with a goal of reach and a number of goals."""
    tasks = robot_source.tasks_of(source)
    names = dict.fromkeys((*IN_EVERY_FILE, *tasks))
    configs = with_goal((TASKS[name].config_type() for name in names), goal, tasks)
    if num_goals is None:
        return configs
    if isinstance(source, robot_source.SplitSource) and source.goal_dir:
        raise TaskError(
            f"--train-goals {num_goals}: {source.goal_dir} ships the goals to train on; name the "
            f"split itself, {source.name}, to have others"
        )
    return tuple(replace(config, num_goals=num_goals) for config in configs)


def with_goal(
    configs: Iterable[TaskConfig], goal: str | None, tasks: Iterable[str]
) -> tuple[TaskConfig, ...]:
    """Return configs of tasks with a goal of reach, of ``GOAL_KINDS``; None keeps it."""
    if goal is None:
        return tuple(configs)
    if ReachConfig.task not in (names := tuple(dict.fromkeys(tasks))):
        raise TaskError(
            f"--goal {goal} is for task {ReachConfig.task}; the tasks of the robots: "
            f"{' and '.join(names)}"
        )
    return tuple(
        replace(config, goal=goal) if isinstance(config, ReachConfig) else config
        for config in configs
    )


def _require_used(config: RunConfig, given: SimpleNamespace) -> None:
    """Require that the agent uses all arguments of ``train`` that were given.

    A study does not require it: its options may be for some of its agents.
    """
    agent, changed = config.policy.agent, read_constants(given.constants)
    if given.whole and not AGENTS[agent].per_robot:
        valid = " or ".join(name for name in AGENTS if AGENTS[name].per_robot)
        raise TaskError(f"--whole is for --agent {valid}, not for {agent}")
    for name in changed:
        owners = owners_of(name)
        if agent not in owners:
            raise TaskError(f"--set {name}: {agent} has none; valid for {' and '.join(owners)}")
    if "logit_scale" in changed and not config.policy.discrete:
        raise TaskError(
            "--set logit_scale: continuous actions have no logits; it is for --discrete"
        )


def _with_drawn_robots(
    config: RunConfig, source: robot_source.GrammarSource, given: SimpleNamespace
) -> RunConfig:
    """Draw the robots of a run, after all that can be checked before; return its configuration."""
    config = replace(config, slice_updates=default_slice_updates(config))
    require_runnable(config)
    robots = robot_source.draw(
        source, GoalConfig(tasks=config.tasks), jobs=given.workers or usable_cores()
    )
    if robots.skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in robots.skipped.items())
        note(f"morphgen: robots that were skipped: {reasons}")
    held_out = (read_split(name).max_links for name in source.held_out)
    max_links = given.max_links or default_max_links([robots.most_links, *held_out])
    require_max_links(robots.most_links, "the largest of the drawn robots", max_links)
    drawn = replace(source, drawn_hash=robots.hash)
    return replace(config, source=drawn, max_links=max_links)


def folder_name(source: robot_source.Source) -> str:
    """Return the name of the folder of a run's robots."""
    if isinstance(source, robot_source.SplitSource):
        name = source.name + "-test" * (source.side == "test")
    else:
        name = f"{Path(source.name).name}-{source.task}" + "-obstacles" * source.obstacles
    return re.sub(r"[^\w./-]+", "-", name).strip("/.")


def train_run(folder: Path, config: RunConfig, given: SimpleNamespace) -> TrainingRun:
    """Say what is trained, and train to the end of the run, or until it is stopped."""
    workers = getattr(given, "workers", None)
    if (
        isinstance(config.source, robot_source.GrammarSource)
        and not SIMULATORS[config.sim].takes_workers
    ):
        workers = None  # the others have drawn the robots
    begun: list[str] = []

    def begin() -> None:
        begun.append(_described(folder, config))
        note(begun[0])

    parts = train_parts(
        folder,
        config,
        resume=given.resume,
        execution=ExecutionConfig(workers, given.tensorboard, given.minutes),
        show=given.show,
        begin=begin,
    )
    if parts and not begun:
        note(
            f"{folder} is finished, with all {config.ppo.total_timesteps:,} steps; to train longer:"
            f" morphgen finetune {shlex.quote(str(folder))} --on train --steps N"
        )
    return TrainingRun(folder, config, tuple(parts))


def _described(folder: Path, config: RunConfig) -> str:
    source, ppo = config.source, config.ppo
    what = f"{config.policy.agent} at {', '.join(robot_source.tasks_of(source))}"
    if isinstance(source, robot_source.RecordedSource):
        return (
            f"cloning {source.name} to {what}: {config.num_updates:,} gradient steps of "
            f"{config.num_envs:,} recorded steps, networks on {config.device}; folder {folder}"
        )
    number = len(robot_source.members(source)) or robot_source.num_drawn(source) or 1
    robots = "1 robot" if number == 1 else f"{number} robots"
    return (
        f"training {what} on {source.name} ({robots}): {ppo.total_timesteps:,} steps in "
        f"{config.num_envs} environments of {config.sim}, networks on {config.device}; "
        f"folder {folder}"
    )

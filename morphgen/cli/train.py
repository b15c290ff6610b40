"""``morphgen train``, ``finetune`` and ``study``: agents and the robots they are trained on."""

from __future__ import annotations

import argparse
import re
import shlex
import sys
from dataclasses import fields, replace
from itertools import chain
from pathlib import Path
from typing import Any

from morphgen.benchmark.eval_protocol import EvalProtocol
from morphgen.benchmark.scores.study import (
    TABLE,
    Cell,
    agent_cell,
    baseline_cells,
    finetuning_run,
    matched_budget,
    require_cells,
    run_cells,
    run_cells_on_ray,
    write_tables,
)
from morphgen.benchmark.split_folder import read_split_or_folder
from morphgen.cli import options as opt
from morphgen.cli.progress import note, status, training_progress
from morphgen.encoding.tokens import default_max_links, require_max_links
from morphgen.errors import BenchmarkError, TaskError, nearest
from morphgen.rl.agents import AGENTS, preset_of
from morphgen.rl.config import (
    OBSERVATION_SWITCHES,
    SWITCHES,
    AgentSpec,
    PPOConfig,
    configs_of,
    owners_of,
    parse_agent,
    parse_agents,
    parse_constants,
)
from morphgen.rl.evaluation import EvalConfig, episodes_for
from morphgen.rl.runs import training
from morphgen.rl.runs.checkpoint import CHECKPOINT, RunConfig, read_checkpoint
from morphgen.rl.runs.robot_source import (
    GrammarSource,
    OneRobot,
    Source,
    SplitSource,
    draw,
    drawn_source,
    members,
    num_drawn,
    other_side,
    robot_source,
    split_of,
    split_source,
    tasks_of,
)
from morphgen.rl.runs.training import (
    ExecutionConfig,
    checkpoint_files,
    default_slice_updates,
    finetuning_config,
    is_done,
    num_slices,
    require_runnable,
    subruns_of,
)
from morphgen.rl.shipped_policies import POLICIES, checkpoint_path
from morphgen.splits.split import Side
from morphgen.splits.split_file import read_split, split_names
from morphgen.tasks.goals.split_goals import has_goals, read_split_goals
from morphgen.tasks.registry import (
    DEFAULT_SIMULATOR,
    SIMULATORS,
    TASKS,
    batch_device,
    evaluation_simulator,
    require_device,
    require_simulator_device,
)
from morphgen.tasks.scenes.env_specs import GoalConfig, default_configs, load_robot
from morphgen.tasks.task import TaskConfig


def agent_spec(args: argparse.Namespace) -> AgentSpec:
    """Return the agent with the switches that were given."""
    switches = dict.fromkeys(filter(None, args.observe.split(",")), True)
    for name in switches:
        if name not in OBSERVATION_SWITCHES:
            raise TaskError(f"--observe {name}{nearest(name, OBSERVATION_SWITCHES)}")
    for name in set(SWITCHES).difference(OBSERVATION_SWITCHES):
        if (value := getattr(args, name.replace("-", "_"))) is not None:
            switches[name] = value
    spec = parse_agent(args.agent)
    return replace(spec, switches={**spec.switches, **switches})


def robots_to_train(
    words: list[str], args: argparse.Namespace, side: Side = "train"
) -> SplitSource | OneRobot:
    """Return the robots that a split, or a robot and ``task=NAME``, describe."""
    choices = " or ".join(f"task={name}" for name in TASKS)
    tasks = [word.removeprefix("task=") for word in words if word.startswith("task=")]
    robot = " ".join(word for word in words if not word.startswith("task="))
    if tasks:
        if len(tasks) > 1 or not robot:
            raise TaskError(f"{' '.join(words)}: name a robot and one task, {choices}")
        TASKS[tasks[0]]  # raises if the task is unknown
        return robot_source(
            robot,
            tasks[0],
            obstacles=args.obstacles,
            goal_seed=args.goal_seed or 0,
            library=tuple(args.library),
        )
    if len(words) > 1 or "=" in words[0]:
        raise TaskError(f"{' '.join(words)}: a robot needs its task, {choices}")
    if args.obstacles:
        raise TaskError("--obstacles is for one robot; a split says which robots have obstacles")
    try:
        return split_to_train(words[0], args, side)
    except BenchmarkError as error:
        if Path(words[0]).exists():
            raise
        raise BenchmarkError(f"{error}; a robot needs {choices}") from error


def split_to_train(word: str, args: argparse.Namespace, side: Side = "train") -> SplitSource:
    """Return a side of a split, with the goals that its folder ships."""
    split, folder = read_split_or_folder(word)
    seed, library = args.goal_seed or 0, tuple(args.library)
    goal_folder = folder if folder is not None and has_goals(folder) else None
    if goal_folder is not None:
        shipped_seed = read_split_goals(goal_folder).config.seed
        if args.goal_seed not in (None, shipped_seed):
            raise TaskError(
                f"--goal-seed {seed}: the goals in {goal_folder} are of seed {shipped_seed}"
            )
        seed = shipped_seed
    return split_source(split, side=side, goal_seed=seed, goals=goal_folder, library=library)


def robots_to_draw(args: argparse.Namespace) -> GrammarSource:
    """Return the source that ``--robots`` describes; none of its robots is drawn yet."""
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


def train(args: argparse.Namespace) -> None:
    """Train and print the paths of the checkpoints."""
    sim = args.sim or DEFAULT_SIMULATOR
    require_simulator_device(sim, batch_device(sim, args.device))
    with status(args, "reading the robots"):
        spec = agent_spec(args)
        if args.robots is None:
            source: Source = other_side(robots_to_train(args.words, args), args.on)
        else:
            source = robots_to_draw(args)
    config = run_config(source, spec, args)  # before robots are drawn, which takes minutes
    _require_used(config, args)
    if isinstance(source, GrammarSource):
        config = _drawn(config, source, args)
    # Positions came first and have no suffix.
    name = _folder_name(source) + "-pose" * (args.goal == "pose")
    folder = args.out or Path("runs") / name / str(spec) / f"seed{args.seed}"
    run_training(folder, config, args)


def run_training(folder: Path, config: RunConfig, args: argparse.Namespace) -> None:
    """Say what is trained, train in a folder with progress, print the paths of the checkpoints."""
    with training_progress("with --resume") as display:
        execution = execution_config(args)
        if isinstance(config.source, GrammarSource) and not SIMULATORS[config.sim].takes_workers:
            execution = replace(execution, workers=1)  # those of --workers have drawn the robots
        subruns = training.train(
            folder,
            config,
            resume=args.resume,
            execution=execution,
            show=display.training,
            begin=lambda: note(_described(folder, config)),
        )
    for subrun in subruns:
        if (subrun.folder / CHECKPOINT).is_file():
            print(subrun.folder / CHECKPOINT)
    if left := sum(not is_done(subrun) for subrun in subruns):
        what = f" with {left} of {len(subruns)} robots left" * (len(subruns) > 1)
        note(f"stopped after {args.minutes} minutes{what}; it continues with --resume")
    elif subruns:  # the first process of torchrun alone says it
        note(_next_command(folder, config))


def _described(folder: Path, config: RunConfig) -> str:
    """Return in a line what a run trains on what, and where."""
    source, ppo = config.source, config.ppo
    number = len(members(source)) or num_drawn(source) or 1
    robots = "1 robot" if number == 1 else f"{number} robots"
    return (
        f"training {config.policy.agent} at {', '.join(tasks_of(source))} on {source.name} "
        f"({robots}): {ppo.total_timesteps:,} steps in {config.num_envs} environments of "
        f"{config.sim}, networks on {config.device}; folder {folder}"
    )


def _next_command(folder: Path, config: RunConfig) -> str:
    """Return a line that says how to watch, or to score, what was trained."""
    source = config.source
    # Only the script that registered a task can play it.
    program = "morphgen"
    if not all(map(TASKS.is_installed, tasks_of(source))):
        program = f"python {shlex.quote(sys.argv[0])}"
    if isinstance(source, GrammarSource):
        return f"score it on fresh robots: {program} eval {shlex.quote(str(folder))}"
    if isinstance(source, OneRobot):
        words = [source.task, source.name, *["--obstacles"] * source.obstacles]
        words += ["--policy", str(folder), "--sim", config.sim]
        for library in source.library:
            words += ["--library", str(library)]
        return f"watch it: {program} play {shlex.join(words)} --out episode.mp4"
    return f"score it: {program} eval {shlex.quote(str(folder))}"


def run_config(source: Source, spec: AgentSpec, args: argparse.Namespace) -> RunConfig:
    """Return the configuration of a run from the options."""
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


def _drawn(config: RunConfig, source: GrammarSource, args: argparse.Namespace) -> RunConfig:
    """Draw the robots of a run, after all that can be checked before; return its configuration."""
    if args.slice_updates is not None and num_slices(config) == 1:
        raise TaskError(
            f"--slice-updates {args.slice_updates}: {source.name} has an environment for "
            "every robot at all times"
        )
    slice_updates = args.slice_updates or default_slice_updates(config)
    config = replace(config, slice_updates=slice_updates)
    require_runnable(config)
    with training_progress():
        robots = draw(source, GoalConfig(tasks=config.tasks), jobs=args.workers)
    if robots.skipped:
        reasons = ", ".join(f"{count} {reason}" for reason, count in robots.skipped.items())
        note(f"morphgen: robots that were skipped: {reasons}")
    held_out = (read_split(name).max_links for name in source.held_out)
    max_links = args.max_links or default_max_links([robots.most_links, *held_out])
    require_max_links(robots.most_links, "the largest of the drawn robots", max_links)
    drawn = replace(source, drawn_hash=robots.hash)
    return replace(config, source=drawn, max_links=max_links)


def _max_links(source: Source) -> int:
    """Return the number of links that observations are padded to, unless ``--max-links`` is given.

    For a split it is the split's number. For drawn robots, of which the largest is not known yet,
    it is the benchmark's. For one robot it is the benchmark's, or the number of the
    robot's links if these are more, as for a robot with two arms.
    """
    if isinstance(source, SplitSource):
        return split_of(source).max_links
    if isinstance(source, GrammarSource):
        return default_max_links([])
    robot = load_robot(source.name, library=map(Path, source.library))
    return default_max_links([len(robot.links)])


def _task_configs(source: Source, args: argparse.Namespace) -> tuple[TaskConfig, ...]:
    """Return the configurations of the tasks from ``--goal`` and ``--train-goals``."""
    tasks, num_goals = tasks_of(source), args.train_goals
    names = dict.fromkeys((*TASKS.builtin, *tasks))
    configs = opt.with_goal((TASKS[name].config_type() for name in names), args.goal, tasks)
    if num_goals is None:
        return configs
    if isinstance(source, SplitSource) and source.goal_dir:
        raise TaskError(
            f"--train-goals {num_goals}: {source.goal_dir} ships the goals to train on; name the "
            f"split itself, {source.name}, to have others"
        )
    return tuple(replace(config, num_goals=num_goals) for config in configs)


def _require_used(config: RunConfig, args: argparse.Namespace) -> None:
    """Require that the agent uses all options that were given.

    A study does not require it: its options may be for some of its agents.
    """
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
    minutes = getattr(args, "minutes", None)  # a study has none
    return ExecutionConfig(args.workers, not args.no_tensorboard, args.wandb, minutes)


def _folder_name(source: Source) -> str:
    if isinstance(source, SplitSource):
        name = source.name + "-test" * (source.side == "test")
    else:
        name = f"{Path(source.name).name}-{source.task}" + "-obstacles" * source.obstacles
    return re.sub(r"[^\w./-]+", "-", name).strip("/.")


def finetune(args: argparse.Namespace) -> None:
    """Train and print the path of the checkpoint."""
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
    initial, _ = read_checkpoint(file)
    source: Source
    if args.words:
        source = robots_to_train(args.words, args, args.on)
    else:
        source = other_side(initial.source, args.on)  # drawn robots have none
    changes: dict[str, Any] = parse_constants(args.set)
    if unknown := set(changes) - {field.name for field in fields(PPOConfig)}:
        raise TaskError(f"--set {min(unknown)}: the networks are those of the checkpoint")
    switches = {"bf16": args.bf16, "compile": args.compile}
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


PAPER = "paper"
"""Word for all splits of the benchmark."""


def study(args: argparse.Namespace) -> int:
    """Train, evaluate, write tables, and print failures."""
    execution_config(args)  # refuses invalid options before the work
    cells = _cells(args)
    require_cells(cells)
    args.out.mkdir(parents=True, exist_ok=True)
    failures = 0 if args.report else _run_cells(args, cells)
    written = write_tables(args.out, cells)
    print((args.out / TABLE).read_text(encoding="utf-8"))
    for path in written:
        print(path)
    return int(failures > 0)


def _cells(args: argparse.Namespace) -> list[Cell]:
    """Return the cells of the study, baselines first."""
    episode_steps = max(config.max_episode_steps for config in default_configs())
    num_episodes = episodes_for(args.eval_steps, episode_steps)
    sim = evaluation_simulator(args.sim or DEFAULT_SIMULATOR)
    args.seed = 0  # a study has no such option, which run_config reads
    agents, seeds = parse_agents(args.agents or ",".join(AGENTS)), _seeds(args.seeds)
    finetune = sorted(set(args.finetune))
    cells: list[Cell] = []
    words: dict[str, str] = {}
    for name in dict.fromkeys(chain.from_iterable(map(_splits, args.words))):
        source = split_to_train(name, args)
        opt.require_other_name(words, source.name, name)
        sides = tasks_of(source), tasks_of(other_side(source, "test"))
        tasks = opt.with_goal(default_configs(), args.goal, chain(*sides))
        eval_config = EvalConfig(num_episodes, sim, tasks=tasks)
        if sim in SIMULATORS.builtin:  # the episodes become submissions, whose number is limited
            EvalProtocol(sim, num_episodes, goals=GoalConfig(source.goal_seed, tasks))
        cells += baseline_cells(args.out, source, eval_config)
        for label, spec, side in agents:
            config = run_config(other_side(source, side), spec, args)
            for seed in seeds:
                seeded = matched_budget(replace(config, seed=seed))
                cell = agent_cell(args.out, label, seeded, eval_config, finetune)
                cells.append(cell)
                if not args.report:
                    _require_startable(cell, seeded, args)
    return cells


def _require_startable(cell: Cell, config: RunConfig, args: argparse.Namespace) -> None:
    """Require that training and fine-tuning of a cell can begin, before any of them does."""
    parts = subruns_of(cell.folder, config)
    for part in parts:
        require_runnable(part.config)
    for steps in cell.finetune:
        try:
            require_runnable(finetuning_run(cell, config, steps))
        except TaskError as error:
            raise TaskError(f"--finetune {steps}: {error}") from error
    is_on_gpu = args.device != "cpu" and args.ray is None  # with Ray, other machines have the GPUs
    if is_on_gpu and not all(map(is_done, parts)):
        require_device(args.device)  # policies are evaluated on the CPU


def _splits(word: str) -> tuple[str, ...]:
    """Return the split that a word names, or the splits of the benchmark."""
    return tuple(split_names()) if word == PAPER and not Path(word).exists() else (word,)


def _seeds(text: str) -> list[int]:
    """Read ``0..2`` or ``0,3``."""
    seeds: list[int] = []
    for part in text.split(","):
        first, dots, last = part.partition("..")
        if not first.isdecimal() or (dots and not last.isdecimal()):
            raise TaskError(f"--seeds {text}: expected such as 0..2 or 0,3")
        seeds += range(int(first), int(last or first) + 1)
    if not seeds or len(set(seeds)) < len(seeds):
        raise TaskError(f"--seeds {text}: expected at least one seed, and none twice")
    return seeds


def _run_cells(args: argparse.Namespace, cells: list[Cell]) -> int:
    """Run the cells and return how many failed."""
    failures = 0
    execution = execution_config(args)
    with training_progress("if the same command is given again") as show:
        if args.ray is None:
            outcomes = run_cells(cells, execution, show.training)
        else:
            gpus = args.gpus if args.gpus is not None else float(args.device != "cpu")
            outcomes = run_cells_on_ray(cells, execution, args.ray or None, gpus=gpus)
        for done, (cell, error) in enumerate(outcomes, 1):
            show.close()
            seed = "" if cell.seed is None else f" seed {cell.seed}"
            state = f"failed: {error}" if error else "done"
            line = f"{done} of {len(cells)}: {cell.split} {cell.agent}{seed} {state}"
            note(line)
            failures += bool(error)
    return failures

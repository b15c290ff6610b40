"""Record demonstrations, read them, verify them in the simulator, and learn from them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from types import SimpleNamespace

from morphgen.api.training import (
    TrainingRun,
    folder_name,
    named_source,
    run_config,
    train_run,
    with_goal,
)
from morphgen.benchmark.demonstrations import Verification, changed_files, describe
from morphgen.encoding.tokens import default_max_links
from morphgen.errors import MorphgenError, TaskError, path_argument, require_types, whole_number
from morphgen.grammar.library import LibraryFolders, library_folders
from morphgen.rl.agents import AGENTS
from morphgen.rl.config import AgentSpec, parse_agent
from morphgen.rl.demonstrations.cloning import data_sets, recorded_source
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.recording import (
    PLANNER,
    RecordingConfig,
    best_of,
    choose_episodes,
    read_planner,
    record_states,
    replay,
)
from morphgen.rl.demonstrations.recording import record as record_episodes
from morphgen.rl.inference import read_controller
from morphgen.rl.runs.checkpoint import CHECKPOINT, RunConfig
from morphgen.rl.runs.robot_source import Source, drawn_source, other_side, tasks_of
from morphgen.rl.runs.training import ShowMetrics, Subrun
from morphgen.splits.split import Side, require_side
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig


def record(
    robots: str | PathLike[str] | None = None,
    *,
    drawn: str | None = None,
    tasks: Sequence[str] = (),
    policy: str | PathLike[str] = PLANNER,
    episodes: int = 20,
    out: str | PathLike[str] | None = None,
    seed: int = 0,
    noise: float = 0.0,
    only_success: bool = False,
    cameras: Sequence[str] = (),
    depth: bool = False,
    hold: int = 25,
    sim: str | None = None,
    goal: str | None = None,
    on: Side = "train",
    obstacles: bool = False,
    robot_seed: int = 0,
    goal_seed: int | None = None,
    jobs: int = 1,
    ray: str | None = None,
    library: LibraryFolders = (),
) -> Demonstrations:
    """Record demonstrations: episodes with the robots that they show, as a LeRobotDataset v3.

    An interrupted call continues where it was; the same arguments give the same bytes.

    Examples:
        >>> demos = morphgen.record("prims", tasks=["reach"], episodes=2)
        >>> len(demos.episodes), demos.episodes[0].success
        (2, True)

    Args:
        robots: Name of a split, its file or built folder; or a robot, such as ``arm=ur5 ee=stick``.
        drawn: Numbers of robots to draw from grammars, such as ``serial:200,chain:50``.
        tasks: Tasks of drawn robots, or of one robot: each does all of them. By default ``reach``;
            a split has its own.
        policy: A baseline, a policy that comes with morphgen, a checkpoint, or ``scripted``, the
            best baseline of each task.
        episodes: Number of episodes of each robot at each task.
        out: Folder of the data set, by default ``demos``.
        seed: Seed of the episodes, of the policy and of the noise.
        noise: Standard deviation of noise on the normalized actions; the labels have none.
        only_success: Whether to keep only the episodes that end in success.
        cameras: Cameras whose videos are added, ``front`` and ``wrist``.
        depth: Whether the cameras also have depths.
        hold: Control steps in success, one after another, that end an episode.
        sim: Name of the simulator, by default ``mujoco``.
        goal: Goal of reach, ``position`` or ``pose``; by default that of the policy.
        on: Side of the split, ``train`` or ``test``.
        obstacles: Whether drawn robots, or one robot, are among obstacles.
        robot_seed: Seed of the drawn robots.
        goal_seed: Seed of all goals; by default as shipped with the split, else 0.
        jobs: Number of processes.
        ray: Address of a Ray cluster to run on, or an empty text for a local Ray.
        library: Folders of your own parts.

    Returns:
        The data set.

    Raises:
        TaskError: If an argument is invalid, or the folder holds something else.
        MorphgenError: If a split or a robot cannot be read, or a robot cannot do a task.
    """
    given = SimpleNamespace(**locals())
    least = {"episodes": 1, "seed": 0, "robot_seed": 0, "goal_seed": 0, "jobs": 1}
    require_types(record, given, "drawn", "sim", "goal", hold=1, **least)
    require_side(on)
    if not 0 <= noise < 10:
        raise TaskError(f"noise {noise}: expected a standard deviation from 0 to 10")
    SIMULATORS[sim or DEFAULT_SIMULATOR]  # raises if it is unknown
    sources = _sources(given)
    config = RecordingConfig(
        sources,
        policy=str(policy),
        episodes=episodes,
        seed=seed,
        noise=float(noise),
        hold=hold,
        only_success=only_success,
        cameras=tuple(cameras),  # type: ignore[arg-type]  # checked before anything is recorded
        depth=depth,
        sim=sim or DEFAULT_SIMULATOR,
    )
    names = tuple(dict.fromkeys(task for source in sources for task in tasks_of(source)))
    own = (read_controller(best_of(task, config.policy), task).task_config for task in names)
    config = replace(config, goals=GoalConfig(tasks=with_goal(own, goal, names)))
    folder = record_episodes(
        path_argument("out", out or "demos", TaskError), config, jobs=jobs, ray=ray
    )
    data = Demonstrations(folder)
    describe(data)
    return data


def _sources(given: SimpleNamespace) -> tuple[Source, ...]:
    if (given.robots is None) == (given.drawn is None):
        raise TaskError(
            "expected either robots, such as a split, or grammars to draw from (--robots)"
        )
    for task in given.tasks:
        TASKS[task]  # raises if the task is unknown
    if given.drawn is not None:
        return tuple(
            drawn_source(
                given.drawn,
                task,
                seed=given.robot_seed,
                obstacles=given.obstacles,
                goal_seed=given.goal_seed or 0,
                library=library_folders(given.library),
            )
            for task in given.tasks or ("reach",)
        )
    if not given.tasks:
        return (other_side(named_source(given), given.on),)
    try:
        source: Source | None = named_source(given)
    except MorphgenError:  # a robot alone, as it should be
        source = None
    if source is not None:
        own = ", ".join(tasks_of(source))
        raise TaskError(f"tasks {', '.join(given.tasks)}: {given.robots} has its own: {own}")
    words = [
        SimpleNamespace(**vars(given) | {"robots": f"{given.robots} task={task}"})
        for task in given.tasks
    ]
    return tuple(named_source(each) for each in words)


def demos(path: str | PathLike[str]) -> Demonstrations:
    """Read demonstrations as a ``Dataset`` of torch, whose items are steps.

    Examples:
        >>> _ = morphgen.record("prims", tasks=["reach"], episodes=2)
        >>> demos = morphgen.demos("demos")
        >>> sorted(demos[0])[:2]
        ['action', 'episode_index']
        >>> observation, action = demos.observe(range(len(demos)))

    Args:
        path: Folder of the data set.

    Raises:
        FormatError: If the folder is no complete data set of ``morphgen record``.
    """
    return Demonstrations(path_argument("path", path, TaskError))


def verify(path: str | PathLike[str], *, episodes: int = 10, seed: int = 0) -> Verification:
    """Simulate random episodes of demonstrations again, and compare each step and all files.

    Examples:
        >>> demos = morphgen.record("prims", tasks=["reach"], episodes=2)
        >>> verification = morphgen.verify("demos", episodes=1)
        >>> verification.agrees, verification.replays[0].joint_error
        (True, 0.0)

    Args:
        path: Folder of the data set.
        episodes: Number of episodes.
        seed: Seed of their choice.

    Returns:
        The simulated episodes beside the recorded ones, and the files that were changed.

    Raises:
        FormatError: If the folder is no complete data set of ``morphgen record``.
    """
    count = whole_number("episodes", episodes, TaskError, 1)
    data = demos(path)
    replays = tuple(replay(data, choose_episodes(data, count, seed)))
    return Verification(replays, changed_files(data.folder))


def clone(
    demonstrations: str | PathLike[str] | Sequence[str | PathLike[str]],
    *,
    agent: str = "me-graph",
    preset: str | None = None,
    epochs: float = 20.0,
    minibatch: int = 1024,
    dagger: str | None = None,
    rounds: int = 3,
    episodes: int = 5,
    device: str = "cpu",
    seed: int = 0,
    out: str | PathLike[str] | None = None,
    resume: bool = False,
    minutes: int | None = None,
    jobs: int = 1,
    constants: Mapping[str, float] | Sequence[str] = (),
    tensorboard: bool = True,
    show: Callable[[Subrun], ShowMetrics] | None = None,
) -> TrainingRun:
    """Learn the actions of demonstrations: behaviour cloning, and DAgger.

    The run is one of training, whose updates are gradient steps. The critic learns the discounted
    rewards, so that ``train`` can go on from the policy. With ``dagger`` the policy then acts with
    the robots of the first data set, a planner says what it would have done in each state, and the
    policy learns from these steps, too; as often as ``rounds`` says.

    Examples:
        >>> demos = morphgen.record("prims", tasks=["reach"], episodes=2)
        >>> run = morphgen.clone("demos", epochs=1)
        >>> print(run)
        runs/demos-clone/me-graph/seed0/checkpoint.pt

    Args:
        demonstrations: Folder of a data set of ``record``, or several.
        agent: ``me-mlp``, ``me-tf`` or ``me-graph``, with switches as in ``train``.
        preset: Constants and switches to begin with: ``fast`` or ``paper``; by default the agent's.
        epochs: Passes over all steps, in each round.
        minibatch: Number of steps of a gradient step.
        dagger: A baseline such as ``scripted`` or ``ik`` that labels the states which the policy
            leads to; ``scripted`` is the best baseline of each task.
        rounds: Number of rounds of ``dagger``.
        episodes: Number of episodes of each robot at each task in a round.
        device: Device of the networks: ``cpu`` or ``cuda``.
        seed: Seed of weights, minibatches and episodes.
        out: Folder of the run, by default ``runs/NAME-clone/AGENT/seedN``; with ``dagger`` the runs
            and data sets of the rounds are inside, and the last run is in ``roundN``.
        resume: Whether to continue the run in the folder.
        minutes: Stop with a checkpoint after the update in which so many minutes are over.
        jobs: Number of processes that record the episodes of ``dagger``.
        constants: Hyperparameters, such as ``{"learning_rate": 1e-4}``, or ``NAME=VALUE`` texts.
        tensorboard: Whether to write TensorBoard events.
        show: As in ``train``.

    Returns:
        The folder of the run, and its checkpoint.

    Raises:
        TaskError: If an argument is invalid, or the folder has another run.
        FormatError: If a folder is no complete data set of ``record``.
    """
    given = SimpleNamespace(**locals())
    least = {"minibatch": 1, "rounds": 1, "episodes": 1, "jobs": 1, "minutes": 1, "seed": 0}
    require_types(clone, given, "agent", "preset", "dagger", "device", **least)
    if not 0 < epochs <= MAX_EPOCHS:
        raise TaskError(f"epochs {epochs}: expected more than 0, and at most {MAX_EPOCHS:,}")
    if isinstance(demonstrations, str | PathLike):
        demonstrations = [demonstrations]
    folders = [Path(each) for each in demonstrations]
    if not folders:
        raise TaskError("demonstrations: expected the folder of a data set, or several")
    spec = parse_agent(agent)
    if AGENTS[spec.agent].per_robot:
        raise TaskError(f"agent {spec.agent}: learns one robot; expected an agent of many")
    data = data_sets(folders)
    name = folder_name(recorded_source(data)) if len(data) > 1 else data[0].folder.resolve().name
    folder = Path(out or Path("runs") / f"{name}-clone" / str(spec) / f"seed{seed}")
    if dagger is None:
        return train_run(folder, _cloning_config(data, spec, given), given)
    read_planner(dagger, tasks_of(recorded_source(data)))
    given.resume = given.resume or not folder.exists()
    run = train_run(folder / "round0", _cloning_config(data, spec, given), given)
    for number in range(1, rounds + 1):
        if run.unfinished:
            return run
        states = record_states(
            data[0],
            folder / f"demos{number}",
            run.folder,
            dagger,
            episodes=episodes,
            seed=seed + number,
            jobs=jobs,
        )
        data = [*data, *data_sets([states])]
        describe(data[-1])
        config = replace(
            _cloning_config(data, spec, given),
            initial_checkpoint=f"../round{number - 1}/{CHECKPOINT}",
        )
        run = train_run(folder / f"round{number}", config, given)
    return run


MAX_EPOCHS = 100_000  # most passes over the steps of demonstrations


def _cloning_config(
    data: Sequence[Demonstrations], spec: AgentSpec, given: SimpleNamespace
) -> RunConfig:
    source, steps = recorded_source(data), sum(map(len, data))
    words = {"steps": max(round(given.epochs * steps), given.minibatch), "envs": given.minibatch}
    words |= {"sim": data[0].settings["sim"], "whole": False, "goal": None}
    words |= {"bf16": False, "compile": False, "train_goals": None}
    links = default_max_links(len(robot.links) for each in data for robot in each.robots)
    options = SimpleNamespace(**vars(given) | words | {"max_links": links})
    config = run_config(source, spec, options)
    ppo = replace(config.ppo, num_steps=1, epochs=1, minibatches=1, curriculum=False)
    own = {task.task: task for task in data[0].configs}
    tasks = tuple(own.get(task.task, task) for task in config.tasks)
    return replace(config, ppo=ppo, tasks=tasks)

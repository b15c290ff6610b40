"""Record demonstrations, read them, and verify them in the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from types import SimpleNamespace

from morphgen.api.training import named_source, with_goal
from morphgen.arguments import checked_signature, path_argument, require_types, whole_number
from morphgen.benchmark.demonstrations import Verification, changed_files, describe
from morphgen.errors import MorphgenError, TaskError
from morphgen.grammar.library import LibraryFolders, library_folders
from morphgen.rl.demonstrations.reader import Demonstrations
from morphgen.rl.demonstrations.recording import PLANNER, RecordingConfig
from morphgen.rl.demonstrations.recording import record as record_episodes
from morphgen.rl.demonstrations.replay import choose_episodes, replay
from morphgen.rl.inference import read_controller
from morphgen.rl.runs.robot_source import Source, drawn_source, other_side, tasks_of
from morphgen.splits.split import Side, require_side
from morphgen.tasks.registry import DEFAULT_SIMULATOR, SIMULATORS, TASKS
from morphgen.tasks.scenes.env_specs import GoalConfig


@checked_signature
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
    require_types(given, TaskError, "drawn", "sim", "goal", hold=1, **least)
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
    own = (read_controller(config.policy_for(task), task).task_config for task in names)
    config = replace(config, goals=GoalConfig(tasks=with_goal(own, goal, names)))
    folder = record_episodes(
        path_argument("out", out or "demos", TaskError), config, jobs=jobs, ray=ray
    )
    data = Demonstrations(folder)
    describe(data)
    return data


def _sources(given: SimpleNamespace) -> tuple[Source, ...]:
    """Return the robots with their tasks."""
    if (given.robots is None) == (given.drawn is None):
        raise TaskError("expected either robots, as of a split, or grammars to draw robots from")
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


@checked_signature
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


@checked_signature
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

"""Evaluate policies and baselines, and run them on one robot."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import replace
from itertools import chain
from os import PathLike
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from morphgen.api.training import named_source, with_goal
from morphgen.benchmark.release import is_release, read_release
from morphgen.benchmark.scores.submission import (
    EvalProtocol,
    Training,
    make_submission,
    protocol_from,
    require_rules,
    submission_text,
)
from morphgen.errors import TaskError, nearest, path_argument, require_types, text_argument
from morphgen.formats.files import require_writable_file, write_file
from morphgen.grammar.library import LibraryFolders, library_folders
from morphgen.grammar.robot_source import RobotLike
from morphgen.model.robot import Robot
from morphgen.processes import usable_cores
from morphgen.progress import note, stage
from morphgen.rl.baselines import BASELINES
from morphgen.rl.config import spec_of
from morphgen.rl.evaluation import (
    EvalConfig,
    eval_config_of,
    evaluate_baseline,
    evaluate_checkpoints,
    require_trained_tasks,
)
from morphgen.rl.inference import (
    FPS,
    MODES,
    Episode,
    Mode,
    make_env_and_controller,
    note_unfinished,
    read_controller,
)
from morphgen.rl.inference import play as run_episodes
from morphgen.rl.runs import robot_source
from morphgen.rl.runs.checkpoint import RunConfig, read_checkpoint, read_config
from morphgen.rl.runs.training import checkpoint_files
from morphgen.rl.scores import Evaluation, Score
from morphgen.rl.shipped_policies import POLICIES, checkpoint_path, is_named
from morphgen.splits.split import Side, require_side
from morphgen.tasks.registry import DEFAULT_SIMULATOR, require_device
from morphgen.tasks.renderer import require_video_path, write_video
from morphgen.tasks.scenes.env_specs import GoalConfig, default_configs
from morphgen.tasks.task import TaskConfig


def evaluate(
    policy: str | PathLike[str],
    robots: str | PathLike[str] | None = None,
    *,
    on: Side | None = None,
    episodes: int = 34,
    sim: str | None = None,
    workers: int | None = None,
    device: str = "cpu",
    seed: int = 0,
    obstacles: bool = False,
    mode: Mode | None = None,
    goal: str | None = None,
    goal_seed: int | None = None,
    submission: str | PathLike[str] | None = None,
    method: str | None = None,
    library: LibraryFolders = (),
) -> Evaluation:
    """Score a trained policy or a baseline on each robot.

    Scores have 95% bootstrap intervals over episodes, success rates 95% Wilson intervals. The score
    of reach is relative to the random policy; that of push is the success rate.

    Examples:
        >>> evaluation = morphgen.evaluate("ik", "prims task=reach", episodes=2)
        >>> (score,) = evaluation.scores["ik"]
        >>> score.robot, score.success
        ('prims', 1.0)
        >>> evaluation.write("ik.csv")

    Args:
        policy: A checkpoint, a run folder, a policy that comes with morphgen, such as
            ``zero-shot``, or a baseline, such as ``ik``.
        robots: Robots of a baseline, or other robots than the checkpoint's: a split's name, file or
            built folder; or a robot and its task, such as ``arm=ur5 ee=stick task=reach``.
        on: Side of the split, ``train`` or ``test``; by default both.
        episodes: Least number of episodes per robot.
        sim: Name of the simulator, by default that of the training.
        workers: Number of threads of MuJoCo; by default as many as the environments and the cores
            allow.
        device: Device of the networks: ``cpu`` or ``cuda``.
        seed: Seed of the episodes.
        obstacles: Whether one robot is among obstacles.
        mode: How the policy acts, ``deterministic`` or ``stochastic``; by default both.
        goal: Goal of reach, ``position`` or ``pose``; by default that of the policy.
        goal_seed: Seed of all goals of ``robots``; by default as shipped, else 0.
        submission: File for the outcome of every episode, for ``morphgen split score``; the
            default mode is then deterministic, and the default simulator that of the release.
        method: Name of the method in rankings of the submission.
        library: Folders of your own parts of ``robots``.

    Returns:
        The scores, which print as a table.

    Raises:
        TaskError: If the checkpoint is missing or damaged, or an argument is invalid.
        MorphgenError: If a split or a robot cannot be read, or a robot cannot do the task.
    """
    given = SimpleNamespace(**locals())
    least = {"episodes": 1, "workers": 1, "seed": 0, "goal_seed": 0}
    require_types(evaluate, given, "sim", "device", "goal", "method", **least)
    if on is not None:
        require_side(on)
    if mode not in (None, *MODES):
        raise TaskError(f"unknown mode {mode!r}{nearest(str(mode), MODES)}")
    if robots is None and (obstacles or goal_seed is not None or library_folders(library)):
        raise TaskError("obstacles, goal_seed and library: only with robots")
    if submission is None and method is not None:
        raise TaskError("method: only with submission")
    is_baseline = str(policy) in BASELINES
    if submission is not None:
        given.sim = sim or _rules_of(robots).simulator
        given.mode = mode or (None if is_baseline else "deterministic")
    scores = (_baseline_scores if is_baseline else _policy_scores)(given)
    return Evaluation(scores)


def play(
    task: str,
    robot: RobotLike,
    *,
    policy: str | PathLike[str] = "random",
    out: str | PathLike[str] | None = None,
    sim: str | None = None,
    goal: str | None = None,
    episodes: int = 1,
    seed: int = 0,
    obstacles: bool = False,
    library: LibraryFolders = (),
    max_successes: int | None = None,
    show: Callable[[Episode], None] = lambda episode: None,
) -> tuple[Episode, ...]:
    """Run a controller on one robot, and render a video.

    Examples:
        >>> (episode,) = morphgen.play("reach", morphgen.compose("arm3-stick"), policy="ik")
        >>> episode.success, episode.distance < 0.03
        (True, True)

    Args:
        task: Name of the task, such as ``reach`` or ``push``.
        robot: The robot, its bundle's folder, a description, or words of ``compose``.
        policy: The controller: a baseline such as ``random`` or ``ik``, a policy that comes with
            morphgen, such as ``zero-shot``, a checkpoint, or a run folder.
        out: The video, a file that ends in ``.mp4`` or ``.gif``.
        sim: Name of the simulator, by default ``mujoco``.
        goal: Goal of reach, ``position`` or ``pose``; by default that of the policy.
        episodes: Number of episodes.
        seed: Seed of the episodes.
        obstacles: Whether the robot is among obstacles.
        library: Folders of your own parts.
        max_successes: Control steps in success, one after another, that end an episode.
        show: Function that receives each episode when it ends.

    Returns:
        The results of the episodes.

    Raises:
        TaskError: If the policy is not for the task, or an argument is invalid.
        MorphgenError: If the robot cannot be read, or cannot do the task.
    """
    given = SimpleNamespace(**locals())
    require_types(play, given, "sim", "goal", episodes=1, seed=0)
    spec = read_controller(str(policy), text_argument("task", task, TaskError))
    video = None if out is None else path_argument("out", out, TaskError)
    if video is not None:
        require_video_path(video)
    (config,) = with_goal([spec.task_config], goal, [task])
    env, controller = make_env_and_controller(
        spec,
        robot if isinstance(robot, Robot) else str(robot),
        seed,
        sim=sim,
        obstacles=obstacles,
        config=config,
        library=library,
        render_mode=None if video is None else "rgb_array",
    )
    results: list[Episode] = []

    def report(episode: Episode) -> None:
        results.append(episode)
        show(episode)

    with closing(env):
        frames = run_episodes(env, controller, episodes, seed, report, max_successes)
        if video is None:
            deque(frames, maxlen=0)  # runs the episodes and keeps no frame
        else:
            write_video(frames, video, FPS)
    return tuple(results)


def _rules_of(robots: str | PathLike[str] | None) -> EvalProtocol:
    """Return the rules of the release that the robots are of, else the default ones."""
    if robots is None or not is_release(Path(robots)):
        return EvalProtocol()
    return protocol_from(read_release(Path(robots)).evaluation, str(robots))


def _plan_submission(
    given: SimpleNamespace,
    source: robot_source.Source,
    config: EvalConfig,
    **facts: Any,  # noqa: ANN401
) -> Callable[[Iterable[Score]], None]:
    """Return the function that writes scores as a submission with facts, if one is asked for."""
    if given.submission is None:
        return lambda scores: None
    path = path_argument("submission", given.submission, TaskError)
    if not isinstance(source, robot_source.SplitSource):
        raise TaskError(f"--submission: {source.name} is no split; name one with --split")
    if given.on == "train":
        raise TaskError("--submission: the test robots are needed; leave --on train out")
    require_writable_file(path, "--submission")
    split = robot_source.split_of(source)
    rules = _rules_of(given.robots)
    goals = replace(rules.goals, seed=source.goal_seed, tasks=config.tasks)
    followed = EvalProtocol(config.sim, config.episodes, config.seed, goals).as_data(split)
    require_rules(followed, rules.as_data(split), "--submission")
    if given.method is not None:
        facts["method"] = given.method
    facts["evaluation"] = followed
    make_submission(split, (), **facts)  # refuses an invalid name or seed before hours of episodes
    return lambda scores: write_file(path, submission_text(make_submission(split, scores, **facts)))


def _baseline_scores(given: SimpleNamespace) -> dict[str, list[Score]]:
    name = str(given.policy)
    if given.robots is None:
        raise TaskError(f"{name}: name its robots with --split")
    if given.mode or given.device != "cpu":
        option = "--mode" if given.mode else "--device"
        raise TaskError(f"{option} is for policies; {name} has none")
    sources = _sources(given)
    config = EvalConfig(
        given.episodes,
        given.sim or DEFAULT_SIMULATOR,
        given.seed,
        given.workers,
        _with_goal(default_configs(), sources, given),
    )
    write = _plan_submission(given, sources[0], config, method=name, mode="", training_seed=None)
    _prepare(sources, config)
    scores: list[Score] = []
    for source in sources:
        with stage(robot_source.side_of(source), "episode"):
            scores += evaluate_baseline(name, source, config)
    write(scores)
    return {name: scores}


def _prepare(sources: Sequence[robot_source.Source], config: EvalConfig) -> None:
    """Make the goal sets of robots, and show how many are ready; evaluations find them made."""
    for source in sources:
        robot_source.specs_of(source, GoalConfig(tasks=config.tasks))


def _policy_scores(given: SimpleNamespace) -> dict[str, list[Score]]:
    require_device(given.device)
    name = str(given.policy)
    path = checkpoint_path(name)
    if path.name == name and not path.exists():  # as likely a slip in the name of a policy
        hint = nearest(name, (*BASELINES, *POLICIES))
        raise TaskError(f"{name}: no checkpoint, and no folder of a run with one{hint}")
    files = list(checkpoint_files(path))
    for file in files:
        run, learner = read_checkpoint(file)
        note_unfinished(file, run, learner)
    if len(files) > 1:  # a policy for each robot: their seeds and budgets are parts of the run's
        run = read_config(path)
    config = eval_config_of(run, given.episodes, seed=given.seed, workers=given.workers)
    others = _other_robots(given, run, files[0].parent, config)
    sources = others or [run.source]
    require_trained_tasks(run, sources, name)
    tasks = _with_goal(config.tasks, sources, given)
    config = replace(config, sim=given.sim or config.sim, tasks=tasks)
    write = _plan_submission(
        given,
        sources[0],
        config,
        method=name
        if is_named(name)
        else str(spec_of(run.policy, run.ppo, robot_source.tasks_of(run.source))),
        mode=given.mode or "",
        training_seed=run.seed,
        # A fine-tuned policy was trained before, by a run that its checkpoint does not describe.
        training=None if run.initial_checkpoint else Training(run.sim, run.ppo.total_timesteps),
    )
    evaluated = others or [
        robot_source.other_side(run.source, side) for side in _sides(given, run.source)
    ]
    _prepare(evaluated, config)
    results: dict[str, list[Score]] = {}
    if given.robots is not None and isinstance(run.source, robot_source.GrammarSource):
        _warn_of_drawn(files[0].parent, sources)
    for mode in (given.mode,) if given.mode else MODES:
        scores = results[mode] = []
        for source in evaluated:
            with stage(f"{mode} on {robot_source.side_of(source)}", "episode"):
                scores += evaluate_checkpoints(files, source, config, mode, device=given.device)
    write(chain.from_iterable(results.values()))  # a submission is of one mode
    return results


def _other_robots(
    given: SimpleNamespace, run: RunConfig, folder: Path, config: EvalConfig
) -> list[robot_source.Source]:
    """Return other robots to evaluate than the run's own: named ones, or fresh ones of grammars."""
    if given.robots is not None:
        return _sources(given)
    if not isinstance(run.source, robot_source.GrammarSource):
        return []
    if given.on == "train":
        raise TaskError(
            f"--on train: {run.source.name} has no split; its policy is scored on fresh robots"
        )
    goals = GoalConfig(tasks=_with_goal(config.tasks, [run.source], given))
    fresh, line = robot_source.fresh_source(
        folder, run.source, goals, given.seed, jobs=given.workers or usable_cores()
    )
    note(f"morphgen: {line}")
    return [fresh]


def _warn_of_drawn(folder: Path, sources: list[robot_source.Source]) -> None:
    """Say which of the robots to evaluate were among the drawn robots of a run."""
    if not (folder / robot_source.FILE).is_file():
        unknown = "it is unknown whether the policy was trained on any of these robots"
        note(f"morphgen: {folder} has no {robot_source.FILE}: {unknown}")
        return
    names = [name for source in sources for name in robot_source.trained_on(folder, source)]
    if names:
        note(f"morphgen: the policy was trained on {', '.join(names)}")


def _sides(given: SimpleNamespace, source: robot_source.Source) -> tuple[Side, ...]:
    if given.on is not None:
        return (given.on,)
    return ("train", "test") if isinstance(source, robot_source.SplitSource) else ("train",)


def _sources(given: SimpleNamespace) -> list[robot_source.Source]:
    source = named_source(given)
    return [robot_source.other_side(source, side) for side in _sides(given, source)]


def _with_goal(
    configs: Iterable[TaskConfig], sources: list[robot_source.Source], given: SimpleNamespace
) -> tuple[TaskConfig, ...]:
    """Return configs with the goal of the given, which must be for a robot of the sources."""
    return with_goal(
        configs, given.goal, (task for each in sources for task in robot_source.tasks_of(each))
    )

"""``morphgen eval``: score a policy or a baseline on each robot."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import chain
from pathlib import Path
from typing import Any

from morphgen.benchmark.eval_protocol import EvalProtocol, protocol_from
from morphgen.benchmark.release import is_release, read_release
from morphgen.benchmark.scores.submission import (
    Training,
    make_submission,
    require_rules,
    submission_text,
)
from morphgen.cli import options as opt
from morphgen.cli.progress import note, training_progress
from morphgen.cli.train import robots_to_train
from morphgen.errors import TaskError
from morphgen.formats.files import require_writable_file, write_file
from morphgen.progress import stage
from morphgen.rl.baselines import BASELINES
from morphgen.rl.evaluation import (
    EvalConfig,
    episodes_for,
    eval_config_of,
    evaluate_baseline,
    evaluate_checkpoints,
    require_trained_tasks,
)
from morphgen.rl.inference import MODES
from morphgen.rl.runs.checkpoint import RunConfig, read_checkpoint, read_config
from morphgen.rl.runs.robot_source import (
    FILE,
    GrammarSource,
    Source,
    SplitSource,
    fresh_source,
    other_side,
    side_of,
    specs_of,
    split_of,
    tasks_of,
    trained_on,
)
from morphgen.rl.runs.training import checkpoint_files
from morphgen.rl.scores import (
    Score,
    require_table,
    score_table,
    scores_to_json,
    summary,
    write_scores,
)
from morphgen.rl.shipped_policies import checkpoint_path, is_named
from morphgen.splits.split import Side
from morphgen.tasks.registry import DEFAULT_SIMULATOR, require_device
from morphgen.tasks.scenes.env_specs import GoalConfig, default_configs
from morphgen.tasks.task import TaskConfig


def rules_of(words: Sequence[str]) -> EvalProtocol:
    """Return the rules of the release that ``--split`` names, else the default ones."""
    folder = Path(words[0]) if len(words) == 1 else None
    if folder is None or not is_release(folder):
        return EvalProtocol()
    return protocol_from(read_release(folder).evaluation, str(folder))


def plan_submission(
    args: argparse.Namespace,
    source: Source,
    config: EvalConfig,
    **facts: Any,  # noqa: ANN401
) -> Callable[[Iterable[Score]], None]:
    """Return the function that writes the episodes of scores as a submission.

    Without ``--submission`` it does nothing. ``facts`` are arguments of ``make_submission``.
    """
    if args.submission is None:
        return lambda scores: None
    if not isinstance(source, SplitSource):
        raise TaskError(f"--submission: {source.name} is no split; name one with --split")
    if args.on == "train":
        raise TaskError("--submission: the test robots are needed; leave --on train out")
    require_writable_file(args.submission, "--submission")
    split = split_of(source)
    rules = rules_of(args.words)
    goals = replace(rules.goals, seed=source.goal_seed, tasks=config.tasks)
    followed = EvalProtocol(config.sim, config.episodes, config.seed, goals).as_data(split)
    require_rules(followed, rules.as_data(split), "--submission")
    if args.method is not None:
        facts["method"] = args.method
    facts["evaluation"] = followed
    make_submission(split, (), **facts)  # refuses an invalid name or seed before hours of episodes
    return lambda scores: write_file(
        args.submission, submission_text(make_submission(split, scores, **facts))
    )


def evaluate(args: argparse.Namespace) -> None:
    """Evaluate and print the scores."""
    if args.out is not None:
        require_table(args.out)
    is_baseline = args.checkpoint in BASELINES
    if args.submission is not None and not is_baseline:
        args.mode = args.mode or "deterministic"
    with training_progress():
        scores = (_baseline_scores if is_baseline else _policy_scores)(args)
    data = {mode: scores_to_json(results) for mode, results in scores.items()}
    opt.print_result(args, data, lambda: f"{score_table(scores)}\n{summary(scores)}")
    if args.out is not None:
        write_scores(args.out, scores)


def _baseline_scores(args: argparse.Namespace) -> dict[str, list[Score]]:
    name = args.checkpoint
    if not args.words:
        raise TaskError(f"{name}: name its robots with --split")
    if args.mode or args.device != "cpu":
        raise TaskError(f"{'--mode' if args.mode else '--device'} is for policies; {name} has none")
    sources = _sources(args)
    config = EvalConfig(
        _num_episodes(args),
        _simulator(args) or DEFAULT_SIMULATOR,
        args.seed,
        args.workers,
        _with_goal(default_configs(), sources, args),
    )
    write = plan_submission(args, sources[0], config, method=name, mode="", training_seed=None)
    _prepare(sources, config)
    scores: list[Score] = []
    for source in sources:
        with stage(side_of(source)):
            scores += evaluate_baseline(name, source, config)
    write(scores)
    return {name: scores}


def _prepare(sources: Sequence[Source], config: EvalConfig) -> None:
    """Make the goal sets of robots, and show how many are ready; evaluations find them made."""
    for source in sources:
        specs_of(source, GoalConfig(tasks=config.tasks))


def _policy_scores(args: argparse.Namespace) -> dict[str, list[Score]]:
    require_device(args.device)
    path = checkpoint_path(args.checkpoint)
    files = list(checkpoint_files(path))
    for file in files:
        run, learner = read_checkpoint(file)
        if learner["update"] < run.num_updates:
            note(
                f"morphgen: {file} is not finished: update {learner['update']} of {run.num_updates}"
            )
    if len(files) > 1:  # a policy for each robot: their seeds and budgets are parts of the run's
        run = read_config(path)
    config = eval_config_of(run, _num_episodes(args), seed=args.seed, workers=args.workers)
    given = _given_robots(args, run, files[0].parent, config)
    sources = given or [run.source]
    require_trained_tasks(run, sources, args.checkpoint)
    tasks = _with_goal(config.tasks, sources, args)
    config = replace(config, sim=_simulator(args) or config.sim, tasks=tasks)
    sides = _sides(args, run.source)
    write = plan_submission(
        args,
        sources[0],
        config,
        method=args.checkpoint if is_named(args.checkpoint) else run.policy.agent,
        mode=args.mode or "",
        training_seed=run.seed,
        # A fine-tuned policy was trained before, by a run that its checkpoint does not describe.
        training=None if run.initial_checkpoint else Training(run.sim, run.ppo.total_timesteps),
    )
    evaluated = given or [other_side(run.source, side) for side in sides]
    _prepare(evaluated, config)
    results: dict[str, list[Score]] = {}
    if args.words and isinstance(run.source, GrammarSource):
        _warn_of_drawn(files[0].parent, sources)
    for mode in (args.mode,) if args.mode else MODES:
        scores = results[mode] = []
        for source in evaluated:
            with stage(f"{mode} on {side_of(source)}"):
                scores += evaluate_checkpoints(files, source, config, mode, device=args.device)
    write(chain.from_iterable(results.values()))  # with --submission of one mode
    return results


def _given_robots(
    args: argparse.Namespace, run: RunConfig, folder: Path, config: EvalConfig
) -> list[Source]:
    """Return other robots to evaluate than the run's own: named ones, or fresh ones of grammars."""
    if args.words:
        return _sources(args)
    if not isinstance(run.source, GrammarSource):
        return []
    if args.on == "train":
        raise TaskError(
            f"--on train: {run.source.name} has no split; its policy is scored on fresh robots"
        )
    tasks = _with_goal(config.tasks, [run.source], args)
    fresh, line = fresh_source(
        folder, run.source, GoalConfig(tasks=tasks), args.seed, jobs=args.workers
    )
    note(f"morphgen: {line}")
    return [fresh]


def _simulator(args: argparse.Namespace) -> str | None:
    """Return the simulator of ``--sim``, or that of a submission's rules; None for the default."""
    if args.sim is None and args.submission is not None:
        return rules_of(args.words).simulator
    return None if args.sim is None else str(args.sim)


def _warn_of_drawn(folder: Path, sources: list[Source]) -> None:
    """Say which of the robots to evaluate were among the drawn robots of a run."""
    if not (folder / FILE).is_file():
        unknown = "it is unknown whether the policy was trained on any of these robots"
        note(f"morphgen: {folder} has no {FILE}: {unknown}")
        return
    names = [name for source in sources for name in trained_on(folder, source)]
    if names:
        note(f"morphgen: the policy was trained on {', '.join(names)}")


def _sides(args: argparse.Namespace, source: Source) -> tuple[Side, ...]:
    if args.on is not None:
        return (args.on,)
    return ("train", "test") if isinstance(source, SplitSource) else ("train",)


def _sources(args: argparse.Namespace) -> list[Source]:
    source = robots_to_train(args.words, args)
    return [other_side(source, side) for side in _sides(args, source)]


def _with_goal(
    configs: Iterable[TaskConfig], sources: list[Source], args: argparse.Namespace
) -> tuple[TaskConfig, ...]:
    """Return configs with the goal of ``--goal``, which must be for a robot of the sources."""
    return opt.with_goal(configs, args.goal, (task for each in sources for task in tasks_of(each)))


def _num_episodes(args: argparse.Namespace) -> int:
    if args.episodes is not None:
        return int(args.episodes)
    return episodes_for(args.steps, max(config.max_episode_steps for config in default_configs()))

"""Success of a policy on every arm of the library with a stick, or on other robots.

    python benchmarks/zero_shot_arms.py [--task reach] [--goal position] [--obstacles]
        [--policy CHECKPOINT] [--episodes 50] [--only ur | --robots FILE ...] [--seed 0] [--jobs 2]
        [--json rows.json]
    python benchmarks/zero_shot_arms.py --episodes 20 --tolerances results/zero-shot/tolerances.json

Beside the policy are the untrained controllers of the task, in the same episodes. The arms are
those in use: not the templates of which robots are drawn for training, not the Panda with other
sizes, and not the YuMi with both arms. Episodes are those of ``morphgen zeroshot``, in MuJoCo. At
reach, the controller "path" follows the straight path of the observation channel ``ik``, to which
policies with ``--residual`` add their actions. A cell is the success rate with its 95% Wilson
interval. The last rows are the mean over the arms, and the number of arms below 80%.

With ``--tolerances``, distance and angle at the end of each episode at poses are kept in a file,
which arms that are in it already are read from. An episode of reach lasts 6 s, whatever happens,
and its success is that of its last step: so success at other tolerances follows from the same
episodes. The controllers know of none but those of the policy's training, 30 mm and 10 degrees.
"""

from __future__ import annotations

import argparse
import json
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from statistics import mean
from typing import Any

import torch
from tabulate import tabulate
from tqdm import tqdm

from morphgen.errors import TaskError, one_line
from morphgen.files import write_atomic
from morphgen.grammar.library import default_library
from morphgen.processes import parallel_map
from morphgen.rl.baselines import BASELINES, Baseline
from morphgen.rl.evaluation import (
    EvalConfig,
    MakeController,
    eval_config_of,
    evaluate,
    run_all,
    zero_shot,
    zero_shot_data,
)
from morphgen.rl.inference import Policy, PolicyController
from morphgen.rl.runs.checkpoint import Interface, read_checkpoint
from morphgen.rl.runs.robot_source import robot_source, specs_of
from morphgen.rl.scores import Score, success_interval, success_of
from morphgen.rl.shipped_policies import checkpoint_path, name_of, zero_shot_policy
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.kinematic_channels import IK_SHARE
from morphgen.tasks.observation import observation_config
from morphgen.tasks.registry import GOAL_KINDS
from morphgen.tasks.scenes.env_specs import GoalConfig

LEFT_OUT = ("arm3", "arm5", "arm_ed", "panda_scaled", "yumi")
ENOUGH = 0.8
PATH = observation_config(("ik",))
MILLIMETRES, DEGREES = (30, 10, 5, 1), (10, 5, 1)
Errors = Mapping[str, Mapping[str, list[float]]]
"""Distances [m] and angles [rad] at the end of the episodes of an arm, by controller."""


class FollowPath:
    """Controller that follows the straight path of the channel ``ik``."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions, shape (n, L)."""
        return task.observe()["ik"][..., IK_SHARE]


@dataclass(frozen=True)
class PathBaseline(Baseline):
    """``FollowPath`` as a baseline."""

    def make(self, seed: int) -> FollowPath:
        """Return a new controller."""
        return FollowPath()


@dataclass(frozen=True)
class Measuring:
    """Measurement of one arm, as worker processes run it."""

    task: str
    obstacles: bool
    policy: Path
    config: EvalConfig

    def __call__(self, robot: tuple[str, str]) -> tuple[str, dict[str, Score] | str]:
        """Return the label of a robot and its results, or why it cannot do the task.

        Args:
            robot: Its label and its words.
        """
        label, words = robot
        source = robot_source(words, self.task, obstacles=self.obstacles)
        try:
            results = zero_shot(source, self.policy, self.config)
        except TaskError as error:
            return label, one_line(str(error))
        if self.task == "reach":
            (score,) = evaluate([FollowPath], source, self.config, Interface(observe=PATH))
            (policy, own), *others = results.items()
            results = {policy: own, "path": score, **dict(others)}
        return label, results


@dataclass(frozen=True)
class MeasuringErrors:
    """Measurement of one arm's errors at the end of episodes, as worker processes run it."""

    obstacles: bool
    policy: Path
    config: EvalConfig

    def __call__(self, robot: tuple[str, str]) -> tuple[str, Errors]:
        """Return the label of a robot and its errors; the argument is as of ``Measuring``."""
        label, words = robot
        source = robot_source(words, "reach", obstacles=self.obstacles)
        specs, seed = specs_of(source, GoalConfig(tasks=self.config.tasks)), self.config.seed
        run, learner = read_checkpoint(self.policy)
        policy = PolicyController(Policy(learner, "deterministic", seed))
        controllers: dict[str, tuple[MakeController, Interface]] = {
            name_of(self.policy): (lambda: policy, run.interface),
            "path": (partial(PathBaseline("path", "").make, seed), Interface(observe=PATH)),
            **{
                name: (partial(BASELINES[name].make, seed), Interface())
                for name in ("ik", "jacobian")
            },
        }
        errors = {}
        for name, (make, interface) in controllers.items():
            (episodes,) = run_all(make, specs, self.config, interface, ())
            episodes = episodes[: self.config.episodes]
            errors[name] = {
                key: [round(getattr(episode, key), 6) for episode in episodes]
                for key in ("distance", "angle")
            }
        return label, errors


def measure_errors(
    work: MeasuringErrors, robots: Mapping[str, str], jobs: int, file: Path
) -> dict[str, Errors]:
    """Return the errors of robots by label; those that the file lacks are measured and added."""
    settings = {
        "policy": name_of(work.policy),
        "obstacles": work.obstacles,
        "episodes": work.config.episodes,
        "seed": work.config.seed,
    }
    stored: dict[str, Any] = settings | {"robots": {}}
    if file.exists():
        stored = json.loads(file.read_text("utf-8"))
    errors: dict[str, Errors] = stored.pop("robots")
    if stored != settings:
        raise SystemExit(f"{file} has the errors of {stored}, not of {settings}")
    missing = [robot for robot in robots.items() if robot[0] not in errors]
    for label, own in tqdm(parallel_map(work, missing, jobs, chunk=1), total=len(missing)):
        errors[label] = own
        write_atomic(file, json.dumps(settings | {"robots": errors}) + "\n")
    return {label: errors[label] for label in robots}


def tolerance_table(errors: Mapping[str, Errors]) -> str:
    """Return success by tolerance: mean over the arms with its interval; lowest of an arm."""
    rows = []
    for name in next(iter(errors.values())):
        for degrees in DEGREES:
            row = [f"`{name}`, {degrees} degree" + "s" * (degrees > 1)]
            for millimetres in MILLIMETRES:
                rates, trials = [], []
                for arm in errors.values():
                    pairs = list(zip(arm[name]["distance"], arm[name]["angle"], strict=True))
                    near = [
                        distance < millimetres / 1000 and angle < math.radians(degrees)
                        for distance, angle in pairs
                    ]
                    rates.append(mean(near))
                    trials.append(len(near))
                interval = success_interval(rates, trials)
                row.append(f"{interval.as_percent()}; {min(rates):.0%}")
            rows.append(row)
    headers = ["success", *(f"{millimetres} mm" for millimetres in MILLIMETRES)]
    return tabulate(rows, headers=headers, tablefmt="github", disable_numparse=True)


def main() -> None:
    """Measure all robots and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="reach")
    parser.add_argument("--goal", choices=GOAL_KINDS, default=GOAL_KINDS[0])
    parser.add_argument("--policy", help="a checkpoint, or a policy that comes with morphgen")
    parser.add_argument("--obstacles", action="store_true")
    parser.add_argument("--episodes", type=int, default=50)
    parser.add_argument("--only", default="", help="arms whose name matches this expression")
    parser.add_argument("--robots", nargs="+", help="files and bundles instead of the arms")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the rows here")
    parser.add_argument("--tolerances", type=Path, help="file of errors at the end of episodes")
    args = parser.parse_args()
    if args.tolerances:
        args.task, args.goal = "reach", "pose"
    if args.robots:
        robots = {Path(file).stem: file for file in args.robots}
    else:
        robots = {
            manifest.name: f"arm={manifest.name} ee=stick"
            for manifest in default_library().manifests()
            if manifest.kind == "arm"
            and manifest.name not in LEFT_OUT
            and re.search(args.only, manifest.name)
        }
    shipped = zero_shot_policy(args.task, args.goal, obstacles=args.obstacles)
    policy = checkpoint_path(args.policy or shipped.name)
    run, _ = read_checkpoint(policy)
    config = replace(eval_config_of(run, args.episodes, seed=args.seed), sim="mujoco")
    if args.tolerances:
        measuring = MeasuringErrors(args.obstacles, policy, config)
        print(tolerance_table(measure_errors(measuring, robots, args.jobs, args.tolerances)))
        return
    work = Measuring(args.task, args.obstacles, policy, config)
    results = parallel_map(work, list(robots.items()), args.jobs, chunk=1)
    measured: dict[str, dict[str, Score]] = {}
    for label, result in tqdm(results, total=len(robots), unit="robot"):
        if isinstance(result, str):
            tqdm.write(f"left out: {label}: {result}")
        else:
            measured[label] = result
    if args.json:
        rows = {label: zero_shot_data(row) for label, row in measured.items()}
        args.json.write_text(json.dumps(rows, indent=2) + "\n")
    names = list(next(iter(measured.values())))
    rates = list(
        zip(*([s.success for s in row.values()] for row in measured.values()), strict=True)
    )
    table: list[list[str]] = [
        [label, *(success_of([score]).as_percent() for score in row.values())]
        for label, row in measured.items()
    ]
    table.append(["mean", *(f"{mean(rate):.1%}" for rate in rates)])
    table.append(["below 80%", *(str(sum(x < ENOUGH for x in rate)) for rate in rates)])
    print(tabulate(table, headers=["robot", *names]))


if __name__ == "__main__":
    main()

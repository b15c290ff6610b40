"""Success on unseen robots against the number of robots that a policy was trained on, with a law.

    python benchmarks/scaling_law.py [--tasks push door pose push_cloned push_short]
        [--robots 1 3 10 30 100 300 1000] [--seeds 0 1 2 3 4] [--jobs 4] [--runs runs/scaling-law]
        [--out results/scaling-law.json] [--report]

Each policy is trained on robots that are drawn from the grammar ``serial``, none of which is in a
split, by PPO on GPUs in MuJoCo Warp, or without contacts for poses; all policies of a task have the
same number of simulated steps. Those of ``push_cloned`` learn, on the CPU, from the successes among
about 1,000 episodes of the baseline ``path`` with the drawn robots, with noise on its actions, and
those of ``push_short`` by PPO from 60,000 steps. A seed is that of the robots and of the training.
The policies are judged in MuJoCo, all in the same episodes, on robots of three kinds, none of which
they were trained on: other draws of ``serial``; draws of grammars with other structures; and ten
real arms with a stick.

Cells, a task with a number of robots and a seed, are kept in ``--out`` as soon as they are judged.
What is there is not done again, and a training that was stopped is resumed. ``--jobs`` cells are
trained or judged at once, on GPUs in turn. Tables are of the cells that are there; the others are
named. ``--report`` only prints them.

The law is ``failures = floor + a * robots ** -exponent``, fitted by least squares to the means over
seeds with all three constants at least zero. Intervals are 95% of 2,000 fits to seeds drawn with
replacement. There is no law ("none") where more than 2.5% of the fits are flat. The law saturates
at the least number of robots with which the success is, within the interval of the same resampling,
that of the most robots. Exponents up to 3 are tried.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TypeAlias

import numpy as np
import torch
from tabulate import tabulate

from morphgen.files import write_atomic
from morphgen.rl.evaluation import eval_config_of, evaluate_checkpoints
from morphgen.rl.runs.checkpoint import CHECKPOINT, read_checkpoint
from morphgen.rl.runs.robot_source import (
    Source,
    SplitSource,
    draw,
    drawn_source,
    robot_source,
    split_source,
    tasks_of,
)
from morphgen.rl.scores import Score
from morphgen.splits.split import Split
from morphgen.tasks.scenes.env_specs import GoalConfig
from morphgen.tasks.task import TaskConfig
from morphgen.typing import Array
from robot_curve import REAL_ARMS, is_trained

GRAMMAR = "serial"
OTHER_STRUCTURES = "arm3:20,arm5:20,chain:20"
TEST_SEED = 1_000_000  # seed of the robots to judge on, far from those to train on
TESTS = {"same grammar": 4, "other structures": 3, "ten real arms": 20}
"""Number of episodes of each robot of a test, which has 50, 60 or 10 robots."""
NUM_RESAMPLES = 2000
LEAST_NUMBERS = 4  # numbers of robots that a fit of three constants needs
EXPONENTS = np.linspace(0.02, 3.0, 150)  # those that a fit tries

Outcomes: TypeAlias = dict[str, tuple[float, int]]  # success rate and number of episodes by robot
Cells: TypeAlias = dict[str, dict[str, Outcomes]]  # outcomes by cell and test


@dataclass(frozen=True)
class Task:
    """A task of the law, and how its policies are trained."""

    name: str
    steps: float
    """Simulated steps of a training."""
    options: tuple[str, ...]
    episodes: int = 0
    """Episodes that are recorded to be cloned, in place of a training by PPO."""


_ON_GPU = ("--device", "cuda", "--compile", "--train-goals", "50", "--no-tensorboard")
_CONTACTS = (
    *("--observe", "contact,pace", "--sim", "warp", "--envs", "2400", *_ON_GPU),
    *("--set", "num_steps=16", "--set", "epochs=4", "--set", "minibatches=8"),
)
TASKS = {
    "push": Task("push", 4e6, _CONTACTS),
    "push_cloned": Task(
        "push",
        0,
        ("--agent", "me-graph+ik+contact+pace", "--epochs", "30", "--no-tensorboard"),
        episodes=1000,
    ),
    "push_short": Task(
        "push",
        6e4,
        ("--observe", "contact,pace", "--train-goals", "50", "--no-tensorboard", "--envs", "30"),
    ),
    "door": Task("door", 3e6, _CONTACTS),
    "pose": Task(
        "reach",
        4e6,
        (
            *("--goal", "pose", "--sim", "kinematic", "--envs", "3000", *_ON_GPU),
            *("--set", "num_steps=16", "--set", "epochs=4", "--set", "minibatches=8"),
        ),
    ),
}


@dataclass(frozen=True, order=True)
class Cell:
    """A policy of the law."""

    seed: int
    robots: int
    task: str

    @property
    def name(self) -> str:
        """Name of the cell in the file, and of its run."""
        return f"{self.task}-{self.robots}-{self.seed}"


def train(cell: Cell, runs: Path, gpu: int) -> Path:
    """Train the policy of a cell, unless that is done, and return its folder."""
    run = runs / cell.name
    if is_trained(run):
        return run
    run.mkdir(parents=True, exist_ok=True)
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    device = str(gpu) if visible is None else visible.split(",")[gpu]
    with (runs / f"{cell.name}.log").open("a") as log:
        for words in _commands(cell, run):
            subprocess.run(
                [sys.executable, "-m", "morphgen", *words],
                check=True,
                env={**os.environ, "CUDA_VISIBLE_DEVICES": device},
                stdout=log,
                stderr=subprocess.STDOUT,
            )
    return run


def _commands(cell: Cell, run: Path) -> list[list[str]]:
    """Return the commands that train the policy of a cell; each goes on if it was stopped."""
    task, robots = TASKS[cell.task], f"{GRAMMAR}:{cell.robots}"
    seed, end = str(cell.seed), ["--resume", "--out", str(run)]
    if not task.episodes:
        steps = ["--robot-seed", seed, "--seed", seed, "--steps", str(task.steps)]
        return [["train", f"task={task.name}", "--robots", robots, *steps, *task.options, *end]]
    demonstrations = str(run.with_name(f"{run.name}-demos"))
    recorded = ["--tasks", task.name, "--policy", "path", "--noise", "0.2", "--only-success"]
    number = ["--episodes", str(max(1, round(task.episodes / cell.robots))), "--seed", seed]
    return [
        ["record", "--robots", robots, *recorded, *number, "--out", demonstrations],
        ["clone", demonstrations, "--seed", seed, *task.options, *end],
    ]


@cache
def _drawn(grammars: str, task: str, configs: tuple[TaskConfig, ...]) -> SplitSource:
    """Return draws of grammars, with a seed that no training has, as the test side of a split."""
    source = drawn_source(grammars, task, seed=TEST_SEED)
    robots = draw(source, GoalConfig(tasks=configs)).members
    return split_source(Split("law", "interpolation", grammars, robots, robots), side="test")


def _sources(test: str, task: str, configs: tuple[TaskConfig, ...]) -> list[Source]:
    """Return the robots of a test."""
    if test == "ten real arms":
        return [robot_source(f"arm={arm} ee=stick", task) for arm in REAL_ARMS]
    grammars = f"{GRAMMAR}:50" if test == "same grammar" else OTHER_STRUCTURES
    return [_drawn(grammars, task, configs)]


def judge(run: Path) -> dict[str, Outcomes]:
    """Return the outcomes of a policy on the robots of each test."""
    torch.set_num_threads(1)
    trained, _ = read_checkpoint(run)
    outcomes: dict[str, Outcomes] = {}
    for test, episodes in TESTS.items():
        config = eval_config_of(trained, episodes, workers=1)
        (task,) = tasks_of(trained.source)
        scores: list[Score] = []
        for source in _sources(test, task, config.tasks):
            scores += evaluate_checkpoints([run / CHECKPOINT], source, config, "deterministic")
        outcomes[test] = {
            score.robot: (round(score.success, 4), score.episodes) for score in scores
        }
    return outcomes


def train_and_judge(cell: Cell, runs: Path, gpu: int) -> dict[str, Outcomes]:
    """Return the outcomes of a cell, whose policy is trained first."""
    return judge(train(cell, runs, gpu))


def read_cells(path: Path) -> Cells:
    """Return the outcomes of the cells that are there."""
    return dict(json.loads(path.read_text("utf-8"))) if path.exists() else {}


def write_cells(path: Path, cells: Cells) -> None:
    """Write the cells, one line each."""
    lines = (f"{json.dumps(name)}: {json.dumps(cells[name])}" for name in sorted(cells))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, "{\n" + ",\n".join(lines) + "\n}\n")


def success_table(cells: Cells, task: str, robots: Sequence[int], test: str) -> Array:
    """Return the mean success over episodes by number of robots and seed; nan where none is.

    The shape is (numbers, seeds).
    """
    names = [name.split("-") for name in cells if name.startswith(f"{task}-")]
    seeds = sorted({int(seed) for _, _, seed in names})
    table = np.full((len(robots), len(seeds)), np.nan)
    for i, number in enumerate(robots):
        for j, seed in enumerate(seeds):
            outcomes = cells.get(Cell(seed, number, task).name)
            if outcomes is not None:
                success, episodes = np.array(list(outcomes[test].values())).T
                table[i, j] = np.average(success, weights=episodes)
    return table


def fitted(robots: Array, failures: Array) -> tuple[Array, Array, Array]:
    """Return floor, factor and exponent of ``floor + factor * robots ** -exponent``.

    Failures have the shape (fits, numbers). For each exponent of a grid, floor and factor are those
    of the least squared error that are at least zero; the exponent is nan where the factor is zero.
    """
    powers = robots[None] ** -EXPONENTS[:, None]  # (exponents, numbers)
    count, of_powers, of_squares = len(robots), powers.sum(axis=1), (powers**2).sum(axis=1)
    total, joint = failures.sum(axis=1)[:, None], failures @ powers.T  # (fits, exponents)
    factor = (count * joint - of_powers * total) / (count * of_squares - of_powers**2)
    floor = (total - factor * of_powers) / count
    # The minimum over a quadrant is inside of it, or on one of its two edges.
    factor = np.where(floor < 0, joint / of_squares, factor).clip(min=0)
    floor = np.where(factor == 0, total / count, floor).clip(min=0)
    predicted = floor[..., None] + factor[..., None] * powers
    best = ((predicted - failures[:, None]) ** 2).sum(axis=2).argmin(axis=1)
    rows = np.arange(len(failures)), best
    is_flat = factor[rows] == 0
    return floor[rows], factor[rows], np.where(is_flat, np.nan, EXPONENTS[best])


def law(robots: Sequence[int], success: Array) -> tuple[str, ...] | None:
    """Return exponent, floor, gain and saturation of a test as texts; None with too few numbers.

    The success has the shape (numbers, seeds). Only numbers that all seeds have are used.
    """
    complete = ~np.isnan(success).any(axis=1)
    numbers, values = np.array(robots, float)[complete], success[complete]
    if len(numbers) < LEAST_NUMBERS:
        return None
    # A seed's robots are among those of its larger numbers: seeds are drawn whole.
    num_seeds = values.shape[1]
    drawn = np.random.default_rng(0).integers(num_seeds, size=(NUM_RESAMPLES, num_seeds))
    means = np.vstack([values.mean(axis=1), values[:, drawn].mean(axis=2).T])
    floor, _, exponent = fitted(numbers, 1 - means)
    gain = means[:, -1:] - means  # of the most robots over each number
    saturated = np.quantile(gain[1:], 0.025, axis=0) <= 0
    is_law = np.isnan(exponent[1:]).mean() < 0.025
    return (
        _interval(exponent) if is_law else "none",
        _interval(floor),
        _interval(gain[:, 0]),
        f"{numbers[saturated.argmax()]:.0f}",
    )


def report(cells: Cells, tasks: Sequence[str], robots: Sequence[int], seeds: Sequence[int]) -> str:
    """Return the tables, the laws, and the names of the cells that are missing."""
    parts = []
    for task in tasks:
        tables = {test: success_table(cells, task, robots, test) for test in TESTS}
        rows = [
            [number, *(_cell(table[i]) for table in tables.values())]
            for i, number in enumerate(robots)
            if not np.isnan(next(iter(tables.values()))[i]).all()
        ]
        parts.append(f"{task}\n\n" + tabulate(rows, ["robots", *TESTS], tablefmt="github"))
        laws = {test: law(robots, table) for test, table in tables.items()}
        if fits := [[test, *texts] for test, texts in laws.items() if texts]:
            gain = f"gain over {min(robots)}"
            headers = [f"{task}: law", "exponent", "failures that remain", gain, "saturates at"]
            parts.append(tabulate(fits, headers, tablefmt="github"))
        wanted = [Cell(seed, number, task).name for number in robots for seed in seeds]
        if missing := [name for name in wanted if name not in cells]:
            parts.append(f"missing: {', '.join(missing)}")
    return "\n\n".join(parts)


def _cell(success: Array) -> str:
    """Return mean, lowest and highest success of the seeds that are there."""
    there = success[~np.isnan(success)]
    if not len(there):
        return ""
    return f"{there.mean():.1%} [{there.min():.0%}, {there.max():.0%}], {len(there)}"


def _interval(values: Array) -> str:
    """Return the first value with the 95% interval of the others."""
    low, high = np.nanquantile(values[1:], (0.025, 0.975))
    return f"{values[0]:.2f} [{low:.2f}, {high:.2f}]"


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Return the options of the command line, or of other words."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tasks", nargs="+", choices=TASKS, default=list(TASKS))
    parser.add_argument("--robots", type=int, nargs="+", default=[1, 3, 10, 30, 100, 300, 1000])
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--jobs", type=int, default=4, help="cells at once (default: 4)")
    parser.add_argument("--runs", type=Path, default=Path("runs/scaling-law"))
    parser.add_argument("--out", type=Path, default=Path("results/scaling-law.json"))
    parser.add_argument("--report", action="store_true", help="only print the tables")
    return parser.parse_args(words)


def main() -> None:
    """Train and judge the cells that are missing, seed by seed, and print the tables."""
    args, failed = arguments(), list[str]()
    if not args.report:
        cells = read_cells(args.out)
        queue = sorted(
            cell
            for task in args.tasks
            for robots in args.robots
            for seed in args.seeds
            if (cell := Cell(seed, robots, task)).name not in cells
        )
        context = multiprocessing.get_context("spawn")  # CUDA does not survive a fork
        gpus = max(torch.cuda.device_count(), 1)
        with ProcessPoolExecutor(args.jobs, context) as pool:
            running = {
                pool.submit(train_and_judge, cell, args.runs, i % gpus): cell
                for i, cell in enumerate(queue)
            }
            for future in as_completed(running):
                name = running[future].name
                if (error := future.exception()) is not None:  # the others go on
                    failed.append(f"{name}: {error}")
                    continue
                cells[name] = future.result()
                write_cells(args.out, cells)
                print(f"{name}: {len(cells)} cells are there", flush=True)
    print(report(read_cells(args.out), args.tasks, args.robots, args.seeds))
    if failed:
        sys.exit("\n".join(failed))


if __name__ == "__main__":
    main()

"""Soak test: random actions for minutes, watching for NaN, memory leaks and orphan processes.

    python benchmarks/soak.py [SPLIT] [--minutes 10] [--envs 40] [--sim pybullet] [--workers 1]

Steps the train robots of a split among obstacles, even if the split's tasks have none. Tests every
observation and reward. Prints the resident memory of this process and its workers after a tenth of
the time and at the end. The exit code is 1 if a value was not finite, if a simulation diverged, if
memory grew by more than a twentieth in between, or if a worker outlived the batch.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import time
from contextlib import closing
from pathlib import Path

import torch
from tqdm import tqdm

from env_speed import random_actions
from morphgen.fitting.replace_collision import as_primitives
from morphgen.grammar.library import default_library
from morphgen.splits.split import compose_side, read_split
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.registry import SIMULATORS
from morphgen.tasks.scenes.make import make_batch

GROWTH = 1.05
"""Largest accepted ratio of the memory at the end to the memory after a tenth of the time."""


def main() -> int:
    """Step and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("split", nargs="?", default="extrapolation/arms/reach")
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--envs", type=int, default=40)
    parser.add_argument("--sim", choices=SIMULATORS, default="pybullet")
    parser.add_argument("--workers", type=int, default=1)
    args = parser.parse_args()
    split, library = read_split(args.split), default_library(())
    bodies = [
        as_primitives(robot, library.folders) for robot in compose_side(split, "train", library)
    ]
    tasks = [member.task for member in split.train]
    torch.set_num_threads(1)
    with closing(
        make_batch(tasks, bodies, args.envs, sim=args.sim, workers=args.workers, obstacles=True)
    ) as batch:
        steps, early, late, lost, unstable = _run(batch, 60 * args.minutes)
    left = [process.pid for process in multiprocessing.active_children()]
    print(f"{steps:,} steps of {args.envs} environments in {args.minutes:g} minutes, {args.sim}")
    print(f"memory after a tenth: {early / 2**20:,.0f} MB; at the end: {late / 2**20:,.0f} MB")
    print(f"steps with non-finite values: {lost}; orphan processes: {len(left)}")
    print(f"diverged episodes: {unstable}")
    return int(lost > 0 or unstable > 0 or late > GROWTH * early or bool(left))


def _run(batch: TaskBatch, seconds: float) -> tuple[int, int, int, int, int]:
    """Return steps, early and final memory [bytes], non-finite steps and diverged episodes."""
    actions = random_actions(batch, 1000, seed=0)
    batch.reset()
    steps = lost = early = unstable = 0
    start = time.monotonic()
    with tqdm(total=round(seconds), unit="s") as bar:
        while (elapsed := time.monotonic() - start) < seconds:
            if not early and elapsed > seconds / 10:
                early = _memory()
            step = batch.step(actions[steps % len(actions)])
            lost += not _is_finite(step)
            unstable += int(step.diverged.sum())
            steps += 1
            bar.update(int(elapsed) - bar.n)
    return steps, early, _memory(), lost, unstable


def _is_finite(step: Step) -> bool:
    results = [step.reward, step.distance, step.score, *step.terms.values()]
    observations = [*step.observation.values(), *step.final_observation.values()]
    return all(bool(values.isfinite().all()) for values in (*results, *observations))


def _memory() -> int:
    """Return the resident memory of this process and its children [bytes], from /proc."""
    pids = ["self", *(str(process.pid) for process in multiprocessing.active_children())]
    pages = [int(Path(f"/proc/{pid}/statm").read_text().split()[1]) for pid in pids]
    return sum(pages) * 4096


if __name__ == "__main__":
    sys.exit(main())

"""Time to draw training robots, and the share of a training that building their batches takes.

    python benchmarks/drawn_robots.py [--robots arm3:1000] [--goals 20] [--envs 100]
        [--sims mujoco,kinematic] [--agents me-mlp,me-graph]

The first table has CPU seconds of one process: robots drawn with an empty cache of goal sets, and
again with the goal sets of the first time. The line below it has the memory that the robots take.

The second table has a row for each simulator and agent: CPU seconds of one slice of
``morphgen train --robots`` (``--envs`` robots for 600 control steps, rollouts of 32 steps), those
of building its batch, and their share.
"""

from __future__ import annotations

import argparse
import os
import resource
import tempfile
import time
from dataclasses import replace
from itertools import product

import torch
from tabulate import tabulate

from morphgen.rl.config import PolicyConfig, PPOConfig
from morphgen.rl.ppo import Learner
from morphgen.rl.runs import robot_source as drawn_robots
from morphgen.rl.runs.checkpoint import RunConfig
from morphgen.rl.runs.robot_source import GrammarSource, draw, drawn_source
from morphgen.rl.runs.training import SLICE_STEPS, TrainingBatches
from morphgen.tasks.scenes.env_specs import GoalConfig, default_configs
from morphgen.tasks.task import TaskConfig

NUM_STEPS = 32


def main() -> None:
    """Measure and print both tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--robots", default="arm3:1000")
    parser.add_argument("--goals", type=int, default=20)
    parser.add_argument("--envs", type=int, default=100)
    parser.add_argument("--sims", default="mujoco,kinematic")
    parser.add_argument("--agents", default="me-mlp,me-graph")
    args = parser.parse_args()
    torch.set_num_threads(1)
    source = drawn_source(args.robots, "reach")
    tasks = tuple(replace(config, num_goals=args.goals) for config in default_configs())
    with tempfile.TemporaryDirectory() as cache:
        os.environ["XDG_CACHE_HOME"] = cache
        before = _peak_memory()
        rows = [("empty cache", measure_drawing(source, tasks))]
        memory = _peak_memory() - before
        rows.append(("cached goals", measure_drawing(source, tasks)))
        print(tabulate(rows, (args.robots, "CPU s"), floatfmt=".1f"))
        print(f"memory: {memory:.0f} MB\n")
        shares = [
            (sim, agent, *measure_slice(source, tasks, sim, agent, args.envs))
            for sim, agent in product(args.sims.split(","), args.agents.split(","))
        ]
    headers = ("simulator", "agent", "slice CPU s", "batch CPU s", "share")
    print(tabulate(shares, headers, floatfmt=("", "", ".1f", ".2f", ".1%")))


def measure_drawing(source: GrammarSource, tasks: tuple[TaskConfig, ...]) -> float:
    """Return the CPU seconds of drawing all robots."""
    drawn_robots._drawn.clear()
    start = time.process_time()
    draw(source, GoalConfig(tasks=tasks))
    return time.process_time() - start


def measure_slice(
    source: GrammarSource, tasks: tuple[TaskConfig, ...], sim: str, agent: str, num_envs: int
) -> tuple[float, float, float]:
    """Return CPU seconds of a slice and of building its batch, and their ratio.

    The learner is warm: it has made one update with another slice.
    """
    updates = -(-SLICE_STEPS // NUM_STEPS)
    ppo = PPOConfig(total_timesteps=3 * updates * NUM_STEPS * num_envs, num_steps=NUM_STEPS)
    policy = PolicyConfig(agent, discrete=False)
    config = RunConfig(
        source, policy, ppo, sim=sim, num_envs=num_envs, tasks=tasks, slice_updates=updates
    )
    batches = TrainingBatches(config)
    learner = Learner(batches.make(0), policy, ppo, least_links=batches.most_links)
    learner.iterate()
    start = time.process_time()
    learner.use(batches.make(updates))
    built = time.process_time() - start
    for _ in range(updates):
        learner.iterate()
    total = time.process_time() - start
    batches.close()
    return total, built, built / total


def _peak_memory() -> float:
    """Return the largest memory of the process so far [MB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


if __name__ == "__main__":
    main()

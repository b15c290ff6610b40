"""Success of the baselines on every robot of every scenario, in both simulators.

    python benchmarks/reference_controllers.py [--task reach] [--only ur5] [--envs 8] [--episodes 2]
        [--sims pybullet,mujoco] [--obstacles] [--goal pose] [--jobs 2] [--json rows.json]

Runs each distinct pair of robot and task of the shipped splits, with collision shapes of fitted
primitives and the goals and starts of seed 0. A row gives the success rate of each baseline (reach:
``ik``, ``jacobian`` and ``random``; others: ``scripted`` and ``random``), and the largest motion of
the tool in an episode without actions. "labels/s" are the steps of the episodes of ``ik`` or
``scripted`` per second of CPU time, with planning and simulation: the speed of demonstrations.
Obstacles exist only with ``--obstacles``.

The last rows are means. If a simulator is not installed, its columns are missing and the script
prints that.
"""

from __future__ import annotations

import argparse
import json
import re
import sys
import time
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import mean

import torch
from tabulate import tabulate
from tqdm import tqdm

from morphgen.grammar.library import Library, default_library
from morphgen.model.kinematics_torch import frame_positions
from morphgen.processes import parallel_map
from morphgen.rl.baselines import BASELINES, baselines_for
from morphgen.rl.baselines.reach import Zero
from morphgen.rl.inference import run_episodes
from morphgen.splits.split import SIDES, Member, read_split, split_names
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.configs import ReachConfig
from morphgen.tasks.registry import GOAL_KINDS, TASKS, installed_simulators
from morphgen.tasks.scenes.env_specs import GoalConfig, member_spec
from morphgen.tasks.scenes.make import batch_from_specs

Row = dict[str, float | str]


@dataclass(frozen=True)
class Measuring:
    """Measurement of one robot, as worker processes run it."""

    sims: tuple[str, ...]
    envs: int
    episodes: int
    obstacles: bool
    goal: str

    @cached_property
    def library(self) -> Library:
        """Library of parts."""
        return default_library(())

    def __call__(self, member: Member) -> Row:
        """Measure one robot at one task."""
        torch.set_num_threads(1)
        config = GoalConfig(tasks=(ReachConfig(goal=self.goal),))
        spec = member_spec(replace(member, obstacles=self.obstacles), self.library, config)
        row: Row = {"robot": member.name, "task": member.task}
        for sim in self.sims:
            with closing(batch_from_specs([spec], self.envs, sim=sim, layouts="eval")) as batch:
                for name in baselines_for(member.task):
                    if name == "zero":
                        continue
                    began = time.process_time()
                    episodes = run_episodes(batch, BASELINES[name].make(0), self.episodes)
                    seconds = time.process_time() - began
                    row[f"{sim} {name}"] = mean(episode.success for episode in episodes)
                    if name == baselines_for(member.task)[0]:
                        labels = sum(episode.steps for episode in episodes)
                        row[f"{sim} labels/s"] = labels / seconds
                row[f"{sim} drift mm"] = _drift(batch)
        return row


def main() -> int:
    """Measure all robots and print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", choices=TASKS)
    parser.add_argument("--only", default="", help="robots whose name matches this expression")
    parser.add_argument("--envs", type=int, default=8)
    parser.add_argument("--episodes", type=int, default=2, help="of each environment")
    parser.add_argument("--sims", default="pybullet,mujoco")
    parser.add_argument("--obstacles", action="store_true")
    parser.add_argument("--goal", choices=GOAL_KINDS, default=GOAL_KINDS[0], help="of reach")
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--json", type=Path, help="also write the rows here")
    args = parser.parse_args()
    requested, installed = args.sims.split(","), installed_simulators()
    sims = tuple(sim for sim in requested if sim in installed)
    members = [
        member
        for member in _members()
        if args.task in (None, member.task) and re.search(args.only, member.name)
    ]
    work = Measuring(sims, args.envs, args.episodes, args.obstacles, args.goal)
    rows: list[Row] = []
    for row in tqdm(
        parallel_map(work, members, args.jobs, chunk=1), total=len(members), unit="robot"
    ):
        rows.append(row)
        _write(args.json, rows)
    for task in TASKS:
        of_task = [row for row in rows if row["task"] == task]
        if of_task:
            numbers = [key for key in of_task[0] if key not in ("robot", "task")]
            means = {key: mean(float(row[key]) for row in of_task) for key in numbers}
            rows.append({"robot": "mean", "task": task, **means})
    _write(args.json, rows)
    print(tabulate(rows, headers="keys", floatfmt=".2f"))
    for sim in requested:
        if sim not in installed:
            print(f"{sim}: left out")
    return 0


def _write(path: Path | None, rows: list[Row]) -> None:
    """Write the results so far, in case the run is interrupted."""
    if path:
        path.write_text(json.dumps(rows, indent=1) + "\n", encoding="utf-8")


def _members() -> Iterator[Member]:
    """Return one split member for each pair of robot and task."""
    seen: set[tuple[str, str]] = set()
    for name in split_names():
        split = read_split(name)
        for side in SIDES:
            for member in split.side(side):
                if (member.robot_hash, member.task) not in seen:
                    seen.add((member.robot_hash, member.task))
                    yield member


def _drift(batch: TaskBatch) -> float:
    """Return the largest tool motion in an episode without actions [mm]."""
    batch.reset()
    start = frame_positions(batch.robot_tables.tool_chain, batch.env_robot_index, batch.q)
    acting, farthest = Zero(), 0.0
    for _ in range(int(batch.max_episode_steps.min()) - 1):
        batch.step(acting.act(batch))
        now = frame_positions(batch.robot_tables.tool_chain, batch.env_robot_index, batch.q)
        farthest = max(farthest, float((now - start).norm(dim=1).max()))
    return 1000 * farthest


if __name__ == "__main__":
    sys.exit(main())

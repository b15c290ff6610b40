"""The batches of environments of a training: one for all of it, or one after another.

A source with more drawn robots than environments is trained on in slices: each has the next robots
of an endless sequence of random orders of all of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from morphgen.benchmark.token_layout import require_max_links
from morphgen.model.kinematics import driving_joints
from morphgen.model.robot import TOOL, Robot
from morphgen.processes import Progress, no_progress
from morphgen.rl.drawn_robots import DrawnRobots, draw, num_drawn
from morphgen.rl.robot_source import specs_of
from morphgen.rl.runs import RunConfig
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.device import batch_device
from morphgen.tasks.env_specs import GoalConfig
from morphgen.tasks.make import batch_from_specs
from morphgen.tasks.registry import TASKS

SLICE_STEPS = 600
"""Default time that a slice of the robots is trained on [control steps per environment]: two
episodes. A new slice cuts running episodes short, and building its environments takes time."""


def default_slice_updates(config: RunConfig) -> int:
    """Return the default of ``RunConfig.slice_updates``: 0 if all drawn robots fit at once.

    In a short run it is lower than ``SLICE_STEPS``, so that every robot is trained on.
    """
    slices = num_slices(config)
    if slices <= 1:
        return 0
    return max(min(-(-SLICE_STEPS // config.ppo.num_steps), config.num_updates // slices), 1)


def num_slices(config: RunConfig) -> int:
    """Return the number of slices with which every drawn robot has been trained on."""
    return -(-num_drawn(config.source) // config.num_envs)


def slice_of(num_robots: int, size: int, number: int, seed: int) -> list[int]:
    """Return the indices of the robots in a slice.

    Args:
        num_robots: Number of robots of the source.
        size: Robots per slice, at most ``num_robots``.
        number: Number of the slice, from 0.
        seed: Seed of the order.
    """
    first, last = number * size, (number + 1) * size - 1
    passes = range(first // num_robots, last // num_robots + 1)
    order = np.concatenate(
        [np.random.default_rng([seed, i]).permutation(num_robots) for i in passes]
    )
    start = first - passes[0] * num_robots
    robots: list[int] = order[start : start + size].tolist()
    return robots


def num_actuated(robot: Robot, task: str) -> int:
    """Return the number of joints that actions move."""
    if TASKS[task].moves_fingers:
        return robot.dof
    return len(driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link)))


class TrainingBatches:
    """Makes the batches of a run; batches and their seeds depend on the config only.

    Attributes:
        drawn: The robots drawn from grammars; None for other sources.
        most_links: Number of links of the largest robot.
        tasks: Names of the tasks of all robots.
    """

    def __init__(
        self,
        config: RunConfig,
        *,
        envs: range | None = None,
        device: str | None = None,
        workers: int = 1,
        progress: Progress = no_progress,
    ) -> None:
        """Build the robots and their goal sets.

        Args:
            config: Config of the run.
            envs: Numbers of the environments of this process; by default all.
            device: Device of this process; by default that of the config.
            workers: Number of processes of PyBullet, or of threads of MuJoCo.
            progress: Called with the number of robots whose goal set is ready, and their total.

        Raises:
            BenchmarkError: If a robot has more links than the config's ``max_links``.
            MorphgenError: If a robot cannot be built or cannot do its task.
        """
        self._config, self._workers = config, workers
        self._envs = range(config.num_envs) if envs is None else envs
        self._device = batch_device(config.sim, device or config.device)
        goals = GoalConfig(tasks=config.tasks)
        self._batch: TaskBatch | None = None
        self.drawn: DrawnRobots | None = None
        if config.source.grammars:
            self.drawn = draw(config.source, goals, progress=progress)
        self._specs = self.drawn.specs if self.drawn else specs_of(config.source, goals, progress)
        for spec in self._specs:
            links = len(spec.robot.links)
            require_max_links(links, f"robot {spec.robot.name!r}", config.max_links)
        self.most_links = max(len(spec.robot.links) for spec in self._specs)
        self.tasks = {spec.task for spec in self._specs}
        self._channels = config.interface.channels
        if config.slice_updates:
            joints = max(num_actuated(spec.robot, spec.task) for spec in self._specs)
            self._channels = replace(self._channels, tree_joints=joints)

    def make(self, update: int) -> TaskBatch:
        """Return a new batch, with which the run continues after so many updates.

        The last batch is closed.

        Raises:
            SimulationError: If the simulator cannot hold a scene.
            MissingDependencyError: If the simulator is not installed.
        """
        self.close()
        config, interface = self._config, self._config.interface
        robots, seed = self._robots_at(update), config.seed
        if config.slice_updates:
            seeds = np.random.SeedSequence([config.seed, update // config.slice_updates])
            seed = int(seeds.generate_state(1)[0])
        self._batch = batch_from_specs(
            [self._specs[i] for i in robots],
            len(self._envs),
            first=self._envs.start,
            sim=config.sim,
            seed=seed,
            kind=interface.kind,
            observe=self._channels,
            workers=self._workers,
            max_links=config.max_links,
            device=self._device,
            geometry=config.geometry,
            library=map(Path, config.source.library),
        )
        return self._batch

    def close(self) -> None:
        """Close the last batch."""
        if self._batch is not None:
            self._batch.close()
        self._batch = None

    def changes_at(self, update: int) -> bool:
        """Return whether a run continues with another batch after so many updates."""
        every = self._config.slice_updates
        return bool(every) and update % every == 0 and update < self._config.num_updates

    def recorded_scores(self, scores: Sequence[float], update: int) -> tuple[float, ...]:
        """Return the scores to record after an update: those of robots, or means of grammars.

        Thousands of drawn robots would fill the records, and a slice has others than the last.

        Args:
            scores: Mean score of each robot of the batch.
            update: Number of updates so far, the one of the scores included.
        """
        if self.drawn is None:
            return tuple(scores)
        grammars = [member.category for member in self.drawn.members]
        by_grammar: dict[str, list[float]] = {name: [] for name in grammars}
        for robot, score in zip(self._robots_at(update - 1), scores, strict=True):
            by_grammar[grammars[robot]].append(score)
        return tuple(
            float(np.mean(values)) if values else math.nan for values in by_grammar.values()
        )

    def _robots_at(self, update: int) -> list[int]:
        """Return the indices of the robots that are trained on after so many updates."""
        config = self._config
        if not config.slice_updates:
            return list(range(len(self._specs)))
        number = update // config.slice_updates
        return slice_of(len(self._specs), config.num_envs, number, config.seed)

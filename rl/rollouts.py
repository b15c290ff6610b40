"""Run a controller in a batch of environments, and record the results of its episodes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch

from morphgen.processes import one_torch_thread
from morphgen.progress import report
from morphgen.tasks.batch import Step, TaskBatch
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import CONTROL_PERIOD, is_host

STEPS_UNREAD = 32  # number of control steps after which the results on a GPU are read


class Controller(Protocol):
    """Source of actions for a batch: a baseline, or a policy (``inference.PolicyController``)."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions of all environments, shape (n, L)."""


@dataclass(frozen=True)
class Episode:
    """Result of an episode."""

    env: int  # index of the environment
    robot_index: int  # index of the robot
    success: bool  # whether the episode ended in success
    distance: float  # distance from success at the end [m]
    score: float  # score of the episode; see `episode_score`
    steps: int  # length of the episode [control steps]
    unstable: bool  # whether the episode ended because the simulation diverged
    angle: float = math.nan
    """Angle from success at the end [rad]; nan if the task wants no orientation."""

    @property
    def seconds(self) -> float:
        """Length of the episode [s of simulated time]."""
        return self.steps * CONTROL_PERIOD


@one_torch_thread()
def run_episodes(batch: TaskBatch, controller: Controller, count: int) -> list[Episode]:
    """Return the first ``count`` episodes of every environment, by environment and then by time."""
    batch.reset()
    n = batch.num_envs
    results = _Results(n, count, batch.device)
    on_host = is_host(batch.device)
    num_steps = 0
    while True:
        step = batch.step(controller.act(batch))
        results.add(step)
        num_steps += 1
        if on_host or num_steps % STEPS_UNREAD == 0:
            is_running = results.finished < count
            fractions = (results.steps / batch.max_episode_steps)[is_running]
            done = results.finished.clamp(max=count).sum() + fractions.sum()
            report(float(done), count * n)
            if not is_running.any():
                return results.episodes(batch)


class _Results:
    """Results of the first episodes of every environment, on the device of the batch.

    ``finished`` is the number of episodes that ended, ``steps`` that of the control steps of the
    running ones, both (n,), int64.
    """

    def __init__(self, n: int, count: int, device: torch.device) -> None:
        """Prepare to record ``count`` episodes of each of n environments."""
        self.finished, self.steps = torch.zeros(2, n, dtype=torch.int64, device=device)
        self._total = torch.zeros(n, device=device)
        # Success, distance, total and last score, steps, divergence and angle of each episode.
        self._numbers = torch.zeros(n, count, 7, dtype=torch.float64, device=device)
        self._rows = torch.arange(n, device=device)

    def add(self, step: Step) -> None:
        """Record a step, and the episodes that ended in it."""
        self._total += step.score
        self.steps += 1
        ended = step.terminated | step.truncated
        if is_host(ended.device) and not ended.any():
            return
        angle = torch.full_like(step.score, math.nan) if step.angle is None else step.angle
        scores = (self._total, step.score)
        values = (step.success, step.distance, *scores, self.steps, step.diverged, angle)
        numbers = torch.stack([value.double() for value in values], dim=1)
        count = self._numbers.shape[1]
        column = self.finished.clamp(max=count - 1)
        # Without a boolean index, which would wait for a GPU.
        is_new = (ended & (self.finished < count))[:, None]
        old = self._numbers[self._rows, column]
        self._numbers[self._rows, column] = torch.where(is_new, numbers, old)
        self.finished += ended
        self._total.masked_fill_(ended, 0)
        self.steps.masked_fill_(ended, 0)

    def episodes(self, batch: TaskBatch) -> list[Episode]:
        """Return the episodes, ordered by environment and then by time."""
        episodes = []
        numbers = self._numbers.tolist()  # at once: each read of a GPU waits for it
        for env, robot in enumerate(batch.env_robot_index.tolist()):
            task = TASKS[batch.specs[robot].task]
            for success, distance, total, last, steps, diverged, angle in numbers[env]:
                score = task.episode_score(total, last, int(steps))
                facts = bool(success), distance, score, int(steps), bool(diverged), angle
                episodes.append(Episode(env, robot, *facts))
        return episodes

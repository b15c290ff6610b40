"""Run a controller in a batch of environments, and record the results of its episodes."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch

from morphgen.processes import one_torch_thread
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.registry import TASKS
from morphgen.tasks.sim.base import CONTROL_PERIOD


class Controller(Protocol):
    """Source of actions for a batch: a baseline, or a policy (``inference.PolicyController``)."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Return actions of all environments, shape (n, L)."""


@dataclass(frozen=True)
class Episode:
    """Result of an episode."""

    env: int
    """Index of the environment."""
    robot_index: int
    """Index of the robot."""
    success: bool
    """Whether the episode ended in success."""
    distance: float
    """Distance from success at the end [m]."""
    score: float
    """Score of the episode; see ``episode_score``."""
    steps: int
    """Length of the episode [control steps]."""
    unstable: bool
    """Whether the episode ended because the simulation diverged."""
    angle: float = math.nan
    """Angle from success at the end [rad]; nan if the task wants no orientation."""

    @property
    def seconds(self) -> float:
        """Length of the episode [s of simulated time]."""
        return self.steps * CONTROL_PERIOD


@one_torch_thread()
def run_episodes(
    batch: TaskBatch,
    controller: Controller,
    count: int,
    progress: Callable[[float], None] = lambda done: None,
) -> list[Episode]:
    """Return the first episodes of every environment, the same number of each.

    Args:
        batch: Environments; they are reset first.
        controller: The controller.
        count: Episodes per environment.
        progress: Called after every step with the number of episodes done; running ones count as
            fractions.

    Returns:
        Episodes, ordered by environment and then by time.

    Raises:
        SimulationError: If the simulator fails.
    """
    batch.reset()
    n = batch.num_envs
    episodes: list[list[Episode]] = [[] for _ in range(n)]
    robot_indices = batch.env_robot_index.tolist()
    total = torch.zeros(n, device=batch.device)
    steps = torch.zeros(n, dtype=torch.int64, device=batch.device)
    done = 0
    left = torch.full_like(steps, count)
    while done < n * count:
        step = batch.step(controller.act(batch))
        total += step.score
        steps += 1
        ended = torch.nonzero(step.terminated | step.truncated)[:, 0]
        left[ended] -= 1
        for env in ended.tolist():
            if len(episodes[env]) < count:
                numbers = float(total[env]), float(step.score[env]), int(steps[env])
                episodes[env].append(
                    Episode(
                        env,
                        robot_indices[env],
                        bool(step.success[env]),
                        float(step.distance[env]),
                        TASKS[batch.specs[robot_indices[env]].task].episode_score(*numbers),
                        int(steps[env]),
                        bool(step.diverged[env]),
                        math.nan if step.angle is None else float(step.angle[env]),
                    )
                )
                done += 1
        total[ended], steps[ended] = 0, 0
        progress(done + float((steps / batch.max_episode_steps)[left > 0].sum()))
    return [episode for env_episodes in episodes for episode in env_episodes]

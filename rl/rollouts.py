"""Episodes of a controller in a batch, one line each."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch

from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.config import CONTROL_PERIOD
from morphgen.tasks.registry import TASKS


class Controller(Protocol):
    """What acts."""

    def act(self, task: TaskBatch) -> torch.Tensor:
        """Actions of all environments, shape (n, L)."""


@dataclass(frozen=True)
class Episode:
    """How an episode went."""

    env: int
    body: int
    """Index of the robot."""
    success: bool
    """At its end."""
    distance: float
    """From success then, metres; see ``Step``."""
    score: float
    """See ``Task.episode_score``."""
    steps: int
    unstable: bool
    """Whether it ended because the simulation became unstable; see ``Step``."""

    @property
    def seconds(self) -> float:
        """How long it was, simulated."""
        return self.steps * CONTROL_PERIOD


def run_episodes(
    batch: TaskBatch,
    controller: Controller,
    count: int,
    progress: Callable[[float], None] = lambda done: None,
) -> list[Episode]:
    """The first episodes of every environment, as many of each.

    Args:
        batch: Environments; they are reset first.
        controller: What acts.
        count: Episodes of each environment.
        progress: Told after every step how many episodes are over, parts of them included.

    Returns:
        By environment, and then in their order.

    Raises:
        SimulationError: If the simulator fails.
    """
    batch.reset()
    n = batch.num_envs
    found: list[list[Episode]] = [[] for _ in range(n)]
    bodies = batch.body.tolist()
    total = torch.zeros(n, device=batch.device)
    steps = torch.zeros(n, dtype=torch.int64, device=batch.device)
    done = 0
    left = torch.full_like(steps, count)
    while done < n * count:
        step = batch.step(controller.act(batch))
        total += step.score
        steps += 1
        over = torch.nonzero(step.terminated | step.truncated)[:, 0]
        left[over] -= 1
        for env in over.tolist():
            if len(found[env]) < count:
                numbers = float(total[env]), float(step.score[env]), int(steps[env])
                found[env].append(
                    Episode(
                        env,
                        bodies[env],
                        bool(step.success[env]),
                        float(step.distance[env]),
                        TASKS[batch.specs[bodies[env]].task].episode_score(*numbers),
                        int(steps[env]),
                        bool(step.unstable[env]),
                    )
                )
                done += 1
        total[over], steps[over] = 0, 0
        progress(done + float((steps / batch.longest)[left > 0].sum()))
    return [episode for own in found for episode in own]

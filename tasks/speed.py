"""Speed of a batch."""

from __future__ import annotations

import time
from collections.abc import Callable

import torch

from morphgen.processes import one_torch_thread
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.sim.base import is_host

WARM_UP = 20  # number of control steps before the measurement
SEED = 0  # seed of episodes and actions


def random_actions(batch: TaskBatch, count: int, seed: int) -> list[torch.Tensor]:
    """Return uniformly random actions, shape (n, L) each."""
    generator = torch.Generator().manual_seed(seed)
    shape = (count, *batch.action_mask.shape)
    if batch.action_kind == "discrete":
        drawn = torch.randint(len(BINS), shape, generator=generator)
    else:
        drawn = 2 * torch.rand(shape, generator=generator) - 1
    return list(drawn.to(batch.device).unbind(0))


@one_torch_thread()
def measure_speed(
    batch: TaskBatch,
    seconds: float,
    *,
    clock: Callable[[], float] | None = None,
) -> float:
    """Return the control steps per second of all environments under random actions, with resets.

    The measurement covers whole episodes: the cost of contacts depends on the time since they
    began, and a faster simulator would otherwise get further into them. One seed gives
    all simulators the same episodes, since some cost a tenth more than others.

    seconds: Least duration [s]; an episode that began is finished.
    clock: By default one [s] that waits for a GPU, whose work ends after the call.
    """
    if clock is None:
        clock = time.perf_counter if is_host(batch.device) else _time_on_gpu
    episode = int(batch.max_episode_steps.max())
    actions = random_actions(batch, episode, SEED)
    batch.reset()
    for action in actions[:WARM_UP]:
        batch.step(action)
    batch.reset(SEED)  # after the warm-up, for the same episodes in all simulators
    steps = 0
    start = clock()
    while steps % episode or clock() - start < seconds:  # whole episodes
        batch.step(actions[steps % episode])
        steps += 1
    return steps * batch.num_envs / (clock() - start)


def _time_on_gpu() -> float:
    """Return the time when the GPU has done all work so far [s]."""
    torch.cuda.synchronize()
    return time.perf_counter()

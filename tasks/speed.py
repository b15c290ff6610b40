"""Speed of a batch, and where its time goes."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any

import torch

from morphgen.processes import one_torch_thread
from morphgen.tasks.actions import BINS
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.sim.base import SUBSTEPS, is_host

WARM_UP = 20  # number of control steps before the measurement


@dataclass(frozen=True)
class Speed:
    """Speed of a batch under random actions."""

    steps_per_second: float
    """Control steps per second of all environments together, resets included."""
    shares: dict[str, float]  # fractions of the time by activity; they add up to 1

    @property
    def substeps_per_second(self) -> float:
        """Physics steps per second of all environments together."""
        return self.steps_per_second * SUBSTEPS


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
    seed: int = 0,
    own: Sequence[tuple[Any, str]] = (),
    clock: Callable[[], float] | None = None,
) -> Speed:
    """Measure the speed of a batch under random actions.

    The measurement covers whole episodes: the cost of contacts depends on the time since they
    began, and a faster simulator would otherwise get further into them. The seed gives all
    simulators the same episodes, since some cost a tenth more than others.

    seconds: Least duration [s]; an episode that began is finished.
    own: Objects and names of the simulator's native functions, whose time is counted apart.
    clock: By default one [s] that waits for a GPU, whose work ends after the call.
    """
    if clock is None:
        clock = time.perf_counter if is_host(batch.device) else _time_on_gpu
    spent: dict[str, float] = {}
    parts: dict[str, list[tuple[Any, str]]] = {
        "actions": [(batch, "act")],
        "rewards": [(batch, "_evaluate")],
        "observation": [(batch, "_observe")],
        "new episodes": [(batch, "_begin")],
        "around the simulator": [(batch.simulation, "step")],
        "simulator": list(own),
    }
    episode = int(batch.max_episode_steps.max())
    actions = random_actions(batch, episode, seed)
    batch.reset()
    for action in actions[:WARM_UP]:
        batch.step(action)
    batch.reset(seed)  # after the warm-up, for the same episodes in all simulators
    steps = 0
    with ExitStack() as stack:
        for part, functions in parts.items():
            for owner, name in functions:
                stack.enter_context(_timed(owner, name, part, spent, clock))
        start = clock()
        while steps % episode or clock() - start < seconds:  # whole episodes
            batch.step(actions[steps % episode])
            steps += 1
        total = clock() - start
    shares = {part: spent.get(part, 0.0) / total for part in parts}
    shares["around the simulator"] -= shares["simulator"]  # its time includes the native step
    shares["rest"] = 1 - sum(shares.values())
    if not own:
        shares["simulator"] = shares.pop("around the simulator")
    return Speed(steps * batch.num_envs / total, shares)


def _time_on_gpu() -> float:
    """Return the time when the GPU has done all work so far [s]."""
    torch.cuda.synchronize()
    return time.perf_counter()


@contextmanager
def _timed(
    owner: Any,  # noqa: ANN401 - a module or any object
    name: str,
    part: str,
    spent: dict[str, float],
    clock: Callable[[], float],
) -> Iterator[None]:
    """Add up the time that is spent in a function within this context."""
    inner = getattr(owner, name)
    shadowed = name in vars(owner)

    def timed(*args: object, **kwargs: object) -> object:
        start = clock()
        try:
            return inner(*args, **kwargs)
        finally:
            spent[part] = spent.get(part, 0.0) + clock() - start

    setattr(owner, name, timed)
    try:
        yield
    finally:
        if shadowed:
            setattr(owner, name, inner)
        else:
            delattr(owner, name)

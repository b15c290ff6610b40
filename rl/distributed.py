"""Training by several processes of one machine, each with a GPU and its share of environments.

``torchrun`` starts the processes. Each collects rollouts in its own environments. Gradients are
averaged before every step of the optimiser, so that all processes keep the same weights; process 0
alone writes files. The metrics of an update, which are those of all processes, stand here, too.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib import import_module
from typing import TypeVar

import torch
from torch import distributed

from morphgen.errors import TaskError


@dataclass(frozen=True, kw_only=True)
class UpdateMetrics:
    """Metrics of one update; means over its transitions unless said otherwise.

    Those with a default need environments: cloning has none.
    """

    update: int  # number of updates so far, this one included
    transitions: int  # control steps of all environments so far
    reward: float  # mean reward of a control step
    score: float = math.nan  # mean task score of a control step
    scores: tuple[float, ...] = ()
    """Mean score of each robot, or of the robots of each grammar if they are drawn; nan for one
    without an environment."""
    success: float = math.nan
    """Share of successes among the episodes that ended in the rollout; nan if none did."""
    episodes: int = 0  # number of episodes that ended in the rollout
    unstable: int = 0  # number of episodes that ended because the simulation diverged
    terms: dict[str, float] = field(default_factory=dict)  # mean of each reward term
    policy_loss: float  # clipped policy loss
    value_loss: float  # half the squared error, or `matching_loss` if the critic predicts symlogs
    entropy: float  # entropy of a robot's actions, or mean of its joints' [nats]
    kl: float = math.nan
    """Divergence of the updated policy from the one that acted [nats] (Schulman 2020, k3)."""
    clip_fraction: float = math.nan  # share of the probability ratios outside of the clip range
    actor_gradient: float  # norm of the actor's gradient before clipping
    critic_gradient: float  # norm of the critic's gradient before clipping
    explained_variance: float
    """Share of the returns' variance that the values before the update explain."""
    learning_rate: float  # learning rate of the actor
    collect_seconds: float = 0.0  # time to collect the rollout [s]
    learn_seconds: float  # time to learn from it [s]
    steps_per_second: float  # transitions per second, collection and learning together


T = TypeVar("T")


@dataclass(frozen=True)
class ProcessGroup:
    """The processes of a training run; one process alone is a group, too."""

    rank: int = 0  # number of this process
    size: int = 1  # number of processes

    @property
    def is_first(self) -> bool:
        """Whether this process writes the files."""
        return self.rank == 0

    def share(self, count: int, what: str) -> range:
        """Return the part of ``count`` things that belongs to this process."""
        if count % self.size:
            raise TaskError(f"{what} {count}: expected a multiple of the {self.size} processes")
        part = count // self.size
        return range(self.rank * part, (self.rank + 1) * part)

    def sum(self, values: torch.Tensor) -> torch.Tensor:
        """Return the sum over the processes of a tensor that has one shape in all of them."""
        if self.size > 1:
            values = values.clone()
            distributed.all_reduce(values)
        return values

    def average_gradients(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Set gradients to their means over the processes."""
        if self.size == 1:
            return
        gradients = [p.grad for p in parameters if p.grad is not None]
        flat = self.sum(torch.cat([gradient.flatten() for gradient in gradients])) / self.size
        parts = torch.split(flat, [gradient.numel() for gradient in gradients])
        for gradient, part in zip(gradients, parts, strict=True):
            gradient.copy_(part.view_as(gradient))

    def collect(self, values: torch.Tensor) -> list[torch.Tensor]:
        """Return the tensors of all processes, which have one shape, in the processes' order."""
        if self.size == 1:
            return [values]
        collected = [torch.empty_like(values) for _ in range(self.size)]
        distributed.all_gather(collected, values)
        return collected

    def joined(self, values: torch.Tensor) -> torch.Tensor:
        """Return the tensors of all processes, in main memory, joined along their first axis."""
        return values if self.size == 1 else torch.cat(self.gather(values.cpu()))

    def gather(self, value: T) -> list[T]:
        """Return the values of all processes, in their order.

        The values are pickled between the processes of this run.
        """
        if self.size == 1:
            return [value]
        values: list[T | None] = [None] * self.size
        distributed.all_gather_object(values, value)
        return values  # type: ignore[return-value]  # every process has put its value


ALONE = ProcessGroup()


@contextmanager
def process_group(device: str) -> Iterator[tuple[ProcessGroup, str]]:
    """Join the processes that ``torchrun`` started, and leave them at the end.

    Yields:
        The group, and the device of this process: ``cuda:1`` for the second one on a machine.
    """
    size, rank = int(os.environ.get("WORLD_SIZE", "1")), int(os.environ.get("RANK", "0"))
    if size == 1:
        yield ALONE, device
        return
    kind, _, number = device.partition(":")
    if number:
        raise TaskError(f"--device {device} with {size} processes: expected --device {kind}")
    local = int(os.environ.get("LOCAL_RANK", "0"))
    if kind == "cuda":
        if local >= torch.cuda.device_count():
            raise TaskError(
                f"process {local} of this machine, which has {torch.cuda.device_count()} CUDA "
                "devices; start at most one process for each"
            )
        device = f"cuda:{local}"
        torch.cuda.set_device(local)
    # Optimisers import this module. If a group exists by then, the module keeps it for ever, and
    # the group's threads abort the process now and then when it ends (torch 2.13).
    import_module("torch._dynamo")
    distributed.init_process_group("nccl" if kind == "cuda" else "gloo")
    try:
        yield ProcessGroup(rank, size), device
    finally:
        distributed.destroy_process_group()

"""Make the robots of a set in several processes, or on a Ray cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from types import ModuleType
from typing import Any

from morphgen.errors import MorphgenError
from morphgen.grammar.robot_set import Record, RobotMaker, SetConfig, SetWorker
from morphgen.processes import CHUNK_SIZE, parallel_map, ray_cluster, require_ray


def make_in_processes(jobs: int) -> SetWorker:
    """Work in ``jobs`` processes of this machine."""

    def work(plan: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
        return parallel_map(_Making(plan), indices, jobs)

    return work


class _Making:
    """Makes robots of a plan; each process opens its parts once."""

    def __init__(self, plan: SetConfig) -> None:
        self._plan = plan

    @cached_property
    def _maker(self) -> RobotMaker:
        return RobotMaker(self._plan)

    def __call__(self, index: int) -> Record:
        return self._maker.make(index)


def make_on_ray(address: str | None) -> SetWorker:
    """Work on the Ray cluster at an address; without one, on a local Ray.

    Its machines have morphgen installed and share the set's folder.

    Raises:
        MissingDependencyError: If ray is not installed.
    """
    ray = require_ray()

    def work(plan: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
        if not indices:
            return
        try:
            with ray_cluster(address):
                yield from _spread(ray, replace(plan, folder=plan.folder.resolve()), indices)
        except ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, MorphgenError) else error from None
        except ray.exceptions.RayError as error:
            raise MorphgenError(
                f"a Ray worker died ({error}); what is done is kept: run again"
            ) from error

    return work


def _spread(ray: ModuleType, plan: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
    """A maker on every CPU, each given a chunk whenever it is free."""
    chunks = deque(indices[i : i + CHUNK_SIZE] for i in range(0, len(indices), CHUNK_SIZE))
    cpus = max(int(ray.cluster_resources().get("CPU", 1)), 1)
    remote = ray.remote(num_cpus=1)(RobotMaker)
    free = deque(remote.remote(plan) for _ in range(min(cpus, len(chunks))))
    running: dict[Any, Any] = {}
    while chunks or running:
        while chunks and free:
            maker = free.popleft()
            running[maker.make_all.remote(list(chunks.popleft()))] = maker
        (done, *_), _ = ray.wait(list(running))
        free.append(running.pop(done))
        yield from ray.get(done)

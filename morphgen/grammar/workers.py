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
    """Return a worker that makes robots in ``jobs`` processes of this machine."""

    def work(config: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
        return parallel_map(_LazyMaker(config), indices, jobs)

    return work


class _LazyMaker:
    """Makes robots of a set; it is sent to processes, which each load the parts once."""

    def __init__(self, config: SetConfig) -> None:
        self._config = config

    @cached_property
    def _maker(self) -> RobotMaker:
        return RobotMaker(self._config)

    def __call__(self, index: int) -> Record:
        return self._maker.make(index)


def make_on_ray(address: str | None) -> SetWorker:
    """Return a worker that makes robots on the Ray cluster at an address, or on a local Ray.

    The machines of the cluster need morphgen and share the set's folder.

    Raises:
        MissingDependencyError: If ray is not installed.
    """
    ray = require_ray()

    def work(config: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
        if not indices:
            return
        try:
            with ray_cluster(address):
                absolute = replace(config, folder=config.folder.resolve())
                yield from _distribute(ray, absolute, indices)
        except ray.exceptions.RayTaskError as error:
            raise error.cause if isinstance(error.cause, MorphgenError) else error from None
        except ray.exceptions.RayError as error:
            raise MorphgenError(
                f"a Ray worker died ({error}); finished robots are kept: run again"
            ) from error

    return work


def _distribute(ray: ModuleType, config: SetConfig, indices: Sequence[int]) -> Iterator[Record]:
    """Start a maker on every CPU, and give each the next chunk when it is free."""
    chunks = deque(indices[i : i + CHUNK_SIZE] for i in range(0, len(indices), CHUNK_SIZE))
    cpus = max(int(ray.cluster_resources().get("CPU", 1)), 1)
    remote = ray.remote(num_cpus=1)(RobotMaker)
    free = deque(remote.remote(config) for _ in range(min(cpus, len(chunks))))
    running: dict[Any, Any] = {}
    while chunks or running:
        while chunks and free:
            maker = free.popleft()
            running[maker.make_all.remote(list(chunks.popleft()))] = maker
        (done, *_), _ = ray.wait(list(running))
        free.append(running.pop(done))
        yield from ray.get(done)

"""Make the robots of a set on a Ray cluster."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import replace
from types import ModuleType
from typing import Any

from morphgen.errors import MorphgenError
from morphgen.grammar.robot_set import Maker, Record, SetPlan, Work
from morphgen.processes import CHUNK, ray_cluster, require_ray


def make_on_ray(address: str | None) -> Work:
    """Work on the Ray cluster at an address; without one, on a local Ray.

    Its machines have morphgen installed and share the set's folder.

    Raises:
        MissingDependencyError: If ray is not installed.
    """
    ray = require_ray()

    def work(plan: SetPlan, indices: Sequence[int]) -> Iterator[Record]:
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


def _spread(ray: ModuleType, plan: SetPlan, indices: Sequence[int]) -> Iterator[Record]:
    """A maker on every CPU, each given a chunk whenever it is free."""
    chunks = deque(indices[i : i + CHUNK] for i in range(0, len(indices), CHUNK))
    cpus = max(int(ray.cluster_resources().get("CPU", 1)), 1)
    remote = ray.remote(num_cpus=1)(Maker)
    free = deque(remote.remote(plan) for _ in range(min(cpus, len(chunks))))
    running: dict[Any, Any] = {}
    while chunks or running:
        while chunks and free:
            maker = free.popleft()
            running[maker.make_all.remote(list(chunks.popleft()))] = maker
        (done, *_), _ = ray.wait(list(running))
        free.append(running.pop(done))
        yield from ray.get(done)

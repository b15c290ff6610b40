"""Make the robots of a set in several processes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property

from morphgen.grammar.robot_set import Maker, Record, SetPlan, Work
from morphgen.processes import mapped


def make_in_processes(jobs: int) -> Work:
    """Work in ``jobs`` processes of this machine."""

    def work(plan: SetPlan, indices: Sequence[int]) -> Iterator[Record]:
        return mapped(_Making(plan), indices, jobs)

    return work


class _Making:
    """Makes robots of a plan; each process opens its parts once."""

    def __init__(self, plan: SetPlan) -> None:
        self._plan = plan

    @cached_property
    def _maker(self) -> Maker:
        return Maker(self._plan)

    def __call__(self, index: int) -> Record:
        return self._maker.make(index)

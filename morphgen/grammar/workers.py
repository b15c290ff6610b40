"""Make the robots of a set in several processes."""

from __future__ import annotations

import itertools
import os
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from multiprocessing import get_context, parent_process
from threading import Thread

from morphgen.errors import MorphgenError
from morphgen.grammar.robot_set import Maker, Record, SetPlan, Work

CHUNK = 8
"""Robots that a worker makes before it reports."""

_maker: Maker | None = None


def make_in_processes(jobs: int) -> Work:
    """Work in ``jobs`` processes of this machine."""

    def work(plan: SetPlan, indices: Sequence[int]) -> Iterator[Record]:
        pool = ProcessPoolExecutor(jobs, get_context("spawn"), _start, (plan,))
        chunks = iter([indices[i : i + CHUNK] for i in range(0, len(indices), CHUNK)])
        try:
            running = {pool.submit(_make, chunk) for chunk in itertools.islice(chunks, 2 * jobs)}
            while running:
                finished, running = wait(running, return_when=FIRST_COMPLETED)
                for future in finished:
                    yield from _records(future)
                    running |= {pool.submit(_make, c) for c in itertools.islice(chunks, 1)}
        finally:
            pool.shutdown(wait=True, cancel_futures=True)

    return work


def _records(future: Future[list[Record]]) -> list[Record]:
    try:
        return future.result()
    except MorphgenError:
        raise
    except (OSError, RuntimeError) as error:
        raise MorphgenError(
            f"a worker died ({error or type(error).__name__}); what is done is kept: run again"
        ) from error


def _start(plan: SetPlan) -> None:
    """Prepare a worker; Ctrl-C is for the parent, which lets it finish its chunk."""
    global _maker
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_parent, daemon=True).start()
    _maker = Maker(plan)


def _end_with_parent() -> None:
    """A killed parent tells its workers nothing, and they would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make(indices: Sequence[int]) -> list[Record]:
    if _maker is None:
        raise RuntimeError("the worker was not prepared")
    return _maker.make_all(indices)

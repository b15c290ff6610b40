"""Processes that draw, compare and write for all browsers; started again if one of them dies."""

from __future__ import annotations

import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TypeVar

from morphgen.errors import MorphgenError
from morphgen.processes import init_worker, sigint_blocked

T = TypeVar("T")


class WorkerDied(MorphgenError):  # noqa: N818
    """A worker died with what it did; there are others now."""


class Workers:
    """A pool of processes, replaced when one of them dies."""

    def __init__(self, n: int) -> None:
        """Prepare; processes start with the first work."""
        self._n = n
        self._lock = threading.Lock()
        self._pool = self._started()
        self._closed = False

    def submit(self, work: Callable[..., T], *arguments: object) -> Future[T]:
        """Have something done."""
        with self._lock, sigint_blocked():
            try:
                return self._pool.submit(work, *arguments)
            except BrokenProcessPool:
                self._replace()
                return self._pool.submit(work, *arguments)

    def result(self, future: Future[T]) -> T:
        """What a worker found.

        Raises:
            WorkerDied: If the worker did, or another one while this waited.
            MorphgenError: What the work raises.
        """
        try:
            return future.result()
        except BrokenProcessPool as error:
            raise WorkerDied(
                "a worker died, perhaps for want of memory; others were started: try again"
            ) from error

    def close(self) -> None:
        """End the processes; what waits is not done."""
        with self._lock:
            self._closed = True
            self._pool.shutdown(wait=False, cancel_futures=True)

    def _replace(self) -> None:
        if self._closed:
            return
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._pool = self._started()

    def _started(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self._n, get_context("spawn"), init_worker)

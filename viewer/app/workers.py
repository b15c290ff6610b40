"""A pool of worker processes that serves all browsers and replaces processes that die."""

from __future__ import annotations

import functools
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from ctypes import c_byte
from importlib import import_module
from multiprocessing import get_context
from typing import Any, TypeVar, cast

from morphgen.errors import MorphgenError
from morphgen.processes import call_in_worker, init_worker, sigint_blocked
from morphgen.progress import report

S = TypeVar("S")
T = TypeVar("T")


class WorkerDied(MorphgenError):  # noqa: N818
    """A worker process died; its pool has been replaced."""


class Workers:
    """A process pool that is replaced when one of its processes dies."""

    def __init__(self, n: int) -> None:
        """Prepare a pool of ``n`` processes; they start with the first work."""
        self._n = n
        self._lock = threading.Lock()
        self.is_used = False  # whether a call was ever submitted
        self._num_calls, self._ended = 0, time.monotonic()
        self._context = get_context("spawn")  # threads and OpenGL do not survive a fork
        self._stopped: c_byte = self._context.RawValue("b", 0)
        self._pool = self._new_pool()

    def submit(self, work: Callable[..., T], *arguments: object) -> Future[T]:
        """Queue a function call for a process."""
        with self._lock, sigint_blocked():
            try:
                future = self._pool.submit(call_in_worker, work, *arguments)
            except BrokenProcessPool:
                if not self._stopped.value:
                    self._pool.shutdown(wait=False, cancel_futures=True)
                    self._pool = self._new_pool()
                future = self._pool.submit(call_in_worker, work, *arguments)
            self.is_used = True
            self._num_calls += 1
        future.add_done_callback(self._note_end)
        return future

    def _note_end(self, _future: Future[Any]) -> None:
        with self._lock:
            self._num_calls -= 1
            self._ended = time.monotonic()

    @property
    def idle_time(self) -> float:
        """Time since the last call ended, or since the start; 0 while calls run or wait [s]."""
        with self._lock:
            return 0.0 if self._num_calls else time.monotonic() - self._ended

    def result(self, future: Future[T]) -> T:
        """Wait for the result of a call."""
        try:
            return future.result()
        except BrokenProcessPool as error:
            raise WorkerDied(
                "a worker process died, perhaps for lack of memory; others were started: try again"
            ) from error

    def call(self, work: Callable[..., T], *arguments: object) -> T:
        """Call a function in a process and return its result."""
        return self.result(self.submit(work, *arguments))

    def map(self, work: Callable[[S], T], items: Sequence[S]) -> Iterator[T]:
        """Call a function with every item; yield the results in order, and report how many."""
        futures = [self.submit(work, item) for item in items]
        report(0, len(items))
        try:
            for i, future in enumerate(futures, 1):
                result = self.result(future)
                report(i, len(items))
                yield result
        finally:  # also if the caller wants no more
            for future in futures:
                future.cancel()

    def close(self) -> None:
        """End the processes; calls that run or wait are dropped."""
        with self._lock:
            self._stopped.value = 1
            self._pool.shutdown(wait=False, cancel_futures=True)

    def _new_pool(self) -> ProcessPoolExecutor:
        return ProcessPoolExecutor(self._n, self._context, init_worker, (self._stopped,))


def named(path: str) -> Callable[..., Any]:
    """Return a function ``module:name`` for a worker, without importing its module here."""
    return functools.partial(_call_named, path)


def _call_named(path: str, *arguments: object) -> object:
    return load_function(path)(*arguments)


def load_function(path: str) -> Callable[..., Any]:
    """Import and return a function ``module:name``."""
    module, _, name = path.partition(":")
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function


MAX_RESULTS = 24  # results that are kept; a population of 1,000 robots takes tens of megabytes


class SharedResults:
    """The results that were used last, by their keys; safe to use from several threads."""

    def __init__(self, max_results: int = MAX_RESULTS) -> None:
        self._max = max_results
        self._results: OrderedDict[str, object] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, key: str, make: Callable[[], T]) -> T:
        """Return the result of a key."""
        with self._lock:
            if key in self._results:
                self._results.move_to_end(key)
                return cast(T, self._results[key])
        result = make()
        with self._lock:
            self._results[key] = result
            while len(self._results) > self._max:
                self._results.popitem(last=False)
        return result

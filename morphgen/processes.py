"""Do the same to many things, in one process or in several."""

from __future__ import annotations

import _thread
import itertools
import os
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from ctypes import c_byte
from multiprocessing import get_context, parent_process, resource_tracker
from types import ModuleType
from typing import Any, TypeVar

from morphgen.errors import MissingDependencyError, MorphgenError

T = TypeVar("T")
R = TypeVar("R")

Progress = Callable[[int, int], None]
"""Told how much is done, and of how much."""

CHUNK_SIZE = 8
"""Things that a worker does before it reports, unless told otherwise."""
POLL = 0.2
"""Seconds between a worker's looks at whether the parent has stopped."""
PATIENCE = 5.0
"""Seconds to wait for an answer from a Ray cluster's address; Ray itself waits for minutes."""

_work: Callable[[Any], object] | None = None
_stopped: c_byte | None = None
"""Whether the parent has stopped; in memory of all its processes."""
_is_working = False


def no_progress(done: int, total: int) -> None:
    """A progress that is shown to nobody."""


def parallel_map(
    work: Callable[[T], R],
    things: Sequence[T],
    jobs: int,
    progress: Progress = no_progress,
    chunk: int = CHUNK_SIZE,
) -> Iterator[R]:
    """Do work on every thing; results in the order of the things.

    Args:
        work: A function that can be pickled, with all that it needs; each process gets it once.
        things: What it is done to.
        jobs: Processes. No more are started than there is work for.
        progress: Told how many results there are, and how many there will be.
        chunk: Things that a process does before it reports; fewer where one takes long.

    Raises:
        MorphgenError: If ``jobs`` is below 1, what the work raises, or that a process died.
    """
    if jobs < 1:
        raise MorphgenError(f"{jobs} jobs: expected 1 or more")
    chunks = [things[i : i + chunk] for i in range(0, len(things), chunk)]
    jobs = min(jobs, len(chunks))
    results = map(work, things) if jobs <= 1 else _in_processes(work, chunks, jobs)
    for done, result in enumerate(results, 1):
        progress(done, len(things))
        yield result


def _in_processes(work: Callable[[T], R], chunks: Sequence[Sequence[T]], jobs: int) -> Iterator[R]:
    context = get_context("spawn")
    stopped = context.RawValue("b", 0)
    pool = ProcessPoolExecutor(jobs, context, _start, (work, stopped))
    waiting = iter(chunks)
    try:
        running = deque(_submitted(pool, itertools.islice(waiting, 2 * jobs)))
        while running:
            done: list[R] = _result(running.popleft())
            running.extend(_submitted(pool, itertools.islice(waiting, 1)))
            yield from done
    finally:
        stopped.value = 1
        pool.shutdown(wait=True, cancel_futures=True)


def _submitted(
    pool: ProcessPoolExecutor, chunks: Iterable[Sequence[Any]]
) -> list[Future[list[Any]]]:
    """Submit chunks, for which the pool may start processes."""
    with sigint_blocked():
        return [pool.submit(_do, chunk) for chunk in chunks]


def _result(future: Future[list[R]]) -> list[R]:
    try:
        return future.result()
    except BrokenProcessPool as error:
        raise MorphgenError(
            "a worker died, perhaps for want of memory; what is done is kept: run again, or with "
            "fewer jobs"
        ) from error


@contextmanager
def sigint_blocked() -> Iterator[None]:
    """Start processes in this block: Ctrl-C is not for them, from their first moment on.

    They inherit a mask that blocks it. For this process it counts at the end of the block; the mask
    alone would not do, as another thread may take the signal, which then interrupts this one.
    """
    noted: list[int] = []
    is_main = threading.current_thread() is threading.main_thread()
    handler = signal.getsignal(signal.SIGINT)
    if is_main:
        signal.signal(signal.SIGINT, lambda number, _: noted.append(number))
    try:
        resource_tracker.ensure_running()  # its start would end the mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
    finally:
        if is_main:
            signal.signal(signal.SIGINT, handler or signal.SIG_DFL)
        if noted:
            signal.raise_signal(signal.SIGINT)


def init_worker() -> None:
    """Prepare a worker: Ctrl-C is for the parent, and without it the worker ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _start(work: Callable[[Any], object], stopped: c_byte) -> None:
    """Prepare a worker, whose work is interrupted when the parent stops."""
    global _work, _stopped
    init_worker()
    _work, _stopped = work, stopped
    signal.signal(signal.SIGTERM, _interrupt)
    threading.Thread(target=_interrupt_when_stopped, daemon=True).start()


def _interrupt(*_: object) -> None:
    """Interrupt the work as Ctrl-C would, so that it tidies up; a worker that waits goes on."""
    if _is_working:
        raise KeyboardInterrupt


def _interrupt_when_stopped() -> None:
    """Wait until the parent has stopped: a fit may have minutes to go by then."""
    while _stopped is not None and not _stopped.value:
        time.sleep(POLL)
    _thread.interrupt_main(signal.SIGTERM)


def _end_with_parent() -> None:
    """A killed parent tells its workers nothing, and they would wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _do(things: Sequence[Any]) -> list[Any]:
    global _is_working
    if _work is None or _stopped is None:
        raise RuntimeError("the worker was not prepared")
    _is_working = True
    try:
        # Once the parent has stopped, nobody waits for the results.
        return [_work(thing) for thing in things if not _stopped.value]
    finally:
        _is_working = False


def require_ray() -> ModuleType:
    """The package ray.

    Raises:
        MissingDependencyError: If it is not installed.
    """
    try:
        import ray
    except ImportError as error:
        raise MissingDependencyError(
            "--ray needs the package ray: pip install 'morphgen[ray]'"
        ) from error
    module: ModuleType = ray
    return module


@contextmanager
def ray_cluster(address: str | None) -> Iterator[None]:
    """Be connected to the Ray cluster at an address; without one, to a local Ray.

    Raises:
        MorphgenError: If there is none.
    """
    ray = require_ray()
    own = not ray.is_initialized()
    host, _, port = (address or "").rpartition(":")
    try:
        if port.isdecimal():
            socket.create_connection((host.removeprefix("ray://"), int(port)), PATIENCE).close()
        ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
    except (OSError, OverflowError, RuntimeError, ValueError) as error:
        raise MorphgenError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        yield
    finally:
        if own:
            ray.shutdown()

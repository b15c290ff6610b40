"""Processes and threads: map a function over items in several processes, connect to Ray."""

from __future__ import annotations

import itertools
import os
import pickle
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing, contextmanager, suppress
from ctypes import c_byte
from multiprocessing import get_context, parent_process, resource_tracker
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from morphgen.errors import MissingDependencyError, MorphgenError, whole_number
from morphgen.progress import STOP_SIGNALS, raise_if_interrupted, report, show_progress

T = TypeVar("T")
R = TypeVar("R")

CHUNK_SIZE = 8  # default number of items that a worker processes before it reports
POLL_INTERVAL = 0.2
"""Interval at which workers check whether the parent has stopped, and the parent whether a signal
was received [s]."""
IDLE_TIME = 0.5
"""Time after which a worker ends that is idle though the parent has stopped [s]."""
CPU_LIMIT = Path("/sys/fs/cgroup/cpu.max")
"""File in which Linux tells a container how much of the cores it may use."""
RAY_TIMEOUT = 5.0  # longest wait for the address of a Ray cluster [s]; Ray itself waits for minutes

_work: Callable[[Any], object]
_stopped: c_byte | None = None
"""Flag that the parent has stopped, in memory that all its processes share."""
_is_working = False
_is_interruptible = False
"""Whether the work has not been interrupted yet; a second signal shall not end its cleaning up."""
_is_starting = False


def usable_cores() -> int:
    """Return the number of cores that this process may use, by its affinity and its cgroup."""
    has_affinity = hasattr(os, "sched_getaffinity")
    cores = len(os.sched_getaffinity(0)) if has_affinity else os.cpu_count() or 1
    with suppress(OSError, ValueError):  # no cgroups of version 2, or "max": no limit
        quota, period = map(int, CPU_LIMIT.read_text().split())
        cores = min(cores, -(-quota // period))
    return cores


def parallel_map(
    work: Callable[[T], R], items: Sequence[T], jobs: int, chunk: int = CHUNK_SIZE
) -> Iterator[R]:
    """Return an iterator over ``work(item)`` for every item, in order; it reports the progress."""
    jobs = whole_number("jobs", jobs, MorphgenError, 1)
    chunks = [items[i : i + chunk] for i in range(0, len(items), chunk)]
    jobs = min(jobs, len(chunks))
    results = (
        map(show_progress(None)(work), items)
        if jobs <= 1
        else _in_processes(work, chunks, jobs, lambda: 2 * jobs)  # a chunk waits for each worker
    )
    return _reporting(results, len(items))


@contextmanager
def parallel_stream(
    work: Callable[[T], R], items: Iterable[T], jobs: int, missing: Callable[[], int]
) -> Iterator[Iterator[R]]:
    """Yield an iterator over ``work(item)`` in order, of items that may never end.

    Workers are at most ``jobs`` items ahead of the least number that ``missing`` says is needed.
    """
    jobs = whole_number("jobs", jobs, MorphgenError, 1)
    if jobs == 1:
        yield map(work, items)
        return
    each_alone = ((item,) for item in items)
    with closing(_in_processes(work, each_alone, jobs, lambda: missing() + jobs)) as results:
        yield results


def _reporting(results: Iterable[R], total: int) -> Iterator[R]:
    for done, result in enumerate(results, 1):
        report(done, total)
        yield result


def _in_processes(
    work: Callable[[T], R], chunks: Iterable[Sequence[T]], jobs: int, ahead: Callable[[], int]
) -> Generator[R, None, None]:
    """Yield the results of chunks; ``ahead`` returns how many chunks should be submitted."""
    context = get_context("spawn")  # fork would copy the locks that threads of torch hold
    stopped = context.RawValue("b", 0)
    pool = ProcessPoolExecutor(jobs, context, _init_map_worker, (pickle.dumps(work), stopped))
    waiting = iter(chunks)
    try:
        running = deque(_submit(pool, itertools.islice(waiting, ahead())))
        while running:
            results: list[R] = _result(running.popleft())
            missing = max(ahead() - len(running), 0)
            running.extend(_submit(pool, itertools.islice(waiting, missing)))
            yield from results
    except BrokenProcessPool as error:
        raise MorphgenError(
            "a worker died, perhaps for lack of memory; finished results are kept: run again, or "
            "with fewer jobs"
        ) from error
    finally:
        stopped.value = 1
        pool.shutdown(wait=True, cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, chunks: Iterable[Sequence[Any]]) -> list[Future[list[Any]]]:
    with sigint_blocked():  # submitting may start processes
        return [pool.submit(_process_chunk, chunk) for chunk in chunks]


def _result(future: Future[R]) -> R:
    """Wait for a result; a signal ends the wait, whichever thread received it."""
    while True:
        raise_if_interrupted()
        with signals_deferred():
            if wait((future,), POLL_INTERVAL).done:
                return future.result()


@contextmanager
def signals_deferred() -> Iterator[None]:
    """Handle the signals that stop a command at the end of this block instead of within it.

    Their handlers raise ``KeyboardInterrupt``. Where that leaves a lock of a pool locked, as
    between its acquisition and the ``try`` that follows, the pool's own thread waits for ever.
    """
    received: list[int] = []
    handlers = {}
    if threading.current_thread() is threading.main_thread():  # Python calls handlers in it only
        handlers = {each: signal.getsignal(each) for each in (signal.SIGINT, *STOP_SIGNALS)}
    handlers = {each: handler for each, handler in handlers.items() if callable(handler)}
    for each in handlers:
        signal.signal(each, lambda number, _: received.append(number))
    try:
        yield
    finally:
        for each, handler in handlers.items():
            signal.signal(each, handler)
        for number in received:
            signal.raise_signal(number)


@contextmanager
def sigint_blocked() -> Iterator[None]:
    """Block Ctrl-C (SIGINT) in this block, so that processes started in it never receive it.

    They inherit the signal mask. This process handles a Ctrl-C at the end of the block, for which
    the mask alone is not enough: another thread may receive the signal, and Python then runs the
    handler in this one.
    """
    with signals_deferred():
        resource_tracker.ensure_running()  # starting it later would reset the mask
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def init_worker(stopped: c_byte) -> None:
    """Initialise a worker process, which ignores Ctrl-C and a closed terminal.

    It exits when its parent does, and stops work when that sets the shared ``stopped``.
    """
    global _stopped
    _stopped = stopped
    # Importing mujoco asks a process for the version of GLFW, which nothing here draws with: that
    # process prints a traceback where its parent, this one, ends meanwhile.
    os.environ.setdefault("MUJOCO_GL", "off")
    for each in (signal.SIGINT, *STOP_SIGNALS):
        signal.signal(each, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, _interrupt)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    threading.Thread(target=_interrupt_when_stopped, daemon=True).start()


def call_in_worker(work: Callable[..., R], *arguments: object) -> R:
    """Call a function in a worker process."""
    try:
        with _working() as is_needed:
            if is_needed():
                return work(*arguments)
    except KeyboardInterrupt:
        pass
    raise CancelledError


def _init_map_worker(work: bytes, stopped: c_byte) -> None:
    """Initialise a worker of ``parallel_map``, which ends if it is stopped meanwhile."""
    global _work, _is_starting
    _is_starting = True
    init_worker(stopped)
    _work = pickle.loads(work)  # imports what the work needs, which takes seconds
    _is_starting = False


def _interrupt(*_: object) -> None:
    """Interrupt the work as Ctrl-C would, so that it cleans up; an idle worker continues."""
    global _is_interruptible
    if _is_interruptible:
        _is_interruptible = False
        raise KeyboardInterrupt


def _interrupt_when_stopped() -> None:
    """Interrupt the work once the parent has stopped; a fit may still take minutes by then."""
    while _stopped is not None and not _stopped.value:
        time.sleep(POLL_INTERVAL)
    if _is_starting:  # an interrupted import would leave half of a package to what unpickles items
        os._exit(1)
    main = threading.main_thread().ident
    if main is not None:
        signal.pthread_kill(main, signal.SIGTERM)  # which also interrupts a system call
    # Where a worker has died, the pool of Python 3.12 only sends SIGTERM to the others, which idle
    # ones ignore, and waits for them.
    while True:
        time.sleep(IDLE_TIME)
        if not _is_working:
            os._exit(1)


def _end_with_parent() -> None:
    """Exit with the parent: if it is killed, its workers would otherwise wait for work for ever."""
    parent = parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)  # sys.exit would end this thread only


def _process_chunk(items: Sequence[Any]) -> list[Any]:
    with _working() as is_needed:
        return [_work(item) for item in items if is_needed()]


@contextmanager
def _working() -> Iterator[Callable[[], bool]]:
    """Let work in this block be interrupted; yield a function that says if it is needed."""
    global _is_working, _is_interruptible
    stopped = _stopped
    if stopped is None:
        raise RuntimeError("the worker was not initialised")
    _is_working = _is_interruptible = True
    try:
        yield lambda: not stopped.value
    finally:
        _is_working = _is_interruptible = False


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Run the networks and tensors of a block, or of a decorated function, in one thread.

    The order of a sum, and so its last bits, depend on the number of threads. Threads that wait for
    each other in small operations also slow a busy machine down, many times over.
    """
    import torch

    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def require_ray() -> ModuleType:
    """Import and return the package ray."""
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
    """Connect to the Ray cluster at an address, by default to a local one, in this block.

    An error of Ray that leaves the block becomes that of its task, or a ``MorphgenError``.
    """
    ray = require_ray()
    was_connected = ray.is_initialized()
    host, _, port = (address or "").rpartition(":")
    try:
        if port.isdecimal():  # Ray itself waits for minutes where nothing listens
            socket.create_connection((host.removeprefix("ray://"), int(port)), RAY_TIMEOUT).close()
        ray.init(address=address, ignore_reinit_error=True, log_to_driver=False)
    except (OSError, OverflowError, RuntimeError, ValueError) as error:
        raise MorphgenError(f"no Ray cluster at {address!r}: {error}") from error
    try:
        yield
    except ray.exceptions.RayTaskError as error:
        raise error.cause if isinstance(error.cause, MorphgenError) else error from None
    except ray.exceptions.RayError as error:
        why = f"a Ray worker died ({error}); finished results are kept: run again"
        raise MorphgenError(why) from error
    finally:
        if not was_connected:
            ray.shutdown()

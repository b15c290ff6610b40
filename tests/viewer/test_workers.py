"""Worker processes that die are replaced; their results are shared by all browsers."""

import os
import time
from concurrent.futures import CancelledError

import pytest

from helpers.worker_functions import die_later, power, sleep_from
from morphgen.viewer.app.workers import SharedResults, WorkerDied, Workers


@pytest.fixture
def workers():
    made = Workers(1)
    yield made
    made.close()


def test_dead_worker_is_reported_once_and_replaced(workers):
    value, first = workers.result(workers.submit(power, 2, 3))
    assert value == 9
    dying, waiting = workers.submit(die_later, 0.3), workers.submit(power, 2, 4)
    for future in (dying, waiting):
        with pytest.raises(WorkerDied, match="others were started: try again"):
            workers.result(future)
    value, second = workers.result(workers.submit(power, 2, 5))
    assert value == 25
    assert second not in (first, os.getpid())


def test_closing_workers_interrupts_their_work_and_ends_their_processes(tmp_path):
    workers = Workers(1)
    _, process = workers.result(workers.submit(power, 2, 3))
    started = tmp_path / "started"
    running, waiting = workers.submit(sleep_from, started), workers.submit(power, 2, 3)
    while not started.exists():
        time.sleep(0.01)
    workers.close()
    for future in (running, waiting):
        with pytest.raises(CancelledError):
            future.result(timeout=60)
    until = time.monotonic() + 30
    while alive(process) and time.monotonic() < until:
        time.sleep(0.05)
    assert not alive(process)


def test_workers_are_idle_only_without_calls(workers, tmp_path):
    assert not workers.is_used
    assert workers.idle_time > 0
    started = tmp_path / "started"
    running = workers.submit(sleep_from, started)
    while not started.exists():
        time.sleep(0.01)
    assert workers.is_used
    assert workers.idle_time == 0
    workers.close()
    with pytest.raises(CancelledError):
        running.result(timeout=60)
    until = time.monotonic() + 30
    while not workers.idle_time and time.monotonic() < until:
        time.sleep(0.01)
    assert workers.idle_time > 0


def alive(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True


def test_a_result_is_made_once_and_the_least_recently_used_is_dropped():
    shared, made = SharedResults(max_results=2), []

    def get(key):
        return shared.get(key, lambda: made.append(key) or key.upper())

    assert [get(key) for key in "aabacab"] == list("AABACAB")
    assert made == ["a", "b", "c", "b"]
    assert (get("a"), get("c")) == ("A", "C")
    assert made[4:] == ["c"]

"""Results of parallel work equal those of serial work."""

import os
import signal
import time
from functools import partial
from threading import Condition, Thread, current_thread, main_thread

import pytest

from helpers.worker_functions import die, die_at_three, fail, power
from morphgen.errors import BenchmarkError, MorphgenError
from morphgen.processes import CHUNK_SIZE, parallel_map
from morphgen.progress import interrupts, own_progress, part_of, report, show_progress


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("n", [0, 1, CHUNK_SIZE, 5 * CHUNK_SIZE + 3])
def test_results_come_in_order(jobs, n):
    counts = []
    with show_progress(lambda *count: counts.append(count)):
        results = list(parallel_map(partial(power, 2), range(n), jobs))
    assert [value for value, _ in results] == [i**2 for i in range(n)]
    assert counts == [(i + 1, n) for i in range(n)]
    elsewhere = {process for _, process in results} - {os.getpid()}
    assert bool(elsewhere) == (jobs > 1 and n > CHUNK_SIZE)


@pytest.mark.parametrize("jobs", [1, 2])
def test_worker_error_is_raised(jobs):
    results = parallel_map(fail, range(40), jobs)
    assert [next(results) for _ in range(2 * CHUNK_SIZE)] == list(range(2 * CHUNK_SIZE))
    with pytest.raises(BenchmarkError, match="20 is wrong"):
        list(results)


def test_dead_process_is_reported():
    with pytest.raises(MorphgenError, match=r"a worker died.*finished results are kept: run again"):
        list(parallel_map(die, range(20), 2))


def test_a_process_that_dies_while_results_are_used_is_reported():
    def slowly(result):
        time.sleep(0.1)  # meanwhile the pool breaks, before the next item is submitted
        return result

    with pytest.raises(MorphgenError, match="a worker died"):
        list(map(slowly, parallel_map(die_at_three, range(40), 2, chunk=1)))


def test_ctrl_c_between_a_lock_and_its_release_ends_the_pool(monkeypatch):
    enter = Condition.__enter__

    def interrupted(condition):
        entered = enter(condition)
        if current_thread() is main_thread():
            signal.raise_signal(signal.SIGINT)
        return entered

    results = parallel_map(time.sleep, [0.0, 60.0, 60.0], 2, chunk=1)
    next(results)
    with monkeypatch.context() as patched:  # else it would interrupt pytest as it sends its report
        patched.setattr(Condition, "__enter__", interrupted)
        with pytest.raises(KeyboardInterrupt):
            list(results)


def test_ctrl_c_that_python_loses_ends_the_pool_before_the_next_result():
    results = parallel_map(time.sleep, [0.0, 60.0, 60.0], 2, chunk=1)
    next(results)
    interrupts.append(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        next(results)
    assert interrupts == []


@pytest.mark.parametrize("jobs", [0, -1])
def test_number_of_jobs_is_at_least_one(jobs):
    with pytest.raises(MorphgenError, match=f"jobs {jobs}: expected a whole number, 1 or more"):
        list(parallel_map(fail, [1], jobs))


def test_reports_count_the_items_of_the_outermost_work():
    seen = []
    with show_progress(lambda *count: seen.append(count)):
        list(parallel_map(lambda n: list(parallel_map(abs, range(n), 1)), [2, 3], 1))
        for first in (0, 2):
            with part_of(4, first):
                list(parallel_map(abs, [1, 2], 1))
        with own_progress() as show:
            report(9, 9)
            show(1, None)
        thread = Thread(target=report, args=(8, 8))
        thread.start()
        thread.join()
    report(7, 7)
    assert seen == [(1, 2), (2, 2), (1, 4), (2, 4), (3, 4), (4, 4), (1, None)]

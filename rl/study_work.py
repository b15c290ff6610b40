"""Cells of a study done one after another, by several processes, or on a Ray cluster."""

from __future__ import annotations

import sys
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

from filelock import FileLock, Timeout

from morphgen import processes
from morphgen.errors import MorphgenError
from morphgen.formats.files import LOCK
from morphgen.processes import ray_cluster, require_ray
from morphgen.rl.evaluation import no_progress
from morphgen.rl.study import Cell, StartProgress, do_cell
from morphgen.rl.training import ExecutionConfig, ShowMetrics, Subrun

POLL = 2.0
"""Time between two checks of cells that another process works on [s]."""


@dataclass(frozen=True)
class Outcome:
    """Success or failure of a cell."""

    cell: Cell
    """The finished or failed cell."""
    error: str = ""
    """Error message; empty after success."""


Work = Callable[[Sequence[Cell], ExecutionConfig], Iterator[Outcome]]
"""Function that trains and evaluates cells, and yields their outcomes as they finish."""


def run_cells(
    cells: Sequence[Cell],
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None = None,
    progress: StartProgress = lambda name: no_progress,
    prepare: processes.Progress = processes.no_progress,
) -> Iterator[Outcome]:
    """Train and evaluate cells one after another, and yield their outcomes.

    Other processes may work on the same cells. Each cell is done by one process; this one waits at
    the end for the cells of the others.
    """
    waiting = deque(cells)
    skipped = 0
    while waiting:
        cell = waiting.popleft()
        outcome = _do_locked(cell, execution, show, progress, prepare)
        if outcome is not None:
            skipped = 0
            yield outcome
            continue
        waiting.append(cell)
        skipped += 1
        if skipped >= len(waiting):
            time.sleep(POLL)
            skipped = 0


def run_cells_on_ray(address: str | None, *, gpus: float = 0.0) -> Work:
    """Return a function that does cells as tasks of a Ray cluster.

    Its machines have morphgen installed and share the study's folder.

    Args:
        address: Address of the cluster; None for a local one.
        gpus: GPUs per cell; a fraction if below 1.

    Raises:
        MissingDependencyError: If ray is not installed.
    """
    ray = require_ray()

    def work(cells: Sequence[Cell], execution: ExecutionConfig) -> Iterator[Outcome]:
        with ray_cluster(address):
            remote = ray.remote(num_cpus=execution.workers, num_gpus=gpus, max_retries=0)(_on_ray)
            running = {
                remote.remote(replace(cell, folder=cell.folder.resolve()), execution): cell
                for cell in cells
            }
            while running:
                (done, *_), _ = ray.wait(list(running))
                cell = running.pop(done)
                try:
                    yield Outcome(cell, ray.get(done))
                except ray.exceptions.RayError as error:
                    yield Outcome(cell, f"its Ray task failed: {type(error).__name__}: {error}")

    return work


def _on_ray(cell: Cell, execution: ExecutionConfig) -> str:
    (outcome,) = run_cells([cell], execution)
    return outcome.error


def _do_locked(
    cell: Cell,
    execution: ExecutionConfig,
    show: Callable[[Subrun], ShowMetrics] | None,
    progress: StartProgress,
    prepare: processes.Progress,
) -> Outcome | None:
    """Train and evaluate a cell and return its outcome; None if another process works on it."""
    try:
        cell.folder.mkdir(parents=True, exist_ok=True)
        with FileLock(cell.folder / LOCK, timeout=0):
            do_cell(cell, execution, show, progress, prepare)
    except Timeout:
        return None
    except MorphgenError as error:
        return Outcome(cell, str(error))
    except OSError as error:
        return Outcome(cell, f"{error.filename or cell.folder}: {error.strerror}")
    except Exception as error:  # such as a GPU out of memory: the other cells go on
        traceback.print_exc(file=sys.stderr)
        return Outcome(cell, f"{type(error).__name__}: {error}")
    return Outcome(cell)

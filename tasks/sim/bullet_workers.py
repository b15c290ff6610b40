"""Processes that hold a share of the environments in PyBullet, in memory that all share."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.processes import sigint_blocked
from morphgen.tasks.sim.base import Contacts, Scene
from morphgen.tasks.sim.bullet_batch import BulletBatch, Exported, Float32, Rows

if TYPE_CHECKING:
    from ctypes import Array, c_float

    Memory = Array[c_float]

STEP = b"step"
"""The message to a worker that it is to step; any other is pickled."""
_DONE = b"done"
_EXIT_CODE_WAIT = 0.5
"""Seconds in which a worker whose pipe has ended is expected to be gone."""
_CONTEXT = multiprocessing.get_context("spawn")


@dataclass(frozen=True)
class Share:
    """What a process has of the environments."""

    scenes: Sequence[Scene]
    contacts: Contacts
    exported: Sequence[Exported]
    envs: Sequence[int]
    """Which they are of all."""


@dataclass(frozen=True, eq=False)
class Worker:
    """A process, and the way to talk to it."""

    process: SpawnProcess
    pipe: Connection
    envs: NDArray[np.int64]

    def __str__(self) -> str:
        return f"worker {self.process.name} of {len(self.envs)} environments"


@dataclass(frozen=True, eq=False)
class SharedArrays:
    """What n environments of J joints report, and their targets, in memory of all processes."""

    memory: Memory
    n: int
    joints: int

    @classmethod
    def zeros(cls, n: int, joints: int) -> SharedArrays:
        """Make room."""
        return cls(_CONTEXT.RawArray("f", n * (3 * joints + 7 + 6)), n, joints)

    def split(self) -> tuple[Rows, Float32]:
        """What a simulation reports, and its targets (n, J)."""
        n, joints = self.n, self.joints
        flat = np.ctypeslib.as_array(self.memory)
        ends = np.cumsum([n * joints, n * joints, n * 7, n * 6])
        q, qd, pose, velocity, targets = (part.reshape(n, -1) for part in np.split(flat, ends))
        return Rows(q, qd, pose, velocity), targets


def load(share: Share, rows: Rows) -> BulletBatch:
    """Load a share's scenes into this process; errors as of ``BulletBatch``."""
    return BulletBatch(share.scenes, share.contacts, share.exported, rows, share.envs)


def start(number: int, share: Share, arrays: SharedArrays) -> Worker:
    """Start a worker, which loads its share and then answers.

    Args:
        number: Its name.
        share: What it holds.
        arrays: Of all processes.

    Raises:
        SimulationError: If it died already.
    """
    ours, theirs = _CONTEXT.Pipe()
    process = _CONTEXT.Process(target=_serve, args=(theirs, arrays), name=str(number), daemon=True)
    worker = Worker(process, ours, np.array(share.envs))
    try:
        with sigint_blocked():
            process.start()
        theirs.close()
        send(worker, pickle.dumps(share))
    except BaseException:
        end([worker])
        raise
    return worker


def send(worker: Worker, message: bytes) -> None:
    """Tell a worker what to do.

    Raises:
        SimulationError: If it is dead.
    """
    try:
        worker.pipe.send_bytes(message)
    except OSError as error:
        raise _death(worker) from error


def gather(workers: Sequence[Worker]) -> list[Exception]:
    """Wait for an answer of each; return what was raised there.

    Raises:
        SimulationError: If one died.
    """
    failures: list[Exception] = []
    for worker in workers:
        try:
            answer = worker.pipe.recv_bytes()
        except (EOFError, OSError) as error:
            raise _death(worker) from error
        if answer != _DONE:
            failures.append(pickle.loads(answer))
    return failures


def end(workers: Sequence[Worker]) -> None:
    """Kill workers, which hold nothing that they would have to put in order."""
    for worker in workers:
        worker.pipe.close()
        if worker.process.pid is not None:
            worker.process.kill()
    for worker in workers:
        if worker.process.pid is not None:
            worker.process.join()
            worker.process.close()


def _death(worker: Worker) -> SimulationError:
    worker.process.join(_EXIT_CODE_WAIT)
    return SimulationError(
        f"{worker} died (exit code {worker.process.exitcode}); the simulation is closed"
    )


def _serve(pipe: Connection, arrays: SharedArrays) -> None:
    """What a worker does until its pipe ends; Ctrl-C is for the parent, which then closes it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    rows, targets = arrays.split()
    batch: BulletBatch | None = None
    try:
        while True:
            message = pipe.recv_bytes()
            try:
                if batch is None:
                    batch = load(pickle.loads(message), rows)
                elif message == STEP:
                    batch.step(targets)
                else:
                    batch.reset(*pickle.loads(message))
            except (SimulationError, ValueError) as error:
                answer = pickle.dumps(error)
            except BaseException as error:
                unforeseen = SimulationError(f"a worker failed: {type(error).__name__}: {error}")
                pipe.send_bytes(pickle.dumps(unforeseen))
                raise
            else:
                answer = _DONE
            pipe.send_bytes(answer)
    except (EOFError, ConnectionError):
        return
    finally:
        if batch is not None:
            batch.close()

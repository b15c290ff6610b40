"""Worker processes with a share of the environments in PyBullet, and the memory that they share."""

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
from morphgen.tasks.sim.bullet_batch import BulletBatch, Float32, Share, StateBuffers

if TYPE_CHECKING:
    from ctypes import Array, c_float

    Memory = Array[c_float]

STEP = b"step"
"""Message that makes a worker step; any other message is pickled."""
_DONE = b"done"
_EXIT_CODE_WAIT = 0.5
"""Time for a worker whose pipe has ended to exit [s]."""
_CONTEXT = multiprocessing.get_context("spawn")


@dataclass(frozen=True, eq=False)
class Worker:
    """A worker process and its pipe."""

    process: SpawnProcess
    pipe: Connection
    envs: NDArray[np.int64]

    def __str__(self) -> str:
        return f"worker {self.process.name} of {len(self.envs)} environments"


@dataclass(frozen=True, eq=False)
class SharedBuffers:
    """States and targets of n environments with J joints, in memory of all processes."""

    memory: Memory
    n: int
    joints: int

    @classmethod
    def zeros(cls, n: int, joints: int) -> SharedBuffers:
        """Allocate the memory, filled with zeros."""
        return cls(_CONTEXT.RawArray("f", n * (3 * joints + 7 + 6)), n, joints)

    def split(self) -> tuple[StateBuffers, Float32]:
        """Return views of the states, and of the targets (n, J)."""
        n, joints = self.n, self.joints
        flat = np.ctypeslib.as_array(self.memory)
        ends = np.cumsum([n * joints, n * joints, n * 7, n * 6])
        q, qd, pose, velocity, targets = (part.reshape(n, -1) for part in np.split(flat, ends))
        return StateBuffers(q, qd, pose, velocity), targets


def start(number: int, share: Share, shared: SharedBuffers) -> Worker:
    """Start a worker, which loads its share and then answers."""
    parent_end, worker_end = _CONTEXT.Pipe()
    process = _CONTEXT.Process(
        target=_serve, args=(worker_end, shared), name=str(number), daemon=True
    )
    worker = Worker(process, parent_end, np.array(share.envs))
    try:
        with sigint_blocked():
            process.start()
        worker_end.close()
        send(worker, pickle.dumps(share))
    except BaseException:
        end([worker])
        raise
    return worker


def send(worker: Worker, message: bytes) -> None:
    """Send a message to a worker."""
    try:
        worker.pipe.send_bytes(message)
    except OSError as error:
        raise _death(worker) from error


def gather(workers: Sequence[Worker]) -> tuple[dict[int, str], list[Exception]]:
    """Wait for the answer of each worker.

    Returns:
        The reason for each environment that diverged; and the exceptions raised in the workers.
    """
    reasons: dict[int, str] = {}
    failures: list[Exception] = []
    for worker in workers:
        try:
            answer = worker.pipe.recv_bytes()
        except (EOFError, OSError) as error:
            raise _death(worker) from error
        if answer == _DONE:
            continue
        content: dict[int, str] | Exception = pickle.loads(answer)
        if isinstance(content, Exception):
            failures.append(content)
        else:
            reasons |= content
    return reasons, failures


def end(workers: Sequence[Worker]) -> None:
    """Kill workers; they hold nothing that needs an orderly shutdown."""
    for worker in workers:
        worker.pipe.close()
        if worker.process.pid is not None:
            worker.process.kill()
    for worker in workers:
        if worker.process.pid is not None:
            worker.process.join()
            worker.process.close()


def _death(worker: Worker) -> SimulationError:
    """Return the error that reports a dead worker, with its exit code."""
    worker.process.join(_EXIT_CODE_WAIT)
    return SimulationError(
        f"{worker} died (exit code {worker.process.exitcode}); the simulation is closed"
    )


def _serve(pipe: Connection, shared: SharedBuffers) -> None:
    """Serve messages until the pipe ends; the parent handles Ctrl-C and closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    buffers, targets = shared.split()
    batch: BulletBatch | None = None
    try:
        while True:
            message = pipe.recv_bytes()
            reasons: dict[int, str] = {}
            try:
                if batch is None:
                    batch = BulletBatch(pickle.loads(message), buffers)
                elif message == STEP:
                    reasons = batch.step(targets)
                else:
                    batch.reset(*pickle.loads(message))
            except (SimulationError, ValueError) as error:
                answer = pickle.dumps(error)
            except BaseException as error:
                unexpected = SimulationError(f"a worker failed: {type(error).__name__}: {error}")
                pipe.send_bytes(pickle.dumps(unexpected))
                raise
            else:
                answer = pickle.dumps(reasons) if reasons else _DONE
            pipe.send_bytes(answer)
    except (EOFError, ConnectionError):
        return
    finally:
        if batch is not None:
            batch.close()

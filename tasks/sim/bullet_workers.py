"""PyBullet in several processes that share memory with this one."""

from __future__ import annotations

import multiprocessing
import pickle
import signal
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.tasks.sim.base import Contacts, Scene
from morphgen.tasks.sim.bullet_batch import (
    BulletBatch,
    Exported,
    Float32,
    Rows,
    RowTensors,
    export_robots,
    most_joints,
)

if TYPE_CHECKING:
    from ctypes import Array, c_float

    Memory = Array[c_float]

_STEP = b"step"
_DONE = b"done"
_BASE_LOAD = 5
"""What a step costs without joints, in joints."""
_EXIT_CODE_WAIT = 0.5
"""Seconds in which a worker whose pipe has ended is expected to be gone."""


@dataclass(frozen=True)
class _Work:
    """What a worker is given."""

    scenes: Sequence[Scene]
    contacts: Contacts
    exported: Sequence[Exported]
    envs: Sequence[int]
    count: int
    """Environments of all workers."""
    joints: int


@dataclass(frozen=True, eq=False)
class _Worker:
    process: SpawnProcess
    pipe: Connection
    envs: NDArray[np.int64]

    def __str__(self) -> str:
        return f"worker {self.process.name} of {len(self.envs)} environments"


class BulletWorkers(RowTensors):
    """Environments in PyBullet, divided among processes; the bits are those of one process.

    A step is a few bytes through a pipe to every worker and back; targets and states are in
    memory that all share. That memory has no name, so that nothing is left of it whatever happens
    to the processes, and a worker ends when its pipe does. Workers are started afresh ("spawn"):
    a script that makes them needs ``if __name__ == "__main__":``.
    """

    def __init__(
        self, scenes: Sequence[Scene], contacts: Contacts | None = None, *, workers: int = 2
    ) -> None:
        """Load every scene; its robot is at zero until the first reset.

        Args:
            scenes: One for each environment.
            contacts: What may touch what; by default all.
            workers: Processes; no more than scenes are started.

        Raises:
            SimulationError: If PyBullet cannot hold a scene, or a worker dies.
            FormatError: If a robot cannot be written for it.
            MeshError: If a collision mesh cannot be read.
            ValueError: If there are no workers or no scenes.
        """
        if workers < 1 or not scenes:
            raise ValueError(f"{workers} workers for {len(scenes)} scenes; both must be at least 1")
        n, joints = len(scenes), most_joints(scenes)
        context = multiprocessing.get_context("spawn")
        memory: Memory = context.RawArray("f", n * _width(joints))
        rows, self._targets = _rows(memory, n, joints)
        super().__init__(scenes, rows)
        folder = tempfile.TemporaryDirectory(prefix="morphgen-")
        self._workers: list[_Worker] = []
        self._free = weakref.finalize(self, _free, self._workers, folder)
        try:
            exported = export_robots(scenes, Path(folder.name))
            for number, envs in enumerate(divide(scenes, workers)):
                work = _Work(
                    [scenes[env] for env in envs],
                    contacts or Contacts(),
                    [exported[env] for env in envs],
                    envs,
                    n,
                    joints,
                )
                ours, theirs = context.Pipe()
                process = context.Process(
                    target=_serve, args=(theirs, memory), name=str(number), daemon=True
                )
                self._workers.append(_Worker(process, ours, np.array(envs)))
                process.start()
                theirs.close()
                self._send(self._workers[-1], pickle.dumps(work))
            failures = self._gather(self._workers)
            if failures:
                raise failures[0]
        except BaseException:
            self.close()
            raise

    def reset(self, envs: torch.Tensor, q: torch.Tensor, block_pose: torch.Tensor) -> None:
        """Put some environments at rest, without a past; see ``Simulation.reset``.

        Raises:
            ValueError: If a shape is wrong, or a position is not finite.
            SimulationError: If the simulation is closed, or a worker died.
        """
        self._require_open()
        chosen, positions, poses = self._checked_state(envs, q, block_pose)
        busy = []
        for worker in self._workers:
            mine = np.isin(chosen, worker.envs)
            if mine.any():
                busy.append((worker, pickle.dumps((chosen[mine], positions[mine], poses[mine]))))
        self._exchange(busy)

    def step(self, targets: torch.Tensor) -> None:
        """Move all by one control step; see ``Simulation.step``.

        Raises:
            ValueError: If the shape is wrong, or a target is not finite.
            SimulationError: If an environment became unstable, the simulation is closed, or a
                worker died; in the last case it is closed thereby.
        """
        self._require_open()
        self._targets[:] = self._checked_targets(targets)
        self._exchange([(worker, _STEP) for worker in self._workers])

    def close(self) -> None:
        """End the processes; a second time does nothing."""
        self._free()

    def _require_open(self) -> None:
        if not self._free.alive:
            raise SimulationError("the simulation is closed")

    def _exchange(self, messages: Sequence[tuple[_Worker, bytes]]) -> None:
        """Tell workers what to do and wait until all have done it.

        Whatever interrupts this leaves answers behind that nobody reads, so it closes.
        """
        try:
            for worker, message in messages:
                self._send(worker, message)
            failures = self._gather([worker for worker, _ in messages])
        except BaseException:
            self.close()
            raise
        if failures:
            raise failures[0]

    def _send(self, worker: _Worker, message: bytes) -> None:
        try:
            worker.pipe.send_bytes(message)
        except OSError as error:
            raise _death(worker) from error

    def _gather(self, workers: Sequence[_Worker]) -> list[Exception]:
        """Wait for an answer of each; return what was raised."""
        failures: list[Exception] = []
        for worker in workers:
            try:
                answer = worker.pipe.recv_bytes()
            except (EOFError, OSError) as error:
                raise _death(worker) from error
            if answer != _DONE:
                failures.append(pickle.loads(answer))
        return failures


def divide(scenes: Sequence[Scene], workers: int) -> list[list[int]]:
    """Share environments out so that all workers have about as many joints to move.

    Returns:
        The environments of each worker, ascending; no worker is without.
    """
    shares: list[list[int]] = [[] for _ in range(min(workers, len(scenes)))]
    loads = [0] * len(shares)
    weights = [_BASE_LOAD + len(scene.robot.movable) for scene in scenes]
    for env in sorted(range(len(scenes)), key=lambda env: -weights[env]):
        lightest = loads.index(min(loads))
        shares[lightest].append(env)
        loads[lightest] += weights[env]
    return [sorted(share) for share in shares]


def _death(worker: _Worker) -> SimulationError:
    worker.process.join(_EXIT_CODE_WAIT)
    return SimulationError(
        f"{worker} died (exit code {worker.process.exitcode}); the simulation is closed"
    )


def _free(workers: list[_Worker], folder: tempfile.TemporaryDirectory[str]) -> None:
    """Kill the workers, which hold nothing that they would have to put in order."""
    for worker in workers:
        worker.pipe.close()
        if worker.process.pid is not None:
            worker.process.kill()
    for worker in workers:
        if worker.process.pid is not None:
            worker.process.join()
            worker.process.close()
    folder.cleanup()


def _width(joints: int) -> int:
    return 3 * joints + 7 + 6


def _rows(memory: Memory, n: int, joints: int) -> tuple[Rows, Float32]:
    """What a simulation reports and its targets, in shared memory."""
    flat = np.ctypeslib.as_array(memory)
    ends = np.cumsum([n * joints, n * joints, n * 7, n * 6])
    q, qd, pose, velocity, targets = (part.reshape(n, -1) for part in np.split(flat, ends))
    return Rows(q, qd, pose, velocity), targets


def _serve(pipe: Connection, memory: Memory) -> None:
    """What a worker does until its pipe ends; Ctrl-C is for the parent, which then closes it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    batch: BulletBatch | None = None
    try:
        while True:
            message = pipe.recv_bytes()
            try:
                if batch is None:
                    batch, targets = _load(pickle.loads(message), memory)
                elif message == _STEP:
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


def _load(work: _Work, memory: Memory) -> tuple[BulletBatch, Float32]:
    rows, targets = _rows(memory, work.count, work.joints)
    batch = BulletBatch(work.scenes, work.contacts, work.exported, rows, work.envs)
    return batch, targets

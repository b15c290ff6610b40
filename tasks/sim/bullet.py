"""PyBullet behind the protocol of simulators, in this process and others beside it."""

from __future__ import annotations

import pickle
import tempfile
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from morphgen.errors import DivergedError, SimulationError
from morphgen.tasks.sim.base import Contacts, Scene, Simulator
from morphgen.tasks.sim.bullet_batch import BulletBatch, most_joints
from morphgen.tasks.sim.bullet_files import export_robots
from morphgen.tasks.sim.bullet_workers import (
    STEP,
    Share,
    SharedArrays,
    Worker,
    end,
    gather,
    load,
    send,
    start,
)
from morphgen.tasks.sim.row_tensors import RowTensors

_BASE_LOAD = 5
"""What a step costs without joints, in joints."""


class BulletSimulation(RowTensors):
    """Environments in PyBullet, divided among processes of which this is one; see ``Simulation``.

    Each has a client of its own, so that none can influence another, and the bits are the same with
    any number of processes. PyBullet gives a client 36 MB and some 25 ms to start, whatever is in
    it, and a process 1024 of them.

    A step is a few bytes through a pipe to every other process and back, while this one steps its
    own share; targets and states are in memory that all share. That memory has no name, so that
    nothing is left of it whatever happens to the processes, and a worker ends when its pipe does.
    Workers are started afresh ("spawn"): a script that makes them needs
    ``if __name__ == "__main__":``.
    """

    def __init__(
        self, scenes: Sequence[Scene], contacts: Contacts | None = None, *, processes: int = 1
    ) -> None:
        """Load every scene; its robot is at zero until the first reset.

        Args:
            scenes: One for each environment.
            contacts: What may touch what; by default all.
            processes: With this one; no more than scenes are used.

        Raises:
            SimulationError: If PyBullet cannot hold a scene, or a worker dies.
            FormatError: If a robot cannot be written for it.
            MeshError: If a collision mesh cannot be read.
            ValueError: If there are no processes or no scenes.
        """
        if processes < 1 or not scenes:
            raise ValueError(
                f"{processes} processes for {len(scenes)} scenes; both must be at least 1"
            )
        n, joints = len(scenes), most_joints(scenes)
        arrays = SharedArrays.zeros(n, joints)
        rows, self._targets = arrays.split()
        super().__init__(scenes, rows)
        folder = tempfile.TemporaryDirectory(prefix="morphgen-")
        self._workers: list[Worker] = []
        self._own: list[BulletBatch] = []
        self._free = weakref.finalize(self, _free, self._workers, self._own, folder)
        try:
            exported = export_robots(scenes, Path(folder.name))
            first, *others = (
                Share(
                    [scenes[env] for env in envs],
                    contacts or Contacts(),
                    [exported[env] for env in envs],
                    envs,
                )
                for envs in divide(scenes, processes)
            )
            for number, share in enumerate(others, start=1):
                self._workers.append(start(number, share, arrays))
            self._own.append(load(first, rows))
            self._envs = np.array(first.envs)
            failures = gather(self._workers)
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
        mine = np.isin(chosen, self._envs)
        own = chosen[mine], positions[mine], poses[mine]
        self._together(busy, lambda batch: batch.reset(*own))

    def step(self, targets: torch.Tensor) -> None:
        """Move all by one control step; see ``Simulation.step``.

        Raises:
            ValueError: If the shape is wrong, or a target is not finite.
            DivergedError: If environments became unstable.
            SimulationError: If the simulation is closed, or a worker died; in the last case it is
                closed thereby.
        """
        self._require_open()
        self._targets[:] = self._checked_targets(targets)
        messages = [(worker, STEP) for worker in self._workers]
        self._together(messages, lambda batch: batch.step(self._targets))

    def close(self) -> None:
        """Free the clients and end the workers; a second time does nothing."""
        self._free()

    def _require_open(self) -> None:
        if not self._free.alive:
            raise SimulationError("the simulation is closed")

    def _together(
        self, messages: Sequence[tuple[Worker, bytes]], own: Callable[[BulletBatch], None]
    ) -> None:
        """Tell workers what to do, do this process's own, and wait until all is done.

        Whatever interrupts this leaves answers behind that nobody reads, so it closes.
        """
        failures: list[Exception] = []
        try:
            for worker, message in messages:
                send(worker, message)
            try:
                own(self._own[0])
            except (SimulationError, ValueError) as error:
                failures.append(error)
            failures += gather([worker for worker, _ in messages])
        except BaseException:
            self.close()
            raise
        if failures:
            raise _as_one(failures)


def divide(scenes: Sequence[Scene], processes: int) -> list[list[int]]:
    """Share environments out so that all processes have about as many joints to move.

    Returns:
        The environments of each process, ascending; none is without.
    """
    shares: list[list[int]] = [[] for _ in range(min(processes, len(scenes)))]
    loads = [0] * len(shares)
    weights = [_BASE_LOAD + len(scene.robot.movable_joints) for scene in scenes]
    for env in sorted(range(len(scenes)), key=lambda env: -weights[env]):
        lightest = loads.index(min(loads))
        shares[lightest].append(env)
        loads[lightest] += weights[env]
    return [sorted(share) for share in shares]


def _as_one(failures: Sequence[Exception]) -> Exception:
    """What processes found unstable is one error, if nothing else failed."""
    reasons: dict[int, str] = {}
    for failure in failures:
        if not isinstance(failure, DivergedError):
            return failure
        reasons |= failure.reasons
    return DivergedError(reasons)


def _free(
    workers: list[Worker], own: list[BulletBatch], folder: tempfile.TemporaryDirectory[str]
) -> None:
    end(workers)
    for batch in own:
        batch.close()
    folder.cleanup()


SIMULATOR = Simulator(
    "pybullet",
    lambda scenes, contacts, workers: BulletSimulation(scenes, contacts, processes=workers),
    native_step=("pybullet", "stepSimulation"),
    max_envs=128,  # one takes 36 MB
)

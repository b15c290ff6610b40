"""PyBullet as a simulator: environments divided among this process and workers."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.model.robot import Robot
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import Contacts, HostSimulation, Scene, Simulator
from morphgen.tasks.sim.bullet_batch import (
    BulletBatch,
    Exported,
    Float32,
    Share,
    Worker,
    consecutive,
)
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links

_BASE_LOAD = 5  # cost of stepping an environment without joints, in joints


class BulletSimulation(HostSimulation):
    """Environments in PyBullet, divided among processes of which this is one; a ``Simulation``.

    Every environment has its own client, so that none can influence another, and the bits are the
    same for any number of processes. A client takes 36 MB and some 25 ms to start, whatever is in
    it; a process can have 1024.

    A step sends targets through a pipe to every worker, which returns its states, while this
    process steps its own share. A worker ends when its pipe does. Workers are started afresh
    ("spawn"): a script that makes them needs ``if __name__ == "__main__":``.
    """

    def __init__(
        self, scenes: Sequence[Scene], contacts: Contacts | None = None, *, processes: int = 1
    ) -> None:
        super().__init__(scenes)
        self.workers: list[Worker] = []
        self._unreset: set[int] = set()
        resources = ExitStack()
        self._free = weakref.finalize(self, resources.close)
        try:
            folder = resources.enter_context(tempfile.TemporaryDirectory(prefix="morphgen-"))
            exported = export_scenes(scenes, Path(folder))
            shares = divide(scenes, processes)
            self._shares = [np.array(envs) for envs in shares]
            self._rows = [consecutive(envs) for envs in self._shares]
            first, *others = (
                Share(
                    [scenes[env] for env in envs],
                    contacts or Contacts(),
                    [exported[env] for env in envs],
                    self._targets.shape[1],
                )
                for envs in shares
            )
            for number, share in enumerate(others, start=1):
                self.workers.append(Worker(number, share))
                resources.callback(self.workers[-1].end)
            self.batch = BulletBatch(first)
            resources.callback(self.batch.close)
            self._state: Any = self.batch.state
            if self.workers:
                self._state = [
                    np.zeros((len(scenes), *part.shape[1:]), np.float32) for part in self._state
                ]
            tensors = map(torch.from_numpy, self._state)
            self.q, self.qd, self.object_pose, self.object_velocity = tensors
            for worker in self.workers:
                worker.receive()
            self._go_home()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the clients and end the workers; a second call does nothing."""
        super().close()
        self._free()

    def _put(
        self,
        envs: NDArray[np.int64],
        q: Float32,
        object_pose: Float32,
        obstacle_poses: Float32 | None,
    ) -> None:
        arguments = []
        for share in self._shares:
            mine = np.isin(envs, share)
            others = None if obstacle_poses is None else obstacle_poses[mine]
            rows = np.searchsorted(share, envs[mine])
            arguments.append((rows, q[mine], object_pose[mine], others))
        self._call("reset", arguments)
        self._unreset -= {*envs.tolist()}

    def _advance(self) -> dict[int, str]:
        if self._unreset:
            reason = self._faults[min(self._unreset)]
            raise SimulationError(f"{reason}; expected a reset before the next step")
        faults = self._call("step", [(self._targets[rows],) for rows in self._rows])
        self._unreset = set(faults)
        return faults

    def _call(self, method: str, arguments: Sequence[tuple[Any, ...]]) -> dict[int, str]:
        """Call a method of the batches of all processes, and read their states.

        Return the reason for each environment that diverged.
        """
        mine, *others = arguments
        try:
            for worker, args in zip(self.workers, others, strict=True):
                worker.send(method, *args)
            answers = [(getattr(self.batch, method)(*mine), self.batch.state)]
            answers += [worker.receive() for worker in self.workers]
        except BaseException:
            self.close()  # an interruption leaves answers in the pipes that nobody reads
            raise
        found: dict[int, str] = {}
        for envs, rows, (faults, state) in zip(self._shares, self._rows, answers, strict=True):
            if self.workers:
                for values, of_share in zip(self._state, state, strict=True):
                    values[rows] = of_share
            if faults:
                found |= {int(envs[i]): reason for i, reason in faults.items()}
        return found


def export_scenes(scenes: Sequence[Scene], folder: Path) -> list[Exported]:
    """Write the URDF of every robot and object once; return what each scene loads."""
    written: dict[int, tuple[Path, Robot]] = {}

    def export(robot: Robot) -> tuple[Path, Robot]:
        if id(robot) not in written:
            merged = merge_rigid_links(robot)
            bundle = write_bundle(merged, folder / f"robot{len(written)}", picture=False)
            written[id(robot)] = bundle / URDF, merged
        return written[id(robot)]

    return [
        Exported(
            *export(scene.robot),
            export(scene.object.body)[0] if isinstance(scene.object, ArticulatedObject) else None,
        )
        for scene in scenes
    ]


def divide(scenes: Sequence[Scene], processes: int) -> list[list[int]]:
    """Divide environments among processes, none idle, with about as many joints to simulate."""
    shares: list[list[int]] = [[] for _ in range(min(processes, len(scenes)))]
    loads = [0] * len(shares)
    weights = [_BASE_LOAD + len(scene.robot.movable_joints) for scene in scenes]
    for env in sorted(range(len(scenes)), key=lambda env: -weights[env]):  # the heaviest first
        lightest = loads.index(min(loads))
        shares[lightest].append(env)
        loads[lightest] += weights[env]
    return [sorted(share) for share in shares]


SIMULATOR = Simulator(
    "pybullet",
    lambda scenes, contacts, workers, _: BulletSimulation(scenes, contacts, processes=workers),
    max_envs=128,  # an environment takes 36 MB
)

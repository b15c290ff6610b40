"""PyBullet as a simulator: environments divided among this process and workers."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.tasks.sim.base import Contacts, Scene, Simulator, require_finite, require_reset_shapes
from morphgen.tasks.sim.bullet_batch import (
    BulletBatch,
    ExportedRobot,
    Float32,
    Share,
    Worker,
    allocate,
    attempt,
    buffers_in,
)
from morphgen.tasks.sim.motor_law import TensorView, all_finite, mask_of
from morphgen.tasks.sim.rigid_bodies import merge_rigid_links
from morphgen.typing import Array

BulletState = tuple[NDArray[np.int64], Float32, Float32, Float32 | None]
"""Arguments of ``BulletBatch.reset``."""

_BASE_LOAD = 5  # cost of stepping an environment without joints, in joints


class BulletSimulation:
    """Environments in PyBullet, divided among processes of which this is one; a ``Simulation``.

    Every environment has its own client, so that none can influence another, and the bits are the
    same for any number of processes. A client takes 36 MB and some 25 ms to start, whatever is in
    it; a process can have 1024.

    A step sends a few bytes through a pipe to every worker and back, while this process steps its
    own share; targets and states are in shared memory. That memory has no name, so that nothing is
    left of it whatever happens to the processes, and a worker ends when its pipe does. Workers are
    started afresh ("spawn"): a script that makes them needs ``if __name__ == "__main__":``.
    """

    def __init__(
        self, scenes: Sequence[Scene], contacts: Contacts | None = None, *, processes: int = 1
    ) -> None:
        """Load every scene; its robot is at zero until the first reset."""
        if processes < 1 or not scenes:
            raise ValueError(
                f"{processes} processes for {len(scenes)} scenes; both must be at least 1"
            )
        self.scenes = tuple(scenes)
        self.device = torch.device("cpu")
        dofs = np.array([scene.robot.dof for scene in scenes], np.int64)
        num_joints = int(dofs.max())
        memory = allocate(len(scenes), num_joints)
        buffers = buffers_in(memory, len(scenes))
        self._targets = buffers.targets
        self.q, self.qd = torch.from_numpy(buffers.q), torch.from_numpy(buffers.qd)
        self.block_pose = torch.from_numpy(buffers.block_pose)
        self.block_velocity = torch.from_numpy(buffers.block_velocity)
        self._is_joint = np.arange(num_joints) < dofs[:, None]
        self._has_block = np.array([scene.block is not None for scene in scenes], bool)
        folder = tempfile.TemporaryDirectory(prefix="morphgen-")
        self._view = TensorView()
        self._faults: dict[int, str] = {}
        self._diverged = torch.zeros(len(scenes), dtype=torch.bool)
        self._workers: list[Worker] = []
        self._local_batches: list[BulletBatch] = []
        self._free = weakref.finalize(self, _free, self._workers, self._local_batches, folder)
        try:
            exported = export_robots(scenes, Path(folder.name))
            first, *others = (
                Share(
                    [scenes[env] for env in envs],
                    contacts or Contacts(),
                    [exported[env] for env in envs],
                    envs,
                    len(scenes),
                )
                for envs in divide(scenes, processes)
            )
            for number, share in enumerate(others, start=1):
                self._workers.append(Worker(number, share, memory))
            self._local_batches.append(BulletBatch(first, buffers))
            self._envs = np.array(first.envs)
            for worker in self._workers:
                if isinstance(failure := worker.receive(), Exception):
                    raise failure
        except BaseException:
            self.close()
            raise

    def reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        block_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None = None,
    ) -> None:
        """Put some environments at rest and clear their history; see ``Simulation.reset``."""
        self._require_open()
        joints = self._is_joint.shape[1]
        require_reset_shapes(self.scenes, joints, mask, q, block_pose, obstacle_poses)
        rows, indices = mask.numpy(), np.flatnonzero(mask.numpy())
        # Padding, poses without a block, and rows that are not reset may hold anything.
        is_joint, is_block = rows[:, None] & self._is_joint, (rows & self._has_block)[:, None]
        require_finite(self.scenes, "reset to q", np.where(is_joint, q.numpy(), 0))
        require_finite(self.scenes, "reset to block", np.where(is_block, block_pose.numpy(), 0))
        positions, poses = q.numpy()[indices], block_pose.numpy()[indices]
        obstacles: Float32 | None = None
        if obstacle_poses is not None:
            moved = np.where(rows[:, None, None], obstacle_poses.numpy(), 0)
            require_finite(self.scenes, "reset to obstacles", moved)
            obstacles = moved[indices]

        def state(envs: NDArray[np.int64]) -> BulletState:
            mine = np.isin(indices, envs)
            others = None if obstacles is None else obstacles[mine]
            return indices[mine], positions[mine], poses[mine], others

        workers = [worker for worker in self._workers if np.isin(indices, worker.envs).any()]
        self._call("reset", workers, state)

    def step(self, targets: torch.Tensor) -> torch.Tensor:
        """Advance all environments by one control step; see ``Simulation.step``."""
        self._require_open()
        given = self._view(targets)
        if given.shape != self._is_joint.shape:
            raise ValueError(f"targets have shape {given.shape}, not {self._is_joint.shape}")
        np.copyto(self._targets, given, where=self._is_joint)  # padding may be anything
        if not all_finite(self._targets):
            require_finite(self.scenes, "targets", self._targets)
        faults = self._call("step", self._workers)
        if faults or self._faults:
            self._faults = faults
            self._diverged = torch.from_numpy(mask_of(faults, len(self.scenes)))
        return self._diverged

    def faults(self) -> dict[int, str]:
        """Return why environments diverged in the last step; see ``Simulation.faults``."""
        return self._faults

    def close(self) -> None:
        """Free the clients and end the workers; a second call does nothing."""
        self._free()

    def movable_q(self, env: int) -> Array:
        """Return the positions of all movable joints of an environment of this process."""
        return self._local_batches[0].movable_q(env)

    def _require_open(self) -> None:
        if not self._free.alive:
            raise SimulationError("the simulation is closed")

    def _call(
        self,
        method: str,
        workers: Sequence[Worker],
        args_of: Callable[[NDArray[np.int64]], tuple[Any, ...]] = lambda envs: (),
    ) -> dict[int, str]:
        """Call a method of the batches of workers and of this process.

        ``args_of`` returns the arguments for a batch of some environments. Return the reason for
        each environment that diverged. An interruption closes the simulation: it leaves answers in
        the pipes that nobody reads.
        """
        try:
            for worker in workers:
                worker.send(method, *args_of(worker.envs))
            work_here = partial(getattr(self._local_batches[0], method), *args_of(self._envs))
            answers = [attempt(work_here), *(worker.receive() for worker in workers)]
        except BaseException:
            self.close()
            raise
        reasons: dict[int, str] = {}
        for answer in answers:
            if isinstance(answer, Exception):
                raise answer
            reasons |= answer or {}
        return dict(sorted(reasons.items()))


def export_robots(scenes: Sequence[Scene], folder: Path) -> list[ExportedRobot]:
    """Write the URDF of every robot in the scenes once; return what each scene loads."""
    written: dict[int, ExportedRobot] = {}
    for scene in scenes:
        key = id(scene.robot)
        if key not in written:
            merged = merge_rigid_links(scene.robot)
            bundle = write_bundle(merged, folder / f"robot{len(written)}", picture=False)
            written[key] = bundle / URDF, merged
    return [written[id(scene.robot)] for scene in scenes]


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


def _free(
    workers: list[Worker],
    local_batches: list[BulletBatch],
    folder: tempfile.TemporaryDirectory[str],
) -> None:
    for worker in workers:
        worker.end()
    for batch in local_batches:
        batch.close()
    folder.cleanup()


SIMULATOR = Simulator(
    "pybullet",
    lambda scenes, contacts, workers, _: BulletSimulation(scenes, contacts, processes=workers),
    native_step=("pybullet", "stepSimulation"),
    max_envs=128,  # an environment takes 36 MB
    contact_margin=1e-3,  # by which it enlarges convex meshes of a URDF
)

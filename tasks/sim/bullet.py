"""PyBullet behind the protocol of simulators, in this process."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from morphgen.errors import SimulationError
from morphgen.tasks.sim.base import Contacts, Scene
from morphgen.tasks.sim.bullet_batch import (
    BulletBatch,
    Rows,
    RowTensors,
    export_robots,
    most_joints,
)


class BulletSimulation(RowTensors):
    """Environments in PyBullet, one after the other in this process; see ``Simulation``.

    Each has a client of its own, so that none can influence another. PyBullet gives a client 36 MB
    and some 25 ms to start, whatever is in it, and a process 1024 of them.
    """

    def __init__(self, scenes: Sequence[Scene], contacts: Contacts | None = None) -> None:
        """Load every scene; its robot is at zero until the first reset.

        Args:
            scenes: One for each environment.
            contacts: What may touch what; by default all.

        Raises:
            SimulationError: If PyBullet cannot hold a scene.
            FormatError: If a robot cannot be written for it.
            MeshError: If a collision mesh cannot be read.
        """
        n, joints = len(scenes), most_joints(scenes)
        rows = Rows(*(np.zeros((n, width), np.float32) for width in (joints, joints, 7, 6)))
        super().__init__(scenes, rows)
        folder = tempfile.TemporaryDirectory(prefix="morphgen-")
        try:
            exported = export_robots(scenes, Path(folder.name))
            self._batch = BulletBatch(self.scenes, contacts or Contacts(), exported, rows, range(n))
        except BaseException:
            folder.cleanup()
            raise
        self._free = weakref.finalize(self, _free, self._batch, folder)

    def reset(self, envs: torch.Tensor, q: torch.Tensor, block_pose: torch.Tensor) -> None:
        """Put some environments at rest, without a past; see ``Simulation.reset``.

        Raises:
            ValueError: If a shape is wrong, or a position is not finite.
            SimulationError: If the simulation is closed.
        """
        self._require_open()
        self._batch.reset(*self._checked_state(envs, q, block_pose))

    def step(self, targets: torch.Tensor) -> None:
        """Move all by one control step; see ``Simulation.step``.

        Raises:
            ValueError: If the shape is wrong, or a target is not finite.
            SimulationError: If an environment became unstable, or the simulation is closed.
        """
        self._require_open()
        self._batch.step(self._checked_targets(targets))

    def close(self) -> None:
        """Free the clients; a second time does nothing."""
        self._free()

    def _require_open(self) -> None:
        if not self._free.alive:
            raise SimulationError("the simulation is closed")


def _free(batch: BulletBatch, folder: tempfile.TemporaryDirectory[str]) -> None:
    batch.close()
    folder.cleanup()

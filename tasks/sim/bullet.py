"""PyBullet as a simulator: a client for every environment, stepped one after the other."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Collection, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.tasks.sim.articulated import ArticulatedObject, merge_rigid_links
from morphgen.tasks.sim.base import (
    Contacts,
    HostSimulation,
    Scene,
    Simulator,
    is_within,
)
from morphgen.tasks.sim.bullet_scene import (
    FROM_BULLET,
    BulletScene,
    Exported,
)

MAX_VELOCITY = 1e4
"""Speed of joints and blocks [rad/s or m/s] and distance of blocks [m] that count as diverged."""
MAX_POSITION = float(np.finfo(np.float32).max)
"""Joint positions may be any finite number: continuous joints turn without end."""
Float32 = NDArray[np.float32]


class BulletSimulation(HostSimulation):
    """Environments in PyBullet; a ``Simulation``.

    Every environment has its own client, so that none can influence another. A client takes 36 MB
    and some 25 ms to start, whatever is in it; a process can have 1024.
    """

    def __init__(self, scenes: Sequence[Scene], contacts: Contacts | None = None) -> None:
        super().__init__(scenes)
        self._contacts = contacts or Contacts()
        n, joints = self._targets.shape
        self._q, self._qd = np.zeros((2, n, joints), np.float32)
        self._pose, self._velocity = np.zeros((n, 7), np.float32), np.zeros((n, 3), np.float32)
        self.q, self.qd = torch.from_numpy(self._q), torch.from_numpy(self._qd)
        self.object_pose = torch.from_numpy(self._pose)
        self.object_velocity = torch.from_numpy(self._velocity)
        self._unreset: set[int] = set()
        self._obstacle_poses: list[list[list[float]] | None] = [None] * n
        self._loaded: list[BulletScene] = []
        resources = ExitStack()
        self._free = weakref.finalize(self, resources.close)
        try:
            folder = resources.enter_context(tempfile.TemporaryDirectory(prefix="morphgen-"))
            resources.callback(_close, self._loaded)
            self._exported = export_scenes(scenes, Path(folder))
            self._loaded.extend(map(self._load, range(n)))
            self._go_home()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Free the clients; a second call does nothing."""
        super().close()
        self._free()

    def _load(self, i: int) -> BulletScene:
        return BulletScene(self.scenes[i], self._exported[i], self._contacts)

    def _put(
        self,
        envs: NDArray[np.int64],
        q: Float32,
        object_pose: Float32,
        obstacle_poses: Float32 | None,
    ) -> None:
        for row, i in enumerate(envs.tolist()):
            scene = self.scenes[i]
            if obstacle_poses is not None:
                count = len(scene.obstacles)
                self._obstacle_poses[i] = obstacle_poses[row, :count].tolist()
            if i in self._unreset:
                self._loaded[i].close()  # numbers that are not finite stay in a client
                self._loaded[i] = self._load(i)
                self._unreset.remove(i)
            positions = movable_positions(scene.robot, q[row, : scene.robot.dof])
            self._loaded[i].reset(positions, object_pose[row].tolist(), self._obstacle_poses[i])
            self._q[i], self._qd[i] = q[row], 0
            if scene.object is not None:
                self._pose[i] = self._loaded[i].object_state()[FROM_BULLET]
                self._velocity[i] = 0

    def _advance(self) -> Collection[int]:
        """Step; a scene diverges if its state is not finite, or faster than ``MAX_VELOCITY``."""
        if self._unreset:
            where = self._label(min(self._unreset))
            raise SimulationError(f"{where} diverged; expected a reset before the next step")
        for i, (scene, loaded) in enumerate(zip(self.scenes, self._loaded, strict=True)):
            dof = scene.robot.dof
            q, qd = loaded.step(self._targets[i, :dof])
            self._q[i, :dof], self._qd[i, :dof] = q, qd
            is_sane = is_within(q, MAX_POSITION) and is_within(qd, MAX_VELOCITY)
            if scene.object is not None:
                state = loaded.object_state()
                self._pose[i], self._velocity[i] = state[FROM_BULLET], state[7:10]
                is_sane = is_sane and is_within(state, MAX_VELOCITY)
            if not is_sane:
                self._unreset.add(i)
        return self._unreset


def _close(loaded: Sequence[BulletScene]) -> None:
    for each in loaded:
        each.close()


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


SIMULATOR = Simulator(
    "pybullet",
    lambda scenes, contacts, *_: BulletSimulation(scenes, contacts),
    max_envs=128,  # an environment takes 36 MB
    takes_workers=False,
)

"""PyBullet as a simulator: a client for every environment, stepped one after the other."""

from __future__ import annotations

import tempfile
import weakref
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.formats.bundle import URDF, write_bundle
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.tasks.sim.articulated import ArticulatedObject, merge_rigid_links
from morphgen.tasks.sim.base import (
    CONTROL_PERIOD,
    SUBSTEPS,
    TIMESTEP,
    Contacts,
    HostSimulation,
    Scene,
    Simulator,
    clamp,
    constant,
    is_within,
)
from morphgen.tasks.sim.bullet_scene import (
    FROM_BULLET,
    VELOCITY_GAIN,
    BulletScene,
    Exported,
    MotorForces,
    limited_speeds,
)
from morphgen.typing import Array

MAX_VELOCITY = 1e4
"""Speed of joints and blocks [rad/s or m/s] and distance of blocks [m] that count as diverged."""
MAX_POSITION = float(np.finfo(np.float32).max)
"""Joint positions may be any finite number: continuous joints turn without end."""
_FINAL_RESPONSE = constant(1 - (1 - VELOCITY_GAIN) ** SUBSTEPS)
"""Fraction of a velocity change that motors have made at the end of a control step."""
_MEAN_RESPONSE = constant(
    1 - sum((1 - VELOCITY_GAIN) ** k for k in range(1, SUBSTEPS + 1)) / SUBSTEPS
)
"""Mean of that fraction over the physics steps of a control step."""
_RESPONSE, _BANDWIDTH, _TWO = map(constant, (TIMESTEP * BANDWIDTH, BANDWIDTH, 2))
_TIMESTEP, _SUBSTEPS, _PERIOD = map(constant, (TIMESTEP, SUBSTEPS, CONTROL_PERIOD))
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
            self._objects = [i for i, scene in enumerate(scenes) if scene.object is not None]
            self._index_joints()
            efforts = [effort for loaded in self._loaded for effort in loaded.efforts]
            self._forces = MotorForces([scene.robot for scene in scenes], efforts)
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

    def _index_joints(self) -> None:
        """Index targets and states in flat arrays of all scenes' joints.

        Every movable joint follows one independent joint, its leader, so its target is a product
        and a sum; a matrix product may round differently in another batch.
        """
        width = self._targets.shape[1]
        self._flat_q, self._flat_qd = self._q.reshape(-1), self._qd.reshape(-1)
        source: list[int] = []
        gain: list[float] = []
        offset: list[float] = []
        fastest: list[float] = []
        leaders: list[int] = []
        independent: list[int] = []
        sink: list[int] = []
        self._spans: list[slice] = []
        for i, scene in enumerate(self.scenes):
            robot, start = scene.robot, len(offset)
            matrix, shift = robot.mimic_map
            self._spans.append(slice(start, start + len(shift)))
            if robot.dof:
                leader = np.abs(matrix).argmax(axis=1)  # a row has one number that is not zero
                source.extend((i * width + leader).tolist())
                gain.extend(matrix[np.arange(len(matrix)), leader].tolist())
                rows = robot.independent_rows
                leaders.extend(start + row for row in np.array(rows)[leader].tolist())
            offset.extend(shift.tolist())
            fastest.extend(limited_speeds(robot))
            independent.extend(start + row for row in robot.independent_rows)
            sink.extend(range(i * width, i * width + robot.dof))
        self._source = _consecutive(np.array(source, np.intp))
        self._sink = _consecutive(np.array(sink, np.intp))
        self._gain, self._offset = np.array(gain), np.array(offset)
        self._leaders = np.array(leaders, np.intp)
        self._fastest = np.array(fastest)
        self._independent = _consecutive(np.array(independent, np.intp))
        self._positions, self._velocities, self._measured = np.zeros((3, len(offset)))

    def _put(
        self,
        envs: NDArray[np.int64],
        q: Float32,
        object_pose: Float32,
        obstacle_poses: Float32 | None,
    ) -> None:
        for row, (i, positions, pose) in enumerate(zip(envs.tolist(), q, object_pose, strict=True)):
            scene, span = self.scenes[i], self._spans[i]
            if obstacle_poses is not None:
                count = len(scene.obstacles)
                self._obstacle_poses[i] = obstacle_poses[row, :count].tolist()
            if i in self._unreset:
                self._loaded[i].close()  # numbers that are not finite stay in a client
                self._loaded[i] = self._load(i)
                self._unreset.remove(i)
            loaded = self._loaded[i]
            self._positions[span] = movable_positions(scene.robot, positions[: scene.robot.dof])
            self._velocities[span], self._measured[span] = 0, 0
            loaded.reset(self._positions[span].tolist(), pose.tolist(), self._obstacle_poses[i])
            self._q[i], self._qd[i] = positions, 0
            if scene.object is not None:
                self._pose[i] = np.array(loaded.object_state()[:7])[FROM_BULLET]
                self._velocity[i] = 0

    def _advance(self) -> Collection[int]:
        """Step; a scene diverges if its state is not finite, or faster than ``MAX_VELOCITY``."""
        if self._unreset:
            where = self._label(min(self._unreset))
            raise SimulationError(f"{where} diverged; expected a reset before the next step")
        desired = self._targets.reshape(-1)[self._source] * self._gain + self._offset
        ends, last = self._undisturbed(desired)
        mean = (ends - self._positions) / _PERIOD
        commanded = self._measured + (mean - self._measured) / _MEAN_RESPONSE
        commanded = clamp(commanded, self._fastest)
        velocities: list[float] = commanded.tolist()
        limits = self._forces.limits(
            (desired - self._positions, desired - ends), (self._velocities, last)
        )
        forces: list[float] = (limits / _SUBSTEPS).tolist()
        states: list[tuple[float, float]] = []
        for loaded, span in zip(self._loaded, self._spans, strict=True):
            loaded.step(velocities[span], forces[span])
            states += loaded.joint_states()
        self._positions = np.array([state[0] for state in states])
        before, self._measured = self._measured, np.array([state[1] for state in states])
        expected = before + (commanded - before) * _FINAL_RESPONSE
        self._velocities = last + (self._measured - expected)
        q, qd = self._positions[self._independent], self._measured[self._independent]
        self._flat_q[self._sink], self._flat_qd[self._sink] = q, qd
        is_sane = is_within(q, MAX_POSITION) and is_within(qd, MAX_VELOCITY)
        if self._objects:
            blocks = np.array([self._loaded[i].object_state() for i in self._objects])
            self._pose[self._objects] = blocks[:, FROM_BULLET]
            self._velocity[self._objects] = blocks[:, 7:10]
            is_sane = is_sane and is_within(blocks, MAX_VELOCITY)
        self._unreset = set() if is_sane else set(self._find_diverged())
        return self._unreset

    def _undisturbed(self, desired: Array) -> tuple[Array, Array]:
        """Return positions and velocities at the end of a control step without disturbances.

        Integrates the critically damped law of ``morphgen.model.dynamics`` in physics steps. Effort
        limits and contacts are not modelled: they show in the velocity that is measured afterwards,
        and carry over to the next step.
        """
        q, v = self._positions, self._velocities
        fastest, slowest = self._fastest, -self._fastest
        for _ in range(SUBSTEPS):
            v = v + _RESPONSE * (_BANDWIDTH * (desired - q) - _TWO * v)
            v = np.minimum(np.maximum(v, slowest), fastest)
            q = q + _TIMESTEP * v
        # Mimic joints follow where their leaders are: a leader at its effort limit is late.
        return q[self._leaders] * self._gain + self._offset, v[self._leaders] * self._gain

    def _find_diverged(self) -> Iterator[int]:
        for i, (q, qd) in enumerate(zip(self._q, self._qd, strict=True)):
            block = np.array(self._loaded[i].object_state() if i in self._objects else [0.0])
            joints = is_within(q, MAX_POSITION) and is_within(qd, MAX_VELOCITY)
            if not (joints and is_within(block, MAX_VELOCITY)):
                yield i


def _close(loaded: Sequence[BulletScene]) -> None:
    for each in loaded:
        each.close()


def _consecutive(indices: NDArray[np.intp]) -> NDArray[np.intp] | slice:
    """Return indices as a slice if they are consecutive: they select the same, in less time."""
    first = int(indices[0]) if len(indices) else 0
    is_slice = np.array_equal(indices, np.arange(first, first + len(indices)))
    return slice(first, first + len(indices)) if is_slice else indices


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

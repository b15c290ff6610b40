"""Scenes in PyBullet that step one after the other and write into shared buffers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import SimulationError
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP, Contacts, Scene
from morphgen.tasks.sim.bullet_scene import VELOCITY_GAIN, BulletScene
from morphgen.tasks.sim.motor_law import MotorForces, limited_speeds
from morphgen.tasks.sim.short_arrays import clamp, consecutive, is_within
from morphgen.typing import Array

MAX_VELOCITY = 1e4
"""Speed of joints and blocks [rad/s or m/s] and distance of blocks [m] that count as diverged."""
MAX_POSITION = float(np.finfo(np.float32).max)
"""Joint positions may be any finite number: continuous joints turn without end."""
_FROM_BULLET = [0, 1, 2, 6, 3, 4, 5]
"""Columns of a pose in morphgen's order: PyBullet's quaternions have w last."""
Float32 = NDArray[np.float32]
ExportedRobot = tuple[Path, Robot]
"""URDF of a robot whose rigid links are merged, and that robot."""


@dataclass(frozen=True, eq=False)
class StateBuffers:
    """State of a simulation, a row for each environment."""

    q: Float32
    """Positions of the independent joints, shape (n, J) [rad or m]."""
    qd: Float32
    """Velocities of the independent joints, shape (n, J) [rad/s or m/s]."""
    block_pose: Float32
    """Poses of the blocks, shape (n, 7)."""
    block_velocity: Float32
    """Linear and angular velocities of the blocks, shape (n, 6) [m/s, rad/s]."""


@dataclass(frozen=True)
class Share:
    """Environments that one process simulates."""

    scenes: Sequence[Scene]
    contacts: Contacts
    """Pairs of things that collide."""
    exported: Sequence[ExportedRobot]
    """Robot of each scene, as ``export_robots`` wrote it."""
    envs: Sequence[int]
    """Index of each scene's environment, which is its row in all buffers."""


_FINAL_RESPONSE = 1 - (1 - VELOCITY_GAIN) ** SUBSTEPS
"""Fraction of a velocity change that motors have made at the end of a control step."""
_MEAN_RESPONSE = 1 - sum((1 - VELOCITY_GAIN) ** k for k in range(1, SUBSTEPS + 1)) / SUBSTEPS
"""Mean of that fraction over the physics steps of a control step."""


class BulletBatch:
    """Scenes that step one after the other and write their states into buffers."""

    def __init__(self, share: Share, buffers: StateBuffers) -> None:
        """Load every scene, its robot at zero.

        Args:
            share: Environments to load.
            buffers: Buffers with rows for all environments; padding is not written.

        Raises:
            SimulationError: If PyBullet cannot hold a scene.
        """
        scenes = share.scenes
        self._share, self._scenes = share, scenes
        self._buffers, self._envs = buffers, list(share.envs)
        self._index = {env: i for i, env in enumerate(self._envs)}
        self._num_steps = 0
        self._num_steps_at_reset = [0] * len(scenes)
        self._diverged: dict[int, str] = {}
        self._obstacle_poses: list[list[list[float]] | None] = [None] * len(scenes)
        self._loaded: list[BulletScene] = []
        try:
            self._loaded.extend(map(self._load, range(len(scenes))))
        except BaseException:
            self.close()
            raise
        self._blocks = [i for i, scene in enumerate(scenes) if scene.block is not None]
        self._block_rows = [self._envs[i] for i in self._blocks]
        self._index_joints()
        efforts = [effort for loaded in self._loaded for effort in loaded.efforts]
        self._forces = MotorForces([scene.robot for scene in scenes], efforts)

    def _load(self, i: int) -> BulletScene:
        urdf, merged = self._share.exported[i]
        return BulletScene(self._scenes[i], urdf, merged, self._share.contacts)

    def _index_joints(self) -> None:
        """Index targets and states in flat arrays of all environments' joints.

        Every movable joint follows one independent joint, its leader, so its target is a product
        and a sum; a matrix product may round differently in another batch.
        """
        width = self._buffers.q.shape[1]
        self._flat_q, self._flat_qd = self._buffers.q.reshape(-1), self._buffers.qd.reshape(-1)
        source: list[int] = []
        gain: list[float] = []
        offset: list[float] = []
        fastest: list[float] = []
        leaders: list[int] = []
        independent: list[int] = []
        sink: list[int] = []
        self._spans: list[slice] = []
        for env, scene in zip(self._envs, self._scenes, strict=True):
            robot, start = scene.robot, len(offset)
            matrix, shift = robot.mimic_map
            self._spans.append(slice(start, start + len(shift)))
            if robot.dof:
                leader = np.abs(matrix).argmax(axis=1)
                source.extend((env * width + leader).tolist())
                gain.extend(matrix[np.arange(len(matrix)), leader].tolist())
                rows = [robot.movable_joints.index(k) for k in robot.independent_joints]
                leaders.extend(start + row for row in np.array(rows)[leader].tolist())
            offset.extend(shift.tolist())
            fastest.extend(limited_speeds(robot))
            independent.extend(
                start + robot.movable_joints.index(k) for k in robot.independent_joints
            )
            sink.extend(range(env * width, env * width + robot.dof))
        self._source = consecutive(np.array(source, np.intp))
        self._sink = consecutive(np.array(sink, np.intp))
        self._gain, self._offset = np.array(gain), np.array(offset)
        self._leaders = np.array(leaders, np.intp)
        self._fastest = np.array(fastest)
        self._independent = consecutive(np.array(independent, np.intp))
        self._positions, self._velocities = np.zeros(len(offset)), np.zeros(len(offset))
        self._measured = np.zeros(len(offset))

    def reset(
        self,
        envs: NDArray[np.int64],
        q: Float32,
        block_pose: Float32,
        obstacle_poses: Float32 | None,
    ) -> None:
        """Put some environments at rest and clear their history; see ``Simulation.reset``.

        Raises:
            SimulationError: If an environment that had diverged cannot be loaded again.
        """
        buffers = self._buffers
        for row, (env, positions, pose) in enumerate(
            zip(envs.tolist(), q, block_pose, strict=True)
        ):
            i = self._index[env]
            if obstacle_poses is not None:
                count = len(self._scenes[i].obstacles)
                self._obstacle_poses[i] = obstacle_poses[row, :count].tolist()
            scene = self._scenes[i]
            positions = positions[: scene.robot.dof]
            if self._diverged.pop(env, None) is not None:
                self._loaded[i].close()
                self._loaded[i] = self._load(i)
            loaded, span = self._loaded[i], self._spans[i]
            self._positions[span] = movable_positions(scene.robot, positions)
            self._velocities[span], self._measured[span] = 0, 0
            loaded.reset(self._positions[span].tolist(), pose.tolist(), self._obstacle_poses[i])
            buffers.q[env, : scene.robot.dof] = positions
            buffers.qd[env] = 0
            if scene.block is not None:
                buffers.block_pose[env] = np.array(loaded.block_state()[:7])[_FROM_BULLET]
                buffers.block_velocity[env] = 0
            self._num_steps_at_reset[i] = self._num_steps

    def step(self, targets: Float32) -> dict[int, str]:
        """Advance the environments by one control step; see ``Simulation.step``.

        Args:
            targets: Targets of all environments, shape (n, J), contiguous and finite.

        Returns:
            The reason for each environment that diverged: not finite, or beyond ``MAX_VELOCITY``.

        Raises:
            SimulationError: If an environment diverged before and was not reset.
        """
        if self._diverged:
            reason = next(iter(self._diverged.values()))
            raise SimulationError(f"{reason}; expected a reset before the next step")
        desired = targets.reshape(-1)[self._source] * self._gain + self._offset
        ends, last = self._undisturbed(desired)
        mean = (ends - self._positions) / (SUBSTEPS * TIMESTEP)
        commanded = self._measured + (mean - self._measured) / _MEAN_RESPONSE
        commanded = clamp(commanded, self._fastest)
        velocities: list[float] = commanded.tolist()
        limits = self._forces.limits(
            (desired - self._positions, desired - ends), (self._velocities, last)
        )
        forces: list[float] = (limits / SUBSTEPS).tolist()
        states: list[tuple[float, float]] = []
        self._num_steps += 1
        for loaded, span in zip(self._loaded, self._spans, strict=True):
            loaded.step(velocities[span], forces[span])
            states += loaded.joint_states()
        buffers = self._buffers
        self._positions = np.array([state[0] for state in states])
        before, self._measured = self._measured, np.array([state[1] for state in states])
        expected = before + (commanded - before) * _FINAL_RESPONSE
        self._velocities = last + (self._measured - expected)
        q, qd = self._positions[self._independent], self._measured[self._independent]
        self._flat_q[self._sink], self._flat_qd[self._sink] = q, qd
        is_sane = is_within(q, MAX_POSITION) and is_within(qd, MAX_VELOCITY)
        if self._blocks:
            blocks = np.array([self._loaded[i].block_state() for i in self._blocks])
            buffers.block_pose[self._block_rows] = blocks[:, _FROM_BULLET]
            buffers.block_velocity[self._block_rows] = blocks[:, 7:]
            is_sane = is_sane and is_within(blocks, MAX_VELOCITY)
        if not is_sane:
            self._find_diverged()
        return dict(self._diverged)

    def movable_q(self, env: int) -> Array:
        """Return the positions of all movable joints of an environment, mimic joints included."""
        return self._positions[self._spans[self._index[env]]].copy()

    def _undisturbed(
        self, desired: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return positions and velocities at the end of a control step without disturbances.

        Integrates the critically damped law of ``morphgen.model.dynamics`` in physics steps.
        Effort limits and contacts are not modelled: they show in the velocity that is measured
        afterwards, and carry over to the next step. Mimic joints follow where their leaders are,
        not the leaders' targets: a leader at its effort limit is late.
        """
        q, v = self._positions, self._velocities
        fastest, slowest = self._fastest, -self._fastest
        for _ in range(SUBSTEPS):
            v = v + TIMESTEP * BANDWIDTH * (BANDWIDTH * (desired - q) - 2 * v)
            v = np.minimum(np.maximum(v, slowest), fastest)
            q = q + TIMESTEP * v
        return q[self._leaders] * self._gain + self._offset, v[self._leaders] * self._gain

    def _find_diverged(self) -> None:
        """Record the environments that diverged, with their state as the reason."""
        buffers = self._buffers
        for i, env in enumerate(self._envs):
            q, qd, pose = buffers.q[env], buffers.qd[env], buffers.block_pose[env]
            velocity, name = buffers.block_velocity[env], self._scenes[i].robot.name
            joints = is_within(q, MAX_POSITION) and is_within(qd, MAX_VELOCITY)
            if not (joints and is_within(pose, MAX_VELOCITY) and is_within(velocity, MAX_VELOCITY)):
                steps = self._num_steps - self._num_steps_at_reset[i]
                self._diverged[env] = (
                    f"environment {env} ({name!r}) diverged in step {steps} after its "
                    f"reset: q {q.tolist()}, qd {qd.tolist()}, block {pose.tolist()}"
                )

    def close(self) -> None:
        """Free every scene; a second call does nothing."""
        for loaded in self._loaded:
            loaded.close()

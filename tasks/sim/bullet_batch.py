"""Scenes in PyBullet that step one after the other and report into rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.errors import DivergedError
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP, Contacts, Scene
from morphgen.tasks.sim.bullet_scene import VELOCITY_GAIN, BulletScene
from morphgen.tasks.sim.motor_law import MotorForces

MAX_VELOCITY = 1e4
"""Joints and blocks that are faster (rad/s or m/s), or blocks that are so far, have exploded."""
MAX_POSITION = float(np.finfo(np.float32).max)
"""Joints may turn as often as they like."""
_FROM_BULLET = [0, 1, 2, 6, 3, 4, 5]
"""PyBullet's quaternions have w last."""
Float32 = NDArray[np.float32]
Exported = tuple[Path, Robot]
"""URDF and rigid bodies of a robot."""


@dataclass(frozen=True, eq=False)
class Rows:
    """What a simulation reports, one row for each environment."""

    q: Float32
    """Shape (n, J)."""
    qd: Float32
    """Shape (n, J)."""
    block_pose: Float32
    """Shape (n, 7)."""
    block_velocity: Float32
    """Shape (n, 6)."""


_TAKEN_AT_END = 1 - (1 - VELOCITY_GAIN) ** SUBSTEPS
"""Share of a change of velocity that motors have made at the end of a control step."""
_TAKEN = 1 - sum((1 - VELOCITY_GAIN) ** k for k in range(1, SUBSTEPS + 1)) / SUBSTEPS
"""The same in the mean over its physics steps."""


class BulletBatch:
    """Scenes that step one after the other and report into rows."""

    def __init__(
        self,
        scenes: Sequence[Scene],
        contacts: Contacts,
        exported: Sequence[Exported],
        rows: Rows,
        envs: Sequence[int],
    ) -> None:
        """Load every scene, its robot at zero.

        Args:
            scenes: Some of the scenes.
            contacts: What may touch what.
            exported: The robot of each of them, as ``export_robots`` wrote it.
            rows: Where to report, with rows for all scenes; padding is left alone.
            envs: The environment, and so the row, of each of ``scenes``.

        Raises:
            SimulationError: If PyBullet cannot hold a scene.
        """
        self._scenes, self._contacts, self._exported = scenes, contacts, exported
        self._rows, self._envs = rows, list(envs)
        self._index = {env: i for i, env in enumerate(envs)}
        self._steps = np.zeros(len(scenes), np.int64)
        self._unstable: dict[int, str] = {}
        self._loaded: list[BulletScene] = []
        try:
            self._loaded.extend(map(self._load, range(len(scenes))))
        except BaseException:
            self.close()
            raise
        self._blocks = [i for i, scene in enumerate(scenes) if scene.block is not None]
        self._block_rows = [self._envs[i] for i in self._blocks]
        self._plan()
        efforts = [effort for loaded in self._loaded for effort in loaded.efforts]
        self._forces = MotorForces([scene.robot for scene in scenes], efforts)

    def _load(self, i: int) -> BulletScene:
        urdf, body = self._exported[i]
        return BulletScene(self._scenes[i], urdf, body, self._contacts)

    def _plan(self) -> None:
        """Where targets are found and states go to, in flat arrays of all environments.

        Every movable joint follows one independent joint, so its target is a product and a sum;
        a matrix product may round differently in another batch.
        """
        width = self._rows.q.shape[1]
        source: list[int] = []
        gain: list[float] = []
        offset: list[float] = []
        fastest: list[float] = []
        kept: list[int] = []
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
            offset.extend(shift.tolist())
            fastest.extend(robot.joints[k].velocity or np.inf for k in robot.movable_joints)
            kept.extend(start + robot.movable_joints.index(k) for k in robot.independent_joints)
            sink.extend(range(env * width, env * width + robot.dof))
        self._source, self._sink = np.array(source, np.intp), np.array(sink, np.intp)
        self._gain, self._offset = np.array(gain), np.array(offset)
        self._fastest, self._kept = np.array(fastest), np.array(kept, np.intp)
        self._positions, self._velocities = np.zeros(len(offset)), np.zeros(len(offset))
        self._found = np.zeros(len(offset))

    def reset(self, envs: NDArray[np.int64], q: Float32, block_pose: Float32) -> None:
        """Put some environments at rest, without a past; as ``Simulation.reset``.

        Raises:
            SimulationError: If an environment that had exploded cannot be loaded again.
        """
        rows = self._rows
        for env, positions, pose in zip(envs.tolist(), q, block_pose, strict=True):
            i = self._index[env]
            scene = self._scenes[i]
            positions = positions[: scene.robot.dof]
            if self._unstable.pop(env, None) is not None:
                self._loaded[i].close()
                self._loaded[i] = self._load(i)
            loaded, span = self._loaded[i], self._spans[i]
            self._positions[span] = movable_positions(scene.robot, positions)
            self._velocities[span], self._found[span] = 0, 0
            loaded.reset(self._positions[span].tolist(), pose.tolist())
            rows.q[env, : scene.robot.dof] = positions
            rows.qd[env] = 0
            if scene.block is not None:
                rows.block_pose[env] = np.array(loaded.block_state()[:7])[_FROM_BULLET]
                rows.block_velocity[env] = 0
            self._steps[i] = 0

    def step(self, targets: Float32) -> None:
        """Move its environments by one control step; as ``Simulation.step``.

        Args:
            targets: Of all environments, shape (n, J), contiguous and finite.

        Raises:
            DivergedError: If environments are unstable: not finite, or beyond ``MAX_VELOCITY``.
                All have stepped; these must be reset before the next step.
        """
        self._require_stable()
        wanted = targets.reshape(-1)[self._source] * self._gain + self._offset
        ends, last = self._law(wanted)
        mean = (ends - self._positions) / (SUBSTEPS * TIMESTEP)
        asked = self._found + (mean - self._found) / _TAKEN
        asked = np.clip(asked, -self._fastest, self._fastest)
        velocities: list[float] = asked.tolist()
        limits = self._forces.limits(
            (wanted - self._positions, wanted - ends), (self._velocities, last)
        )
        forces: list[float] = (limits / SUBSTEPS).tolist()
        states: list[tuple[float, float]] = []
        for loaded, span in zip(self._loaded, self._spans, strict=True):
            loaded.step(velocities[span], forces[span])
            states += loaded.joint_states()
        self._steps += 1
        rows = self._rows
        self._positions = np.array([state[0] for state in states])
        before, self._found = self._found, np.array([state[1] for state in states])
        expected = before + (asked - before) * _TAKEN_AT_END
        self._velocities = last + (self._found - expected)
        q, qd = self._positions[self._kept], self._found[self._kept]
        rows.q.reshape(-1)[self._sink], rows.qd.reshape(-1)[self._sink] = q, qd
        blocks = np.array([self._loaded[i].block_state() for i in self._blocks]).reshape(-1, 13)
        if self._blocks:
            rows.block_pose[self._block_rows] = blocks[:, _FROM_BULLET]
            rows.block_velocity[self._block_rows] = blocks[:, 7:]
        if not (_sane(q, MAX_POSITION) and _sane(qd, MAX_VELOCITY) and _sane(blocks, MAX_VELOCITY)):
            self._find_unstable()
            self._require_stable()

    def _law(self, wanted: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Positions and velocities at the end of a control step.

        The critically damped law of ``morphgen.model.dynamics``, physics step by physics step, as
        if nothing else moved the joints. What does, an effort or a contact, shows in the velocity
        that is found afterwards, and carries over to the next step.
        """
        q, v = self._positions, self._velocities
        for _ in range(SUBSTEPS):
            v = v + TIMESTEP * BANDWIDTH * (BANDWIDTH * (wanted - q) - 2 * v)
            v = np.clip(v, -self._fastest, self._fastest)
            q = q + TIMESTEP * v
        return q, v

    def _find_unstable(self) -> None:
        rows = self._rows
        for i, env in enumerate(self._envs):
            q, qd, pose = rows.q[env], rows.qd[env], rows.block_pose[env]
            velocity = rows.block_velocity[env]
            joints = _sane(q, MAX_POSITION) and _sane(qd, MAX_VELOCITY)
            if not (joints and _sane(pose, MAX_VELOCITY) and _sane(velocity, MAX_VELOCITY)):
                self._unstable[env] = (
                    f"{self._name(i)} became unstable in step {self._steps[i]} after its reset: "
                    f"q {q.tolist()}, qd {qd.tolist()}, block {pose.tolist()}"
                )

    def _require_stable(self) -> None:
        if self._unstable:
            raise DivergedError(self._unstable)

    def _name(self, i: int) -> str:
        return f"environment {self._envs[i]} ({self._scenes[i].robot.name!r})"

    def close(self) -> None:
        """Free every scene; a second time does nothing."""
        for loaded in self._loaded:
            loaded.close()


def _sane(values: ArrayLike, largest: float) -> bool:
    """Whether all are finite and none is larger; not a number compares as false."""
    return bool(np.abs(values).max(initial=0.0) <= largest)


def most_joints(scenes: Sequence[Scene]) -> int:
    """J, the largest number of independent joints."""
    return max((scene.robot.dof for scene in scenes), default=0)

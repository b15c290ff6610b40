"""Minimal simulations of one fixed-base robot in MuJoCo and PyBullet, with or without a table."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from morphgen.formats.bundle import URDF, write_bundle
from morphgen.formats.mjcf.write import TIMESTEP, to_spec
from morphgen.formats.quiet import quiet
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import DEFAULT_EFFORT, Robot
from morphgen.typing import Array

TABLE_SIZE = (3.0, 3.0, 0.5)
"""Edge lengths of the table, centred below the root link [m]."""


class World(Protocol):
    """One robot in one simulator."""

    load_seconds: float
    """Time in which the simulator loaded its model [s]."""

    def reset(self) -> None:
        """Set the home configuration with zero velocities."""

    def hold(self, target: Array, steps: int) -> None:
        """Run simulation steps with target positions of the independent joints, shape (dof,)."""

    def touches(self) -> bool:
        """Return whether any contact exists."""

    def is_stable(self) -> bool:
        """Return whether the state has stayed finite since the reset."""

    def close(self) -> None:
        """Release the simulator."""


Make = Callable[..., World]
"""Create a world from a robot and the height of the table top [m], or None for no table."""


class MujocoWorld:
    """A robot simulated in MuJoCo from its MJCF."""

    def __init__(self, robot: Robot, table_top: float | None) -> None:
        spec = to_spec(robot)
        if table_top is not None:
            spec.worldbody.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                size=[edge / 2 for edge in TABLE_SIZE],
                pos=[0, 0, table_top - TABLE_SIZE[2] / 2],
            )
        start = time.perf_counter()
        self._model = spec.compile()
        self.load_seconds = time.perf_counter() - start
        self._data = mujoco.MjData(self._model)

    def reset(self) -> None:
        """Set the home configuration with zero velocities."""
        mujoco.mj_resetDataKeyframe(self._model, self._data, 0)

    def hold(self, target: Array, steps: int) -> None:
        """Run simulation steps with target positions of the independent joints, shape (dof,)."""
        self._data.ctrl[:] = target
        mujoco.mj_step(self._model, self._data, nstep=steps)

    def touches(self) -> bool:
        """Return whether any contact exists."""
        return bool(self._data.ncon > 0)

    def is_stable(self) -> bool:
        """Return whether the state has stayed finite since the reset."""
        return not self._data.warning.number.any()

    def close(self) -> None:
        """Release the simulator."""
        del self._data, self._model


class PybulletWorld:
    """A robot simulated in PyBullet from its URDF, without contacts of its ignored pairs."""

    def __init__(self, robot: Robot, table_top: float | None) -> None:
        with quiet(), tempfile.TemporaryDirectory() as scratch:
            import pybullet

            self._bullet, self._robot = pybullet, robot
            self._client = {"physicsClientId": pybullet.connect(pybullet.DIRECT)}
            folder = write_bundle(robot, Path(scratch) / robot.name, picture=False)
            start = time.perf_counter()
            self._body = pybullet.loadURDF(
                str(folder / URDF),
                useFixedBase=True,
                flags=pybullet.URDF_USE_SELF_COLLISION | pybullet.URDF_USE_IMPLICIT_CYLINDER,
                **self._client,
            )
            self.load_seconds = time.perf_counter() - start
        pybullet.setTimeStep(TIMESTEP, **self._client)
        count = pybullet.getNumJoints(self._body, **self._client)
        infos = [pybullet.getJointInfo(self._body, i, **self._client) for i in range(count)]
        joints = {info[1].decode(): info[0] for info in infos}
        links = {robot.root.name: -1} | {info[12].decode(): info[0] for info in infos}
        movable = [robot.joints[k] for k in robot.movable_joints]
        self._joints = [joints[joint.name] for joint in movable]
        self._efforts = [joint.effort or DEFAULT_EFFORT for joint in movable]
        for a, b in robot.ignore_pairs:
            self._ignore(links[a], self._body, links[b])
        if table_top is not None:
            half = [edge / 2 for edge in TABLE_SIZE]
            box = pybullet.createCollisionShape(pybullet.GEOM_BOX, halfExtents=half, **self._client)
            centre = [0, 0, table_top - half[2]]
            # Neither does MuJoCo test the fixed root link against the table.
            self._ignore(
                -1, pybullet.createMultiBody(0, box, basePosition=centre, **self._client), -1
            )

    def reset(self) -> None:
        """Set the home configuration with zero velocities."""
        home = movable_positions(self._robot, self._robot.home).tolist()
        for joint, position in zip(self._joints, home, strict=True):
            self._bullet.resetJointState(self._body, joint, position, **self._client)

    def hold(self, target: Array, steps: int) -> None:
        """Run simulation steps with target positions of the independent joints, shape (dof,)."""
        self._bullet.setJointMotorControlArray(
            self._body,
            self._joints,
            self._bullet.POSITION_CONTROL,
            targetPositions=movable_positions(self._robot, target).tolist(),
            forces=self._efforts,
            **self._client,
        )
        for _ in range(steps):
            self._bullet.stepSimulation(**self._client)

    def touches(self) -> bool:
        """Return whether any contact exists."""
        normal_force = 9
        points = self._bullet.getContactPoints(**self._client)
        return any(point[normal_force] > 0 for point in points)

    def is_stable(self) -> bool:
        """Return whether the state has stayed finite since the reset."""
        states = self._bullet.getJointStates(self._body, self._joints, **self._client)
        return bool(np.isfinite([state[:2] for state in states]).all())

    def close(self) -> None:
        """Release the simulator."""
        self._bullet.disconnect(**self._client)

    def _ignore(self, link: int, other_body: int, other_link: int) -> None:
        self._bullet.setCollisionFilterPair(
            self._body, other_body, link, other_link, 0, **self._client
        )

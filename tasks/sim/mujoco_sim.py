"""MuJoCo as a simulator: one ``MjData`` for every environment, stepped by threads."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise

import mujoco
import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.formats.quiet import MujocoWarnings
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.kinematics import movable_positions
from morphgen.tasks.sim.articulated import ObjectJoints
from morphgen.tasks.sim.base import (
    CONTROL_PERIOD,
    CONTROL_STEP,
    GAIN,
    SUBSTEPS,
    Contacts,
    HostSimulation,
    Scene,
    Simulator,
    clamp,
    constant,
    farthest_targets,
    is_within,
)
from morphgen.tasks.sim.mujoco_model import PASSIVE, World, worlds
from morphgen.typing import Array

MAX_SPEED = 1e4  # speed above which a simulation counts as diverged [rad/s or m/s]


class GatheredArrays:
    """Arrays of all environments, copied one after the other into one array.

    One call copies them all: a call for every environment would take a tenth of its physics. The
    last element is a zero, for padding.
    """

    def __init__(self, arrays: Sequence[Array]) -> None:
        self._arrays = [*arrays, np.zeros(1)]
        ends = np.cumsum([len(array) for array in self._arrays])
        self.begin = np.concatenate([[0], ends[:-1]])  # index in `flat` where each array begins
        self.flat = np.zeros(ends[-1])

    def read(self) -> None:
        """Copy the arrays into ``flat``."""
        np.concatenate(self._arrays, out=self.flat)


class MujocoState:
    """Tensors of joints and blocks, gathered from the data of all environments at once."""

    def __init__(self, worlds: Sequence[World], data: Sequence[mujoco.MjData]) -> None:
        n, joints = len(worlds), max(world.robot.dof for world in worlds)
        positions = [env_data.qpos for env_data in data]
        velocities = [*(env_data.qvel for env_data in data), np.zeros(1)]
        warnings = [env_data.warning.number for env_data in data]
        self._numbers = GatheredArrays([*positions, *velocities, *warnings])  # one call reads all
        begin = self._numbers.begin
        self._begin = (begin[n : 2 * n + 1] - begin[n]).tolist()
        self.velocities = self._numbers.flat[begin[n] : begin[2 * n + 1]]
        """``qvel`` of all environments at the last ``read``, concatenated, and a zero."""
        self._warnings = self._numbers.flat[begin[2 * n + 1] : -1].reshape(n, -1)
        self._joints_at = np.full((2, n, joints), -1)
        self._block_at = np.full((n, 10), -1)  # pose and linear velocity
        for i, world in enumerate(worlds):
            dof = world.robot.dof
            self._joints_at[0, i, :dof] = begin[i] + world.q_at
            self._joints_at[1, i, :dof] = begin[n + i] + world.qd_at
            if len(world.block_q_at):
                self._block_at[i, :7] = begin[i] + world.block_q_at
                self._block_at[i, 7:] = begin[n + i] + world.block_qd_at
        objects = {i: world.object for i, world in enumerate(worlds) if world.object is not None}
        self._articulated = [*objects]
        self._object_at = [begin[i] + worlds[i].object_q_at[0] for i in objects]
        self._object_joints = ObjectJoints([*objects.values()]) if objects else None
        self._has_blocks = bool((self._block_at >= 0).any())
        self._joints = np.zeros((2, n, joints), np.float32)
        self._object_pose = np.zeros((n, 7), np.float32)
        self._object_velocity = np.zeros((n, 3), np.float32)
        self.joints = np.zeros((2, n, joints))
        """Joint positions and velocities at the last ``read``, shape (2, n, J)."""
        self.q, self.qd = map(torch.from_numpy, self._joints)
        self.object_pose = torch.from_numpy(self._object_pose)
        self.object_velocity = torch.from_numpy(self._object_velocity)

    def read(self) -> None:
        """Update the tensors from the data."""
        self._numbers.read()
        self.joints = self._numbers.flat[self._joints_at]
        self._joints[:] = self.joints
        if self._has_blocks:
            blocks = self._numbers.flat[self._block_at]
            quaternion = blocks[:, 3:7]
            quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)  # w >= 0, as everywhere
            self._object_pose[:], self._object_velocity[:] = blocks[:, :7], blocks[:, 7:]
        if self._object_joints is not None:
            positions = self._numbers.flat[self._object_at]
            self._object_pose[self._articulated] = self._object_joints.poses(positions)

    def diverged(self) -> list[int]:
        """Return the environments that diverged, or warned, up to the last ``read``."""
        warnings = self._warnings
        if is_within(self.velocities, MAX_SPEED) and is_within(warnings, 0):
            return []
        speeds = np.abs(self.velocities)
        slow = [bool((speeds[a:b] <= MAX_SPEED).all()) for a, b in pairwise(self._begin)]
        found: list[int] = np.flatnonzero(~np.array(slow) | warnings.any(axis=1)).tolist()
        return found


BY_ERROR = constant(CONTROL_STEP[1, 0] / CONTROL_PERIOD)
BY_VELOCITY = constant((CONTROL_STEP[1, 1] - 1) / CONTROL_PERIOD)
"""Mean acceleration in a control step per unit of initial error and initial velocity."""
_STIFFNESS = constant(GAIN * BANDWIDTH**2)
_PASSIVE_DELAY = constant(PASSIVE * 2 / BANDWIDTH)
"""Acceleration per error, and passive damping per acceleration of an error, of a joint alone."""


class PositionControl:
    """Controls that make every joint follow the law of ``morphgen.model.dynamics``.

    An actuator whose gains assume the joint's own inertia at home follows the law at home, as long
    as nothing else moves. The missing force M(q) a - I a + c(q, v), with the law's acceleration a,
    the joint-space inertia M, the inertia I that the gains assume and Coriolis forces c, is added
    through the targets (inverse dynamics control; Siciliano et al. 2009, 8.5.2). It is computed
    once per control step, with the mean of a over the step; the actuator does the rest in every
    physics step. The actuator's effort limits the sum. With the gains alone, arms would leave the
    path of the law by centimetres within a second.

    A joint's speed limit v keeps its target within ``LAG`` v of its position. A target that moves
    no faster is never farther away; one that is, because something holds the joint, does not pull
    harder.

    MuJoCo drops the implicit damping of an actuator at its effort limit. Light links at the end of
    a long chain with a strong motor then diverge at a time step of 5 ms. So the fraction
    ``PASSIVE`` of the damping belongs to the joints, which have no limit, and a torque compensates
    it at the velocity with which the control step began.
    """

    def __init__(self, worlds: Sequence[World], data: Sequence[mujoco.MjData], joints: int) -> None:
        self._shape = (len(worlds), joints)
        bias = [env_data.qfrc_bias for env_data in data]
        weight = [env_data.qfrc_gravcomp for env_data in data]
        self._data_forces = GatheredArrays([*bias, np.zeros(1), *weight])  # one call reads both
        self._bias, self._weight = np.split(self._data_forces.flat, 2)
        self._applied, self._acceleration, self._force = np.zeros((3, len(self._bias)))
        self._products: list[tuple[mujoco.MjModel, mujoco.MjData, Array, Array]] = []
        self._compliance = np.zeros(self._shape)
        self._farthest = np.zeros(self._shape)
        self._damping = GatheredArrays([world.model.dof_damping for world in worlds])
        self._damping.read()
        slots, leaders, gains = [], [], []
        for i, (world, env_data) in enumerate(zip(worlds, data, strict=True)):
            begin, end = self._data_forces.begin[i : i + 2].tolist()
            force, acceleration = self._force[begin:end], self._acceleration[begin:end]
            self._products.append((world.model, env_data, force, acceleration))
            self._compliance[i, : world.robot.dof] = 1 / world.model.actuator_gainprm[:, 0]
            robot = world.robot
            self._farthest[i, : robot.dof] = farthest_targets(robot, robot.independent_joints)
            matrix, _ = world.robot.mimic_map
            rows, columns = np.nonzero(matrix)
            slots.append(begin + world.movable_qd_at[rows])
            leaders.append(i * joints + columns)
            gains.append(matrix[rows, columns])
        self._slots, self._leaders = np.concatenate(slots), np.concatenate(leaders)
        self._gains = np.concatenate(gains)

    def applied_to(self, env: int) -> Array:
        """Return the extra forces on an environment's degrees of freedom, shape (nv,); a view."""
        begin, end = self._data_forces.begin[env : env + 2].tolist()
        return self._applied[begin:end]

    def controls(self, targets: Array, q: Array, qd: Array, velocities: Array, out: Array) -> None:
        """Compute the controls of all actuators from the data as the last step left them.

        Targets, whose padding is zero, joint states and controls have the shape (n, J).
        """
        error = clamp(targets - q, self._farthest)
        mean_acceleration = BY_ERROR * error + BY_VELOCITY * qd
        self._acceleration[self._slots] = self._gains * mean_acceleration.ravel()[self._leaders]
        for model, data, force, acceleration in self._products:
            mujoco.mj_mulM(model, data, force, acceleration)
        self._data_forces.read()
        force = self._force + self._bias - self._weight
        leader_forces = np.bincount(
            self._leaders, self._gains * force[self._slots], minlength=mean_acceleration.size
        )
        np.multiply(leader_forces.reshape(self._shape), self._compliance, out=out)
        out += q + error - _PASSIVE_DELAY * qd - mean_acceleration / _STIFFNESS
        np.multiply(self._damping.flat, velocities, out=self._applied)


Work = tuple[int, mujoco.MjModel, mujoco.MjData, Array, Array, Array, Array]
"""Environment with its model and data; views of its actuator controls in the data and in the batch,
and of its applied forces in the data and in ``PositionControl``."""


class MujocoSimulation(HostSimulation):
    """Environments in MuJoCo, on the CPU; a ``Simulation``.

    Every environment has its own data, which one thread steps at a time and nothing else touches:
    its numbers depend neither on the batch nor on the number of threads. MuJoCo steps without
    Python's lock, so threads run in parallel; each takes the next environment when it has finished
    one, so that robots of different cost keep all threads busy.

    ``mujoco.rollout`` has native threads, but needs a call for every size of model, forgets the
    solver's warm start between calls, and leaves no joint-space inertia for ``PositionControl``.

    MuJoCo has no speed limits of joints. ``PositionControl`` keeps joints below them, except for
    up to a third more while they catch up.
    """

    def __init__(
        self, scenes: Sequence[Scene], contacts: Contacts | None = None, *, threads: int = 1
    ) -> None:
        super().__init__(scenes)
        self._worlds = worlds(self.scenes, contacts or Contacts())
        self._data = [mujoco.MjData(world.model) for world in self._worlds]
        self._controls = np.zeros(self._targets.shape)
        self._helpers = min(threads, len(scenes)) - 1
        self._state = MujocoState(self._worlds, self._data)
        self.q, self.qd = self._state.q, self._state.qd
        self.object_pose = self._state.object_pose
        self.object_velocity = self._state.object_velocity
        self._control = PositionControl(self._worlds, self._data, self._targets.shape[1])
        self._work: list[Work] = []
        for i, (world, data) in enumerate(zip(self._worlds, self._data, strict=True)):
            controls, applied = self._controls[i, : world.robot.dof], self._control.applied_to(i)
            self._work.append(
                (i, world.model, data, data.ctrl, controls, data.qfrc_applied, applied)
            )
        self._seen, self._warnings = None, MujocoWarnings()
        self._pool = ThreadPoolExecutor(self._helpers, "mujoco") if self._helpers else None
        self._go_home()

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        super().close()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool, self._work = None, []

    def _put(
        self, envs: NDArray[np.int64], q: Array, object_pose: Array, obstacle_poses: Array | None
    ) -> None:
        for row, env in enumerate(envs.tolist()):
            world, data = self._worlds[env], self._data[env]
            # mj_resetData also puts mocap bodies back: obstacles shall stay where they are.
            obstacles = np.hstack([data.mocap_pos, data.mocap_quat])
            if obstacle_poses is not None:
                obstacles[world.obstacles] = obstacle_poses[row, : len(world.obstacles)]
            mujoco.mj_resetData(world.model, data)
            data.mocap_pos[:], data.mocap_quat[:] = obstacles[:, :3], obstacles[:, 3:]
            positions = q[row, : world.robot.dof].astype(np.float64)
            data.qpos[world.movable_q_at] = movable_positions(world.robot, positions)
            if len(world.block_q_at):
                pose = object_pose[row].astype(np.float64)
                if mujoco.mju_normalize4(pose[3:]) < 0.5:  # it returns the length before
                    raise ValueError(
                        f"{self._label(env)}: {pose.tolist()} is not a pose of a block"
                    )
                data.qpos[world.block_q_at] = pose
            if world.object is not None:
                pose = object_pose[row : row + 1].astype(np.float64)
                data.qpos[world.object_q_at] = world.object.placed_joint.positions(pose)
            mujoco.mj_kinematics(world.model, data)  # these three give the inertia of controls
            mujoco.mj_comPos(world.model, data)
            mujoco.mj_makeM(world.model, data)
        self._state.read()

    def _advance(self) -> Collection[int]:
        """Step; environments also diverge if their contacts do not fit into MuJoCo's memory."""
        # Environments whose state is not finite are named below, whatever MuJoCo warns of.
        with np.errstate(invalid="ignore", over="ignore"), self._warnings:
            q, qd = self._state.joints
            self._control.controls(self._targets, q, qd, self._state.velocities, out=self._controls)
            refused = self._run_threads()
            self._state.read()
        return {*self._state.diverged(), *refused}

    def _run_threads(self) -> set[int]:
        """Step all environments; return the ones that MuJoCo could not step."""
        work, refused = iter(self._work), set[int]()
        if self._pool is None:
            _drain(work, refused)
            return refused
        helpers = [self._pool.submit(_drain, work, refused) for _ in range(self._helpers)]
        try:
            _drain(work, refused)
        finally:
            wait(helpers)
        for helper in helpers:
            helper.result()
        return refused


def _drain(work: Iterator[Work], refused: set[int]) -> None:
    """Step environments until none is left; several threads may share both arguments."""
    for env, model, data, actuators, controls, torques, applied in work:
        actuators[:] = controls
        torques[:] = applied
        try:
            mujoco.mj_step(model, data, nstep=SUBSTEPS)
        except mujoco.FatalError:  # its stack is full
            refused.add(env)


SIMULATOR = Simulator(
    "mujoco",
    lambda scenes, contacts, workers, _: MujocoSimulation(scenes, contacts, threads=workers),
    max_envs=1024,
    worker_envs=8,
)

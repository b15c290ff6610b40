"""MuJoCo as a simulator: one ``MjData`` for every environment, stepped by threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from itertools import pairwise
from typing import Any

import mujoco
import numpy as np
import torch

from morphgen.errors import SimulationError
from morphgen.formats.quiet import MujocoWarnings
from morphgen.model.dynamics import BANDWIDTH
from morphgen.model.kinematics import movable_positions
from morphgen.tasks.sim.base import (
    CONTROL_PERIOD,
    SUBSTEPS,
    TIMESTEP,
    Contacts,
    Scene,
    Simulator,
    require_finite,
    require_reset_shapes,
)
from morphgen.tasks.sim.motor_law import (
    CONTROL_STEP,
    GAIN,
    TensorView,
    all_finite,
    clamp,
    constant,
    farthest_targets,
    is_within,
    mask_of,
)
from morphgen.tasks.sim.mujoco_model import PASSIVE, World, worlds
from morphgen.typing import Array

MAX_SPEED = 1e4  # speed above which a simulation counts as diverged [rad/s or m/s]
_TOO_FAST = f"diverged: a velocity is not finite or beyond {MAX_SPEED:g}"
_NO_MEMORY = "diverged: its contacts do not fit into MuJoCo's memory"
_FULL = [mujoco.mjtWarning.mjWARN_CONTACTFULL.value, mujoco.mjtWarning.mjWARN_CNSTRFULL.value]


class GatheredArrays:
    """Arrays of all environments, copied one after the other into one array.

    One call copies them all: a call for every environment would take a tenth of its physics. The
    last element is a zero, for padding.
    """

    def __init__(self, arrays: Sequence[Array]) -> None:
        """Allocate the memory; ``read`` copies."""
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
        """Prepare; ``read`` fills the tensors."""
        n, joints = len(worlds), max(world.robot.dof for world in worlds)
        blocks = [i for i, world in enumerate(worlds) if world.block is not None]
        poses = [view for i in blocks for view in worlds[i].block_pose_in(data[i])]
        positions = [*(env_data.qpos for env_data in data), *poses]
        velocities = [*(env_data.qvel for env_data in data), np.zeros(1)]
        warnings = [env_data.warning.number for env_data in data]
        self._numbers = GatheredArrays([*positions, *velocities, *warnings])  # one call reads all
        begin, first = self._numbers.begin, len(positions)
        self._begin = (begin[first : first + n + 1] - begin[first]).tolist()
        self.velocities = self._numbers.flat[begin[first] : begin[first + n + 1]]
        """``qvel`` of all environments at the last ``read``, concatenated, and a zero."""
        self._warnings = self._numbers.flat[begin[first + n + 1] : -1].reshape(n, -1)
        self._joints_at = np.full((2, n, joints), -1)
        self._pose_at = np.full((n, 7), -1)
        self._velocity_at = np.full((n, 6), -1)
        for i, world in enumerate(worlds):
            dof = world.robot.dof
            self._joints_at[0, i, :dof] = begin[i] + world.q_at
            self._joints_at[1, i, :dof] = begin[first + i] + world.qd_at
            if world.block_moves:
                self._velocity_at[i] = begin[first + i] + world.block_qd_at + np.arange(6)
        for k, i in enumerate(blocks):
            self._pose_at[i, :3] = begin[n + 2 * k] + np.arange(3)
            self._pose_at[i, 3:] = begin[n + 2 * k + 1] + np.arange(4)
        self._has_blocks = bool(blocks)
        self._joints = np.zeros((2, n, joints), np.float32)
        self._block_pose = np.zeros((n, 7), np.float32)
        self._exact_pose = np.zeros((n, 7))
        self.joints = np.zeros((2, n, joints))
        """Joint positions and velocities at the last ``read``, shape (2, n, J)."""
        self.q, self.qd = map(torch.from_numpy, self._joints)
        self.block_pose = torch.from_numpy(self._block_pose)

    @property
    def block_velocity(self) -> torch.Tensor:
        """Linear and angular velocities of the blocks in the world at the last ``read``, (n, 6)."""
        if not self._has_blocks:
            return torch.zeros(len(self._velocity_at), 6)
        velocity = self._numbers.flat[self._velocity_at]
        quaternion, angular = self._exact_pose[:, 3:], velocity[:, 3:]
        # MuJoCo has a free body's angular velocity in the axes of the body: rotate it to the
        # world, v' = v + w t + u x t with t = 2 u x v and the quaternion (w, u).
        w, axis = quaternion[:, :1], quaternion[:, 1:]
        twice = 2 * np.cross(axis, angular)
        angular[:] = angular + w * twice + np.cross(axis, twice)
        return torch.from_numpy(velocity.astype(np.float32))

    def read(self) -> None:
        """Update the tensors from the data."""
        self._numbers.read()
        self.joints = self._numbers.flat[self._joints_at]
        self._joints[:] = self.joints
        if self._has_blocks:
            self._exact_pose = self._numbers.flat[self._pose_at]
            quaternion = self._exact_pose[:, 3:]
            quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)  # w >= 0, as everywhere
            self._block_pose[:] = self._exact_pose

    def faults(self) -> dict[int, str]:
        """Return the environments that diverged up to the last ``read``, each with the reason."""
        warnings = self._warnings
        if is_within(self.velocities, MAX_SPEED) and is_within(warnings, 0):
            return {}
        speeds = np.abs(self.velocities)
        slow = [bool((speeds[a:b] <= MAX_SPEED).all()) for a, b in pairwise(self._begin)]
        full = np.asarray(warnings[:, _FULL].any(axis=1))
        diverged = ~np.array(slow) | warnings.any(axis=1)
        return {
            env: _NO_MEMORY if full[env] else _TOO_FAST
            for env in np.flatnonzero(full | diverged).tolist()
        }


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
        """Prepare."""
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


_VIEWS = {"_state", "q", "qd", "block_pose", "_control", "_work", "_view", "_warnings", "_pool"}
"""Attributes that ``_view_data`` makes."""


class MujocoSimulation:
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
        """Compile; every robot is at home, every block at its pose in the scene."""
        if not scenes or threads < 1:
            raise ValueError(f"{len(scenes)} scenes, {threads} threads; there must be one of each")
        self.scenes = tuple(scenes)
        self.device = torch.device("cpu")
        self._worlds = worlds(self.scenes, contacts or Contacts())
        self._data = [mujoco.MjData(world.model) for world in self._worlds]
        shape = len(scenes), max(world.robot.dof for world in self._worlds)
        self._controls, self._targets = np.zeros(shape), np.zeros(shape)
        self._has_target = np.zeros(shape, dtype=bool)
        self._faults: dict[int, str] = {}
        self._diverged = torch.zeros(len(scenes), dtype=torch.bool)
        self._helpers = threads - 1
        self._view_data()
        for i, world in enumerate(self._worlds):
            self._has_target[i, : world.robot.dof] = True
            block = self.scenes[i].block
            pose = (*block.pose.position, *block.pose.quaternion) if block is not None else ()
            # In float32, as a reset to the values of the tensors would do.
            self._put(
                i, *(np.array(values, np.float32).tolist() for values in (world.robot.home, pose))
            )
            poses = [(*o.pose.position, *o.pose.quaternion) for o in self.scenes[i].obstacles]
            self._put_obstacles(i, poses)
        self._state.read()

    def _view_data(self) -> None:
        """Make everything that has views of the data, and the threads."""
        self._state = MujocoState(self._worlds, self._data)
        self.q, self.qd = self._state.q, self._state.qd
        self.block_pose = self._state.block_pose
        self._control = PositionControl(self._worlds, self._data, self._targets.shape[1])
        self._work: list[Work] = []
        for i, (world, data) in enumerate(zip(self._worlds, self._data, strict=True)):
            controls, applied = self._controls[i, : world.robot.dof], self._control.applied_to(i)
            self._work.append(
                (i, world.model, data, data.ctrl, controls, data.qfrc_applied, applied)
            )
        self._view, self._warnings = TensorView(), MujocoWarnings()
        self._pool = ThreadPoolExecutor(self._helpers, "mujoco") if self._helpers else None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state for a copy, which goes on as this simulation does."""
        self._require_open()
        return {name: value for name, value in vars(self).items() if name not in _VIEWS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore a copy: views of the data must be of its own data."""
        vars(self).update(state)
        self._view_data()
        self._state.read()

    @property
    def block_velocity(self) -> torch.Tensor:
        """Velocities of the blocks; see ``Simulation.block_velocity``."""
        self._require_open()
        return self._state.block_velocity

    def reset(
        self,
        mask: torch.Tensor,
        q: torch.Tensor,
        block_pose: torch.Tensor,
        obstacle_poses: torch.Tensor | None = None,
    ) -> None:
        """Put some environments at rest and clear their history; see ``Simulation.reset``."""
        self._require_open()
        joints = self._targets.shape[1]
        require_reset_shapes(self.scenes, joints, mask, q, block_pose, obstacle_poses)
        for env in np.flatnonzero(mask.numpy()).tolist():
            dof = self._worlds[env].robot.dof
            self._put(env, q[env, :dof].tolist(), block_pose[env].tolist())
            if obstacle_poses is not None:
                count = len(self._worlds[env].obstacles)
                self._put_obstacles(env, obstacle_poses[env, :count].tolist())
        self._state.read()

    def step(self, targets: torch.Tensor) -> torch.Tensor:
        """Advance all environments by one control step; see ``Simulation.step``.

        Environments also diverge if their contacts do not fit into MuJoCo's memory.
        """
        self._require_open()
        rows = self._view(targets)
        if rows.shape != self._targets.shape:
            raise ValueError(f"targets have shape {rows.shape}, not {self._targets.shape}")
        np.copyto(self._targets, rows, where=self._has_target)
        if not all_finite(self._targets):
            require_finite(self.scenes, "targets", self._targets)
        # Environments whose state is not finite are named below, whatever MuJoCo warns of.
        with np.errstate(invalid="ignore", over="ignore"), self._warnings:
            q, qd = self._state.joints
            self._control.controls(self._targets, q, qd, self._state.velocities, out=self._controls)
            refused = self._advance()
            self._state.read()
        faults = self._state.faults() | refused
        if faults or self._faults:
            self._faults = {env: f"{self._label(env)}: {faults[env]}" for env in sorted(faults)}
            self._diverged = torch.from_numpy(mask_of(faults, len(self.scenes)))
        return self._diverged

    def faults(self) -> dict[int, str]:
        """Return why environments diverged in the last step; see ``Simulation.faults``."""
        return self._faults

    def close(self) -> None:
        """Free everything; a second call does nothing."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None
        if self._work:
            del self._state, self._control  # they have views of the data
        self._work, self._data, self._worlds = [], [], []

    def movable_q(self, env: int) -> Array:
        """Return the positions of all movable joints of an environment, mimic joints included."""
        return np.array(self._data[env].qpos[self._worlds[env].movable_q_at])

    def _put(self, env: int, q: Sequence[float], pose: Sequence[float]) -> None:
        """Put an environment's robot and block at rest at joint positions and a pose."""
        world, data = self._worlds[env], self._data[env]
        if not np.isfinite(q).all() or (world.block is not None and not np.isfinite(pose).all()):
            raise ValueError(f"{self._label(env)}: reset to q {list(q)}, block {list(pose)}")
        # mj_resetData also puts mocap bodies back: obstacles shall stay where they are.
        obstacles = (values[world.obstacles] for values in (data.mocap_pos, data.mocap_quat))
        positions, quaternions = obstacles
        mujoco.mj_resetData(world.model, data)
        data.mocap_pos[world.obstacles], data.mocap_quat[world.obstacles] = positions, quaternions
        data.qpos[world.movable_q_at] = movable_positions(world.robot, q)
        mujoco.mj_kinematics(world.model, data)  # these three give the inertia that controls need
        mujoco.mj_comPos(world.model, data)
        mujoco.mj_makeM(world.model, data)
        if world.block is not None:
            position, quaternion = world.block_pose_in(data)
            position[:], quaternion[:] = pose[:3], pose[3:]
            if mujoco.mju_normalize4(quaternion) < 0.5:  # it returns the length before
                raise ValueError(f"{self._label(env)}: {list(pose)} is not a pose of a block")

    def _put_obstacles(self, env: int, poses: Sequence[Sequence[float]]) -> None:
        """Put the obstacles of an environment at poses."""
        rows = np.array(poses).reshape(-1, 7)
        at, data = self._worlds[env].obstacles, self._data[env]
        if rows.shape != (len(at), 7) or not np.isfinite(rows).all():
            raise ValueError(f"{self._label(env)}: reset to obstacles {rows.tolist()}")
        data.mocap_pos[at], data.mocap_quat[at] = rows[:, :3], rows[:, 3:]

    def _advance(self) -> dict[int, str]:
        """Step all environments; return the ones that MuJoCo could not step, with its reasons."""
        work, refused = iter(self._work), dict[int, str]()
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

    def _require_open(self) -> None:
        if not self._work:
            raise SimulationError("the simulation is closed")

    def _label(self, env: int) -> str:
        steps = round(self._data[env].time / (TIMESTEP * SUBSTEPS))
        name = self.scenes[env].robot.name
        return f"environment {env} (robot {name!r}, {steps} steps after its reset)"


def _drain(work: Iterator[Work], refused: dict[int, str]) -> None:
    """Step environments until none is left; several threads may share both arguments."""
    for env, model, data, actuators, controls, torques, applied in work:
        actuators[:] = controls
        torques[:] = applied
        try:
            mujoco.mj_step(model, data, nstep=SUBSTEPS)
        except mujoco.FatalError as error:  # its stack is full
            refused[env] = f"diverged: MuJoCo: {str(error).splitlines()[0]}"


SIMULATOR = Simulator(
    "mujoco",
    lambda scenes, contacts, workers, _: MujocoSimulation(scenes, contacts, threads=workers),
    native_step=("mujoco", "mj_step"),
    max_envs=1024,
)

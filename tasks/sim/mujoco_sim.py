"""MuJoCo as a simulator: one ``MjData`` for every environment, stepped by threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import Any

import mujoco
import numpy as np
import torch

from morphgen.errors import SimulationError
from morphgen.formats.mujoco_warnings import MujocoWarnings
from morphgen.model.kinematics import movable_positions
from morphgen.tasks.sim.base import (
    SUBSTEPS,
    TIMESTEP,
    Contacts,
    Scene,
    Simulator,
    require_reset_shapes,
)
from morphgen.tasks.sim.mujoco_control import PositionControl
from morphgen.tasks.sim.mujoco_model import worlds
from morphgen.tasks.sim.mujoco_state import MujocoState
from morphgen.tasks.sim.short_arrays import TensorView, all_finite, mask_of
from morphgen.typing import Array

Work = tuple[int, mujoco.MjModel, mujoco.MjData, Array, Array, Array, Array]
"""Environment with its model and data; views of its actuator controls in the data and in the batch,
and of its applied forces in the data and in ``PositionControl``."""


_VIEWS = {"_state", "q", "qd", "block_pose", "_control", "_work", "_view", "_pool"}
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
        """Compile; every robot is at home, every block at its pose in the scene.

        Args:
            scenes: Scene of each environment; a robot that several share is compiled once.
            contacts: Pairs of things that collide; by default everything.
            threads: Number of threads that step, the caller's included.

        Raises:
            SimulationError: If MuJoCo refuses a scene.
            FormatError: If MJCF cannot express a robot.
            MeshError: If a mesh cannot be read.
            ValueError: If there are no scenes or no threads.
        """
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
        self._view = TensorView()
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
        """Put some environments at rest and clear their history; see ``Simulation.reset``.

        Raises:
            ValueError: If a shape is wrong or a position is not finite; the environments before
                that one have been reset.
            SimulationError: If the simulation is closed.
        """
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

        Raises:
            ValueError: If the shape is wrong or a target is not finite; then nothing has moved.
            SimulationError: If the simulation is closed.
        """
        self._require_open()
        rows = self._view(targets)
        if rows.shape != self._targets.shape:
            raise ValueError(f"targets have shape {rows.shape}, not {self._targets.shape}")
        np.copyto(self._targets, rows, where=self._has_target)
        if not all_finite(self._targets):
            env = int(np.flatnonzero(~np.isfinite(self._targets).all(axis=1))[0])
            raise ValueError(f"{self._label(env)}: a target is not finite")
        # Environments whose state is not finite are named below, whatever MuJoCo warns of.
        with np.errstate(invalid="ignore", over="ignore"), MujocoWarnings():
            self._control.controls(
                self._targets, *self._state.joints(), self._state.velocities, out=self._controls
            )
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
        self._state.release()
        self._control.release()
        self._work, self._data, self._worlds = [], [], []

    def movable_q(self, env: int) -> Array:
        """Return the positions of all movable joints of an environment, mimic joints included."""
        return np.array(self._data[env].qpos[self._worlds[env].movable_q_at])

    def _put(self, env: int, q: Sequence[float], pose: Sequence[float]) -> None:
        """Put an environment's robot and block at rest at joint positions and a pose."""
        world, data = self._worlds[env], self._data[env]
        if not np.isfinite(q).all() or (world.block is not None and not np.isfinite(pose).all()):
            raise ValueError(f"{self._label(env)}: reset to q {list(q)}, block {list(pose)}")
        obstacles = (values[world.obstacles] for values in (data.mocap_pos, data.mocap_quat))
        positions, quaternions = obstacles
        mujoco.mj_resetData(world.model, data)
        data.mocap_pos[world.obstacles], data.mocap_quat[world.obstacles] = positions, quaternions
        data.qpos[world.movable_q_at] = movable_positions(world.robot, q)
        mujoco.mj_kinematics(world.model, data)
        mujoco.mj_comPos(world.model, data)
        mujoco.mj_makeM(world.model, data)
        if world.block is not None:
            position, quaternion = world.block_pose_in(data)
            position[:], quaternion[:] = pose[:3], pose[3:]
            if mujoco.mju_normalize4(quaternion) < 0.5:
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
    """Step environments until none is left; several threads may share both arguments.

    Args:
        work: Environments to step.
        refused: Receives the environments that MuJoCo could not step, with its reasons.
    """
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

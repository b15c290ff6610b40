"""Scenes in MuJoCo that step together: data of its own for every environment, threads."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait

import mujoco
import numpy as np
import torch

from morphgen.checks.self_collision import capture_mujoco_warnings
from morphgen.errors import DivergedError, SimulationError
from morphgen.model.kinematics import movable_positions
from morphgen.tasks.sim.base import SUBSTEPS, TIMESTEP, Contacts, Scene, Simulator
from morphgen.tasks.sim.mujoco_control import PositionControl
from morphgen.tasks.sim.mujoco_model import worlds
from morphgen.tasks.sim.mujoco_state import State
from morphgen.typing import Array

Work = tuple[int, mujoco.MjModel, mujoco.MjData, Array, Array, Array, Array]


class MujocoSimulation:
    """Scenes in MuJoCo, on the CPU; implements ``Simulation``.

    Every environment has data of its own, which one thread steps at a time and nothing else
    touches: its numbers depend neither on the batch nor on the number of threads. MuJoCo steps
    without Python's lock, so threads run side by side; they take the next environment when they
    are done with one, so that bodies of different cost keep all busy.

    ``mujoco.rollout`` has native threads, but wants a call for every size of model, forgets the
    solver's warm start between calls, and leaves no joint-space inertia for ``PositionControl``.

    MuJoCo knows no speed limit of a joint; ``PositionControl`` keeps joints from going faster, but
    for a third while they catch up.
    """

    def __init__(
        self, scenes: Sequence[Scene], contacts: Contacts | None = None, *, threads: int = 1
    ) -> None:
        """Compile; every robot is at home, every block where its scene has it.

        Args:
            scenes: One for every environment; equal robots are read once if they are one object.
            contacts: What may touch what; by default everything.
            threads: Threads that step, the caller's among them.

        Raises:
            SimulationError: If MuJoCo refuses a scene.
            FormatError: If MJCF cannot express a robot.
            MeshError: If a mesh cannot be read.
            ValueError: If there is no scene or no thread.
        """
        if not scenes or threads < 1:
            raise ValueError(f"{len(scenes)} scenes, {threads} threads; there must be one of each")
        self.scenes = tuple(scenes)
        self.device = torch.device("cpu")
        self._worlds = worlds(self.scenes, contacts or Contacts())
        self._data = [mujoco.MjData(world.model) for world in self._worlds]
        self._state = State(self._worlds, self._data)
        shape = self._state.q.shape
        self._control = PositionControl(self._worlds, self._data, shape[1])
        self._controls, self._targets = np.zeros(shape), np.zeros(shape)
        self._has_target = np.zeros(shape, dtype=bool)
        self._work: list[Work] = []
        for i, (world, data) in enumerate(zip(self._worlds, self._data, strict=True)):
            self._has_target[i, : world.robot.dof] = True
            controls, applied = self._controls[i, : world.robot.dof], self._control.applied_to(i)
            self._work.append(
                (i, world.model, data, data.ctrl, controls, data.qfrc_applied, applied)
            )
            block = self.scenes[i].block
            pose = (*block.pose.position, *block.pose.quaternion) if block is not None else ()
            # As a reset to what the tensors say would: their digits, not more.
            self._place(
                i, *(np.array(each, np.float32).tolist() for each in (world.robot.home, pose))
            )
        self._state.read()
        self._helpers = threads - 1
        self._pool = ThreadPoolExecutor(self._helpers, "mujoco") if self._helpers else None

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J), rad or m."""
        return self._state.q

    @property
    def qd(self) -> torch.Tensor:
        """Their velocities, shape (n, J)."""
        return self._state.qd

    @property
    def block_pose(self) -> torch.Tensor:
        """Pose of the block in the world, (x, y, z, qw, qx, qy, qz), (n, 7); zeros if none."""
        return self._state.block_pose

    @property
    def block_velocity(self) -> torch.Tensor:
        """Linear and angular velocity of the block in the world, shape (n, 6); zeros if none."""
        return self._state.block_velocity

    def reset(self, envs: torch.Tensor, q: torch.Tensor, block_pose: torch.Tensor) -> None:
        """Put some environments at rest; nothing of their past has an influence any more.

        Args:
            envs: Indices, shape (k,), int64.
            q: Positions of their independent joints, which become the targets, shape (k, J).
            block_pose: Poses of their blocks, shape (k, 7); ignored where there is none.

        Raises:
            ValueError: If a shape is wrong, an environment does not exist, or what matters of a
                position is not finite; the environments before that one have been reset.
        """
        self._require_open()
        k, (n, joints) = len(envs), self._targets.shape
        if q.shape != (k, joints) or block_pose.shape != (k, 7):
            raise ValueError(
                f"reset of {k} environments to q of shape {tuple(q.shape)} and blocks of shape "
                f"{tuple(block_pose.shape)}; they need ({k}, {joints}) and ({k}, 7)"
            )
        if k and not (0 <= int(envs.min()) <= int(envs.max()) < n):
            raise ValueError(f"reset of environments {envs.tolist()}; there are {n}")
        rows = zip(envs.tolist(), q.tolist(), block_pose.tolist(), strict=True)
        for env, positions, pose in rows:
            self._place(env, positions[: self._worlds[env].robot.dof], pose)
        self._state.read()

    def step(self, targets: torch.Tensor) -> None:
        """Move all by one control step.

        Args:
            targets: Target positions of the independent joints, shape (n, J).

        Raises:
            ValueError: If the shape is wrong or a target is not finite; then nothing has moved.
            DivergedError: If environments became unstable, or their contacts do not fit into
                MuJoCo's memory; all others have moved, and these remain so until they are reset.
            SimulationError: If the simulation is closed.
        """
        self._require_open()
        if targets.shape != self._targets.shape:
            shapes = f"{tuple(targets.shape)}, not {self._targets.shape}"
            raise ValueError(f"targets have shape {shapes}")
        np.copyto(self._targets, targets.numpy(), where=self._has_target)
        if not np.isfinite(self._targets).all():
            env = int(np.flatnonzero(~np.isfinite(self._targets).all(axis=1))[0])
            raise ValueError(f"{self._where(env)}: a target is not finite")
        # Environments whose state is not finite are named below, whatever MuJoCo warns of.
        with np.errstate(invalid="ignore", over="ignore"), capture_mujoco_warnings():
            self._control.controls(
                self._targets, *self._state.joints(), self._state.velocities, out=self._controls
            )
            refused = self._advance()
            self._state.read()
        faults = self._state.faults() | refused
        if faults:
            raise DivergedError({env: f"{self._where(env)}: {why}" for env, why in faults.items()})

    def close(self) -> None:
        """Free everything; a second time does nothing."""
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None
        self._state.forget()
        self._control.forget()
        self._work, self._data, self._worlds = [], [], []

    def _place(self, env: int, q: Sequence[float], pose: Sequence[float]) -> None:
        world, data = self._worlds[env], self._data[env]
        if not np.isfinite(q).all() or (world.block is not None and not np.isfinite(pose).all()):
            raise ValueError(f"{self._where(env)}: reset to q {list(q)}, block {list(pose)}")
        mujoco.mj_resetData(world.model, data)
        data.qpos[world.movable_q_at] = movable_positions(world.robot, q)
        mujoco.mj_kinematics(world.model, data)
        mujoco.mj_comPos(world.model, data)
        mujoco.mj_makeM(world.model, data)
        if world.block is not None:
            position, quaternion = world.block_pose_in(data)
            position[:], quaternion[:] = pose[:3], pose[3:]
            if mujoco.mju_normalize4(quaternion) < 0.5:
                raise ValueError(f"{self._where(env)}: {list(pose)} is no pose of a block")

    def _advance(self) -> dict[int, str]:
        """Step all environments; return those that MuJoCo could not step, with its reasons."""
        work, refused = iter(self._work), dict[int, str]()
        helpers = []
        if self._pool is not None:
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

    def _where(self, env: int) -> str:
        steps = round(self._data[env].time / (TIMESTEP * SUBSTEPS))
        name = self.scenes[env].robot.name
        return f"environment {env} (robot {name!r}, {steps} steps after its reset)"


def _drain(work: Iterator[Work], refused: dict[int, str]) -> None:
    """Step environments until none is left; several threads may share both arguments.

    Args:
        work: Environments to step.
        refused: Where to put those that MuJoCo could not step, with its reason.
    """
    for env, model, data, actuators, controls, torques, applied in work:
        actuators[:] = controls
        torques[:] = applied
        try:
            mujoco.mj_step(model, data, nstep=SUBSTEPS)
        except mujoco.FatalError as error:  # its stack is full
            refused[env] = f"unstable: MuJoCo: {str(error).splitlines()[0]}"


SIMULATOR = Simulator(
    "mujoco",
    lambda scenes, contacts, workers: MujocoSimulation(scenes, contacts, threads=workers),
    native_step=("mujoco", "mj_step"),
    max_envs=1024,
)

"""State of MuJoCo environments as tensors: joints and blocks."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import mujoco
import numpy as np
import torch

from morphgen.tasks.sim.mujoco_model import World
from morphgen.tasks.sim.short_arrays import is_within
from morphgen.typing import Array

MAX_SPEED = 1e4
"""Speed above which a simulation counts as diverged [rad/s or m/s]."""
_TOO_FAST = f"diverged: a velocity is not finite or beyond {MAX_SPEED:g}"
_NO_MEMORY = "diverged: its contacts do not fit into MuJoCo's memory"
_FULL = [mujoco.mjtWarning.mjWARN_CONTACTFULL.value, mujoco.mjtWarning.mjWARN_CNSTRFULL.value]


class GatheredArrays:
    """Arrays of all environments, copied one after the other into one array.

    One call copies them all: a call for every environment would take a tenth of its physics. The
    last element is a zero, for padding.
    """

    def __init__(self, arrays: Sequence[Array]) -> None:
        """Allocate the memory; ``read`` copies.

        Args:
            arrays: One-dimensional arrays to copy at every ``read``.
        """
        self._arrays = [*arrays, np.zeros(1)]
        ends = np.cumsum([len(array) for array in self._arrays])
        self.begin = np.concatenate([[0], ends[:-1]])
        """Index in ``flat`` where each array begins."""
        self.flat = np.zeros(ends[-1])

    def read(self) -> None:
        """Copy the arrays into ``flat``."""
        np.concatenate(self._arrays, out=self.flat)


class MujocoState:
    """Tensors of joints and blocks, gathered from the data of all environments at once."""

    def __init__(self, worlds: Sequence[World], data: Sequence[mujoco.MjData]) -> None:
        """Prepare; ``read`` fills the tensors.

        Args:
            worlds: Model of each environment, n of them.
            data: Data of each environment.
        """
        n, joints = len(worlds), max(world.robot.dof for world in worlds)
        blocks = [i for i, world in enumerate(worlds) if world.block is not None]
        poses = [view for i in blocks for view in worlds[i].block_pose_in(data[i])]
        self._positions = GatheredArrays([*(env_data.qpos for env_data in data), *poses])
        self._velocities = GatheredArrays([env_data.qvel for env_data in data])
        self._warnings = GatheredArrays([env_data.warning.number for env_data in data])
        self._q_at = np.full((n, joints), -1)
        self._qd_at = np.full((n, joints), -1)
        self._pose_at = np.full((n, 7), -1)
        self._velocity_at = np.full((n, 6), -1)
        for i, world in enumerate(worlds):
            dof = world.robot.dof
            self._q_at[i, :dof] = self._positions.begin[i] + world.q_at
            self._qd_at[i, :dof] = self._velocities.begin[i] + world.qd_at
            if world.block_moves:
                self._velocity_at[i] = self._velocities.begin[i] + world.block_qd_at + np.arange(6)
        for k, i in enumerate(blocks):
            self._pose_at[i, :3] = self._positions.begin[n + 2 * k] + np.arange(3)
            self._pose_at[i, 3:] = self._positions.begin[n + 2 * k + 1] + np.arange(4)
        self._has_blocks = bool(blocks)
        self._q, self._qd = np.zeros((2, n, joints), np.float32)
        self._block_pose = np.zeros((n, 7), np.float32)
        self._exact_pose = np.zeros((n, 7))
        self.q, self.qd = torch.from_numpy(self._q), torch.from_numpy(self._qd)
        self.block_pose = torch.from_numpy(self._block_pose)

    @property
    def velocities(self) -> Array:
        """``qvel`` of all environments at the last ``read``, concatenated, and a zero."""
        return self._velocities.flat

    @property
    def block_velocity(self) -> torch.Tensor:
        """Linear and angular velocities of the blocks in the world at the last ``read``, (n, 6)."""
        if not self._has_blocks:
            return torch.zeros(len(self._velocity_at), 6)
        velocity = self._velocities.flat[self._velocity_at]
        quaternion, angular = self._exact_pose[:, 3:], velocity[:, 3:]
        # MuJoCo has a free body's angular velocity in the axes of the body: rotate it to the
        # world, v' = v + w t + u x t with t = 2 u x v and the quaternion (w, u).
        w, axis = quaternion[:, :1], quaternion[:, 1:]
        twice = 2 * np.cross(axis, angular)
        angular[:] = angular + w * twice + np.cross(axis, twice)
        return torch.from_numpy(velocity.astype(np.float32))

    def joints(self) -> tuple[Array, Array]:
        """Return joint positions and velocities at the last ``read``, shape (n, J) each."""
        return self._positions.flat[self._q_at], self._velocities.flat[self._qd_at]

    def read(self) -> None:
        """Update the tensors from the data."""
        self._positions.read()
        self._velocities.read()
        self._q[:], self._qd[:] = self.joints()
        if self._has_blocks:
            self._exact_pose = self._positions.flat[self._pose_at]
            quaternion = self._exact_pose[:, 3:]
            quaternion *= np.where(quaternion[:, :1] < 0, -1.0, 1.0)
            self._block_pose[:] = self._exact_pose

    def faults(self) -> dict[int, str]:
        """Return the environments that diverged, each with the reason.

        Their contacts do not fit into MuJoCo's memory, or they have a velocity that is not finite
        or beyond ``MAX_SPEED``.
        """
        self._warnings.read()
        if is_within(self._velocities.flat, MAX_SPEED) and is_within(self._warnings.flat, 0):
            return {}
        warnings = self._warnings.flat[:-1].reshape(len(self._q), -1)
        speeds = np.abs(self._velocities.flat)
        begin = self._velocities.begin
        slow = [bool((speeds[a:b] <= MAX_SPEED).all()) for a, b in pairwise(begin.tolist())]
        full = np.asarray(warnings[:, _FULL].any(axis=1))
        diverged = ~np.array(slow) | warnings.any(axis=1)
        return {
            env: _NO_MEMORY if full[env] else _TOO_FAST
            for env in np.flatnonzero(full | diverged).tolist()
        }

    def release(self) -> None:
        """Release the environments' data."""
        self._positions = self._velocities = self._warnings = GatheredArrays(())

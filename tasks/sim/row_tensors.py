"""What a simulation reports, as tensors on rows in this machine's memory, and what it is told."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.tasks.sim.base import Scene
from morphgen.tasks.sim.bullet_batch import Float32, Rows


class RowTensors:
    """The half of ``Simulation`` that reports, from rows in this machine's memory."""

    def __init__(self, scenes: Sequence[Scene], rows: Rows) -> None:
        """Wrap the rows of ``scenes`` without a copy."""
        self.scenes = tuple(scenes)
        self.device = torch.device("cpu")
        self._q, self._qd = torch.from_numpy(rows.q), torch.from_numpy(rows.qd)
        self._block_pose = torch.from_numpy(rows.block_pose)
        self._block_velocity = torch.from_numpy(rows.block_velocity)
        dofs = np.array([scene.robot.dof for scene in scenes], np.int64)
        self._used = np.arange(rows.q.shape[1]) < dofs[:, None]
        self._with_block = np.array([scene.block is not None for scene in scenes], bool)

    @property
    def q(self) -> torch.Tensor:
        """Positions of the independent joints, shape (n, J), rad or m."""
        return self._q

    @property
    def qd(self) -> torch.Tensor:
        """Their velocities, shape (n, J)."""
        return self._qd

    @property
    def block_pose(self) -> torch.Tensor:
        """Poses of the blocks, (x, y, z, qw, qx, qy, qz), shape (n, 7); zeros if none."""
        return self._block_pose

    @property
    def block_velocity(self) -> torch.Tensor:
        """Linear and angular velocities of the blocks, shape (n, 6); zeros if none."""
        return self._block_velocity

    def _checked_targets(self, targets: torch.Tensor) -> Float32:
        """JointTargets of ``step``, contiguous.

        Raises:
            ValueError: If the shape is wrong, or a target is not finite; padding may be anything.
        """
        found = np.ascontiguousarray(targets.numpy(), np.float32)
        if found.shape != self._used.shape:
            raise ValueError(f"targets have shape {found.shape}, not {self._used.shape}")
        wrong = self._used & ~np.isfinite(found)
        if wrong.any():
            env = int(wrong.any(axis=1).argmax())
            name = self.scenes[env].robot.name
            raise ValueError(f"environment {env} ({name!r}): targets {found[env].tolist()}")
        return found

    def _checked_state(
        self, envs: torch.Tensor, q: torch.Tensor, block_pose: torch.Tensor
    ) -> tuple[NDArray[np.int64], Float32, Float32]:
        """Arguments of ``reset``.

        Raises:
            ValueError: If a shape is wrong, an environment does not exist, or a position that
                matters is not finite.
        """
        n, joints = self._used.shape
        chosen, positions, poses = envs.numpy(), q.numpy(), block_pose.numpy()
        if positions.shape != (len(chosen), joints) or poses.shape != (len(chosen), 7):
            raise ValueError(
                f"reset of {len(chosen)} environments with q of shape {positions.shape} and "
                f"blocks of shape {poses.shape}; they need ({len(chosen)}, {joints}) and (.., 7)"
            )
        if ((chosen < 0) | (chosen >= n)).any():
            raise ValueError(f"reset of environments {chosen.tolist()}; there are {n}")
        wrong = (self._used[chosen] & ~np.isfinite(positions)).any(axis=1)
        wrong |= self._with_block[chosen] & ~np.isfinite(poses).all(axis=1)
        if wrong.any():
            k = int(wrong.argmax())
            env = int(chosen[k])
            raise ValueError(
                f"environment {env} ({self.scenes[env].robot.name!r}): reset to "
                f"q {positions[k].tolist()}, block {poses[k].tolist()}"
            )
        return chosen, positions, poses

"""Point clouds of the blocks and obstacles in a batch's environments."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from morphgen.model.rotation_torch import matrix_from_quaternion
from morphgen.tasks.random_numbers import EpisodeRandom, Stream
from morphgen.tasks.sim.base import Scene

NOISE = 0.005
"""Standard deviation of a point's position along each axis, as of a depth camera [m]."""
_NUMBERS = 8
"""Random numbers of a point: its face, its position in the box, and two pairs for noise."""


class PointClouds:
    """P points on the surfaces of every environment's block and obstacles.

    Each episode draws its points and their noise at its beginning, uniformly over all surfaces.

    Attributes:
        mask: Existing points, shape (n, P), bool.
    """

    def __init__(self, scenes: Sequence[Scene], num_points: int, device: torch.device) -> None:
        """Prepare; ``begin`` draws the points.

        Args:
            scenes: Scene of each environment.
            num_points: Number of points of each environment, P.
            device: Device of the tensors.
        """
        n, num_obstacles = len(scenes), max(len(scene.obstacles) for scene in scenes)
        self._num_points = num_points
        self._local = torch.zeros(n, num_points, 3, device=device)
        self._on_block = torch.zeros(n, num_points, dtype=torch.bool, device=device)
        # Box 0 is the block, and the others are the obstacles; missing ones have no size.
        sizes = torch.zeros(n, 1 + num_obstacles, 3)
        for i, scene in enumerate(scenes):
            if scene.block is not None:
                sizes[i, 0] = torch.tensor(scene.block.size)
            for k, box in enumerate(scene.obstacles, start=1):
                sizes[i, k] = torch.tensor(box.size)
        self._sizes = sizes.to(device)
        x, y, z = sizes.double().unbind(2)
        # Areas of the faces across x, y and z of all boxes, added up, as fractions of their sum.
        areas = torch.stack([y * z, x * z, x * y], dim=2).flatten(1).cumsum(dim=1)
        has_boxes = areas[:, -1:] > 0
        self._area = torch.where(has_boxes, areas / areas[:, -1:], 1.0).float().to(device)
        self.mask = has_boxes.repeat(1, num_points).to(device)

    def begin(
        self, mask: torch.Tensor, random: EpisodeRandom, obstacle_poses: torch.Tensor
    ) -> None:
        """Draw the points of new episodes.

        Args:
            mask: Environments whose episodes begin, shape (n,), bool.
            random: Random numbers of the episodes.
            obstacle_poses: Poses of the obstacles in the world, shape (n, O, 7).
        """
        n, P = self._on_block.shape
        numbers = random.uniform(Stream.POINTS, P * _NUMBERS).view(n, P, _NUMBERS)
        face = torch.searchsorted(self._area, numbers[..., 0].contiguous(), right=True)
        box, axis = face // 3, face % 3
        position = numbers[..., 1:4] - 0.5
        is_across = torch.arange(3, device=axis.device) == axis[..., None]
        position = torch.where(is_across, torch.where(position < 0, -0.5, 0.5), position)
        rows = torch.arange(n, device=axis.device)[:, None]
        local = position * self._sizes[rows, box] + NOISE * _normal(numbers[..., 4:])[..., :3]
        on_block = box == 0
        if obstacle_poses.shape[1]:
            pose = obstacle_poses[rows, (box - 1).clamp(min=0)]
            R = matrix_from_quaternion(pose[..., 3:])
            world = (R * local[..., None, :]).sum(dim=-1) + pose[..., :3]
            local = torch.where(on_block[..., None], local, world)
        self._local.copy_(torch.where((mask[:, None] & self.mask)[..., None], local, self._local))
        self._on_block.copy_(torch.where(mask[:, None], on_block & self.mask, self._on_block))

    def __call__(self, block_pose: torch.Tensor) -> torch.Tensor:
        """Return the points in the root frame, shape (n, P, 3) [m]; zeros without boxes.

        Args:
            block_pose: Poses of the blocks, shape (n, 7).
        """
        R = matrix_from_quaternion(block_pose[:, 3:])
        moved = self._local @ R.transpose(1, 2) + block_pose[:, None, :3]
        return torch.where(self._on_block[..., None], moved, self._local)


def _normal(uniform: torch.Tensor) -> torch.Tensor:
    """Return normal numbers from uniform ones in [0, 1) (Box and Muller 1958), shape (..., 2 m)."""
    first, second = uniform.chunk(2, dim=-1)
    radius = torch.sqrt(-2 * torch.log1p(-first))
    angle = 2 * math.pi * second
    return torch.cat([radius * torch.cos(angle), radius * torch.sin(angle)], dim=-1)

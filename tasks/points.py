"""Point clouds of what is in a scene besides the robot: its block and its obstacles."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from morphgen.model.rotation_torch import matrix_from_quaternion
from morphgen.tasks.sim.base import Block, Scene

NOISE = 0.005
"""Standard deviation of a point's place along each axis, metres, as of a depth camera."""


class PointClouds:
    """P points on the surfaces of every environment's boxes.

    Which points, and how far each is off, is drawn when an episode begins.
    """

    def __init__(self, scenes: Sequence[Scene], count: int, device: torch.device) -> None:
        """Set up.

        Args:
            scenes: Of every environment.
            count: P, points of each.
            device: Where tensors are.
        """
        n = len(scenes)
        self._boxes = [
            ([scene.block] if scene.block is not None else []) + list(scene.obstacles)
            for scene in scenes
        ]
        self._with_block = [scene.block is not None for scene in scenes]
        self._count = count
        self._local = torch.zeros(n, count, 3, device=device)
        self._on_block = torch.zeros(n, count, dtype=torch.bool, device=device)
        some = torch.tensor([bool(boxes) for boxes in self._boxes], device=device)
        self.mask = some[:, None].repeat(1, count)
        """Which points there are, shape (n, P), bool."""

    def begin(self, env: int, random: np.random.Generator) -> None:
        """Draw the points of an episode, as many on a box as its surface has a share."""
        boxes = self._boxes[env]
        if not boxes:
            return
        areas = np.array([_area(box) for box in boxes])
        of = random.choice(len(boxes), self._count, p=areas / areas.sum())
        local = np.array([_on_surface(boxes[k], random) for k in of])
        local += random.normal(0.0, NOISE, local.shape)
        on_block = of == 0 if self._with_block[env] else np.zeros(len(of), dtype=np.bool_)
        for row in np.flatnonzero(~on_block):
            local[row] = boxes[of[row]].pose.apply(tuple(local[row]))
        self._local[env] = torch.from_numpy(local).to(self._local)
        self._on_block[env] = torch.from_numpy(on_block).to(self._on_block.device)

    def __call__(self, block_pose: torch.Tensor) -> torch.Tensor:
        """Points in the root frame, shape (n, P, 3), metres; zeros where there is no box.

        Args:
            block_pose: Of the blocks, shape (n, 7).
        """
        R = matrix_from_quaternion(block_pose[:, 3:])
        carried = self._local @ R.transpose(1, 2) + block_pose[:, None, :3]
        return torch.where(self._on_block[..., None], carried, self._local)


def _area(box: Block) -> float:
    x, y, z = box.size
    return 2 * (x * y + y * z + x * z)


def _on_surface(box: Block, random: np.random.Generator) -> NDArray[np.float64]:
    """A point drawn evenly on the surface, in the box's frame."""
    size = np.array(box.size)
    faces = np.array([size[1] * size[2], size[0] * size[2], size[0] * size[1]])
    axis = random.choice(3, p=faces / faces.sum())
    point = random.uniform(-0.5, 0.5, 3) * size
    point[axis] = random.choice([-0.5, 0.5]) * size[axis]
    return np.asarray(point)

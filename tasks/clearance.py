"""Distances between the links of a batch's robots and the boxes around them.

Every collision primitive of a link that moves stands as a capsule about its longest axis, whose
radius is the mean of the other two half extents. The distance of a capsule from a box is convex
along the axis; bisection finds its minimum. Capsules differ from rims of cylinders, edges of boxes
and flat shapes: over random configurations of arm3, UR5, Panda, xArm7 and Jaco among obstacles,
distances below 5 cm are off by 3 mm in the mean and 8 mm at most, all others by at most 36 mm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from morphgen.errors import TaskError
from morphgen.model.geometry import Mesh, half_extents
from morphgen.model.robot import Robot
from morphgen.typing import Array

BISECTIONS = 8  # halvings of a capsule's axis, to 1/256 of its length


@dataclass(frozen=True, eq=False)
class Capsules:
    """Capsules around the primitives of R robots, S per robot, padded with ones at the root."""

    link: torch.Tensor  # index of each capsule's link, shape (R, S), int64
    ends: torch.Tensor  # ends of its axis in the link frame, shape (R, S, 2, 3) [m]
    radius: torch.Tensor  # shape (R, S) [m]


def compile_capsules(robots: Sequence[Robot], device: torch.device | str) -> Capsules:
    """Compile the collision primitives of robots, but those of links that no joint moves."""
    rows = [_capsules(robot) for robot in robots]
    size = len(robots), max(1, *map(len, rows))
    link, ends, radius = np.zeros(size, dtype=np.int64), np.zeros((*size, 2, 3)), np.zeros(size)
    for r, row in enumerate(rows):
        for s, capsule in enumerate(row):
            link[r, s], ends[r, s], radius[r, s] = capsule
    values = torch.from_numpy(ends).float(), torch.from_numpy(radius).float()
    return Capsules(torch.from_numpy(link).to(device), *(value.to(device) for value in values))


def _capsules(robot: Robot) -> list[tuple[int, Array, float]]:
    """Return link, ends of the axis (2, 3) and radius of a robot's capsules, in the link frames."""
    capsules = []
    for i, link in enumerate(robot.links):
        if not {*robot.joint_chain(link.name)} & {*robot.movable_joints}:
            continue
        for shape in link.collisions:
            if isinstance(shape.geometry, Mesh):
                raise TaskError(
                    f"observation channels contact and clearance: link {link.name!r} of robot "
                    f"{robot.name!r} has a mesh as its collision shape; expected primitives: see "
                    "morphgen fit"
                )
            half = np.array(half_extents(shape.geometry))
            axis = int(half.argmax())
            radius = float((half.sum() - half[axis]) / 2)
            T = shape.T_link_shape.matrix
            offset = max(half[axis] - radius, 0.0) * T[:3, axis]
            capsules.append((i, np.stack([T[:3, 3] - offset, T[:3, 3] + offset]), radius))
    return capsules


def box_distance(point: torch.Tensor, half: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return signed distances (...) [m] of points (..., 3) from boxes with half edges (..., 3).

    Returns also their gradients, unit vectors of shape (..., 3); points and gradients are in the
    frames of the boxes.
    """
    excess = point.abs() - half
    outside = excess.clamp(min=0)
    length = torch.linalg.vector_norm(outside, dim=-1)
    largest = excess.amax(dim=-1)
    # Inside, the nearest face is the one with the largest, least negative excess.
    axes = torch.arange(3, device=point.device)
    face = (axes == excess.argmax(dim=-1, keepdim=True)).to(point.dtype)
    is_outside = (largest > 0)[..., None]
    direction = torch.where(is_outside, outside / length.clamp(min=1e-9)[..., None], face)
    return length + largest.clamp(max=0), torch.copysign(direction, point)


def capsule_box_distance(
    ends: torch.Tensor, radius: torch.Tensor, half: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return signed distances (...) [m] of capsules with ends (..., 2, 3) from boxes (..., 3).

    Returns also the nearest points on the axes and the distances' gradients there, both (..., 3).
    All are in the frames of the boxes, which have half edges (..., 3).
    """
    start, along = ends[..., 0, :], ends[..., 1, :] - ends[..., 0, :]
    fraction = torch.full_like(along[..., :1], 0.5)
    for k in range(2, BISECTIONS + 2):
        _, gradient = box_distance(start + fraction * along, half)
        slope = (gradient * along).sum(dim=-1, keepdim=True)
        fraction = fraction - torch.sign(slope) * 0.5**k
    point = start + fraction * along
    distance, gradient = box_distance(point, half)
    return distance - radius, point, gradient

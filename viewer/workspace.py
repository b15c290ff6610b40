"""The workspace of a tool: its outer shell, and a slice through it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_closing, gaussian_filter

from morphgen.model.frame_positions import frame_positions
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.scene_shapes import Triangles

NUM_POINTS = 200_000
"""Configurations that are sampled for a workspace."""
_AZIMUTHS, _HEIGHTS = 48, 24
"""Directions of the shell: steps around the vertical, and steps of the vertical component."""
_CELLS = 48
"""Cells of a slice along the longest side of the workspace."""


@dataclass(frozen=True, eq=False)
class Slice:
    """Cells of a vertical plane y = constant that the tool reaches."""

    centres: Array
    """Shape (n, 3) [m]."""
    side: float
    """Side of a cell [m]."""
    density: Array
    """Share of the configurations near the cell, relative to the most frequent cell, shape (n,)."""


def sample_workspace(robot: Robot) -> Array:
    """Return tool positions at uniformly random configurations, shape (n, 3) [m]."""
    q = random_configurations(robot, NUM_POINTS, np.random.default_rng(0))
    return frame_positions(robot, q.T).T


def shell(points: Array, y_max: float) -> Triangles:
    """Return the outermost positions by direction from the middle, as far as y is above a limit.

    Args:
        points: Tool positions, shape (n, 3) [m].
        y_max: Faces in front of this plane are left out, so that the inside is visible [m].

    Returns:
        Triangles in the frame of the points; directions without points have none.
    """
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    offset = points - middle
    length = np.linalg.norm(offset, axis=1)
    azimuth = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) % 1
    height = (offset[:, 2] / np.maximum(length, 1e-9) + 1) / 2
    column = np.minimum((azimuth * _AZIMUTHS).astype(int), _AZIMUTHS - 1)
    row = np.minimum((height * _HEIGHTS).astype(int), _HEIGHTS - 1)
    farthest = np.zeros((_HEIGHTS, _AZIMUTHS))
    np.maximum.at(farthest, (row, column), length)
    z = (np.arange(_HEIGHTS) + 0.5) / _HEIGHTS * 2 - 1
    angle = (np.arange(_AZIMUTHS) + 0.5) / _AZIMUTHS * 2 * np.pi
    across = np.sqrt(1 - z**2)[:, None]
    directions = np.stack(
        [across * np.cos(angle), across * np.sin(angle), np.tile(z[:, None], _AZIMUTHS)], axis=-1
    )
    vertices = np.concatenate(
        [
            (middle + farthest[..., None] * directions).reshape(-1, 3),
            middle + np.array([[0, 0, -1], [0, 0, 1]]) * farthest[[0, -1]].mean(axis=1)[:, None],
        ]
    )
    faces = _grid_faces()
    known = np.append(farthest.ravel() > 0, farthest[[0, -1]].max(axis=1) > 0)
    behind = vertices[:, 1] >= y_max
    faces = faces[(known & behind)[faces].all(axis=1)]
    return vertices.astype(np.float32), faces.astype(np.uint32)


def cut(points: Array, y: float) -> Slice:
    """Return the cells of a plane that the tool reaches.

    Args:
        points: Tool positions, shape (n, 3) [m].
        y: Position of the plane [m].
    """
    low, high = points.min(axis=0), points.max(axis=0)
    side = max(float((high - low).max()), 1e-3) / _CELLS
    near = points[np.abs(points[:, 1] - y) < side]
    shape = np.maximum(np.ceil((high - low) / side).astype(int), 1)[[0, 2]]
    index = np.minimum(((near - low) / side).astype(int)[:, [0, 2]], shape - 1)
    count = np.zeros(shape)
    np.add.at(count, tuple(index.T), 1.0)
    filled = gaussian_filter(count, 0.8)
    i, k = np.nonzero(binary_closing(count > 0) | (count > 0))
    centres = np.stack(
        [low[0] + (i + 0.5) * side, np.full(len(i), y), low[2] + (k + 0.5) * side], axis=1
    )
    return Slice(centres, side, filled[i, k] / max(float(filled.max()), 1e-9))


def _grid_faces() -> NDArray[np.intp]:
    """Return the triangles between neighbouring directions, and those at both poles."""
    index = np.arange(_HEIGHTS * _AZIMUTHS).reshape(_HEIGHTS, _AZIMUTHS)
    right = np.roll(index, -1, axis=1)
    quads = np.stack([index[:-1], right[:-1], right[1:], index[1:]], axis=-1).reshape(-1, 4)
    south, north = index.size, index.size + 1
    poles = [
        np.stack([right[0], index[0], np.full(_AZIMUTHS, south)], axis=1),
        np.stack([index[-1], right[-1], np.full(_AZIMUTHS, north)], axis=1),
    ]
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]], *poles])

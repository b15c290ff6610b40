"""Which robot of a population is at a point of the picture, or inside a rectangle.

Every instance is projected to a capsule of the picture: the segment along the longest axis of its
bounding box, as thick as the second longest. Points of the picture are (x, y) in units of its
height, from the upper left corner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from morphgen.model.rotation import to_matrix
from morphgen.typing import Array
from morphgen.viewer.population import Population, instance_centres

TOLERANCE = 0.008
"""Distance from a robot at which it still counts as hit [heights of the picture]."""
_NEAR = 1e-3
"""Instances nearer to the camera, or behind it, are not in the picture [m]."""


@dataclass(frozen=True, eq=False)
class View:
    """The camera of a browser."""

    position: Array
    """Position in the world, shape (3,) [m]."""
    R_world_camera: Array
    """Axes of the camera in the world: right, down, forward, shape (3, 3)."""
    fov: float
    """Vertical field of view [rad]."""
    aspect: float
    """Width of the picture divided by its height."""


@dataclass(frozen=True, eq=False)
class Capsules:
    """Instances in the picture, nearest first; k of them."""

    ends: NDArray[np.float32]
    """Ends of the segments, shape (k, 2, 2)."""
    radius: NDArray[np.float32]
    """Shape (k,)."""
    robot: NDArray[np.intp]
    """Shape (k,)."""


def camera_view(client: viser.ClientHandle) -> View:
    """Return the camera of a browser."""
    camera = client.camera
    w, x, y, z = camera.wxyz.tolist()
    rotation = np.array(to_matrix((w, x, y, z)))
    return View(np.asarray(camera.position), rotation, camera.fov, camera.aspect)


def project_points(view: View, points: Array) -> tuple[Array, Array]:
    """Project points of the world.

    points: Shape (..., 3) [m].

    Returns:
        Points of the picture, shape (..., 2), and depths, shape (...) [m]; points behind the camera
        have a depth below 0 and meaningless coordinates.
    """
    local = (points - view.position) @ view.R_world_camera
    depth = local[..., 2]
    focal = 0.5 / np.tan(view.fov / 2)
    safe = np.where(np.abs(depth) < _NEAR, _NEAR, depth)
    middle = np.array([0.5 * view.aspect, 0.5])
    return focal * local[..., :2] / safe[..., None] + middle, depth


def project(view: View, population: Population, T_world_shape: NDArray[np.float32]) -> Capsules:
    """Project all instances.

    T_world_shape: Poses of all instances, shape (m, 4, 4).
    """
    instances = population.instances
    order = np.argsort(instances.size, axis=1)
    rows = np.arange(len(order))
    longest, second = instances.size[rows, order[:, 2]], instances.size[rows, order[:, 1]]
    axis = T_world_shape[rows, :3, order[:, 2]]
    centre = instance_centres(instances, T_world_shape)
    half = ((longest - second) / 2)[:, None] * axis
    ends, depths = project_points(view, np.stack([centre - half, centre + half], axis=1))
    depth = depths.mean(axis=1)
    radius = 0.25 / np.tan(view.fov / 2) * second / np.maximum(depth, _NEAR)
    low, high = ends.min(axis=1) - radius[:, None], ends.max(axis=1) + radius[:, None]
    seen = (depths > _NEAR).all(axis=1) & (high > 0).all(axis=1)
    seen &= (low < np.array([view.aspect, 1.0])).all(axis=1)
    nearest = np.flatnonzero(seen)[np.argsort(depth[seen], kind="stable")]
    return Capsules(
        ends[nearest].astype(np.float32),
        radius[nearest].astype(np.float32),
        instances.robot[nearest],
    )


def robot_at(capsules: Capsules, point: Array) -> int | None:
    """Return the robot at a point of the picture, shape (2,); None if there is none.

    The nearest robot whose capsule contains the point; else the one within ``TOLERANCE``.
    """
    if not len(capsules.robot):
        return None
    start, along = capsules.ends[:, 0], capsules.ends[:, 1] - capsules.ends[:, 0]
    length = np.maximum((along * along).sum(axis=1), 1e-12)
    share = np.clip(((point - start) * along).sum(axis=1) / length, 0, 1)
    distance = np.linalg.norm(start + share[:, None] * along - point, axis=1) - capsules.radius
    inside = np.flatnonzero(distance <= 0)
    if len(inside):
        return int(capsules.robot[inside[0]])
    closest = int(distance.argmin())
    return int(capsules.robot[closest]) if distance[closest] <= TOLERANCE else None


def robots_in(view: View, centres: Array, low: Array, high: Array) -> NDArray[np.bool_]:
    """Return which robots have their centre inside a rectangle of the picture.

    centres: Centres of the robots in the world, shape (n, 3) [m].
    low: Upper left corner of the rectangle, shape (2,).
    high: Lower right corner of the rectangle, shape (2,).

    Returns:
        Shape (n,).
    """
    points, depth = project_points(view, centres)
    inside = (points >= low) & (points <= high)
    return np.asarray(inside.all(axis=1) & (depth > _NEAR))

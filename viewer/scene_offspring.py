"""A generation in viser's scene: the parent, and a 3 x 3 grid of its offspring beside it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser

from morphgen.formats.bundle import split_colours
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.scene_robot import RobotView, add_robot, robot_bounds
from morphgen.viewer.scene_stage import add_ground, look_at

COLUMNS = 3
CAMERA_DIRECTION = (0.08, -0.8, 0.62)
"""Direction to the camera: columns run from left to right, and the first row is the farthest."""
_GAP = 1.25
"""Distance of two columns in widths of the widest robot."""
_ROW = 0.8
"""Smallest distance of two rows in the longest sides of the largest robot: rows are seen from
above at an angle."""


@dataclass(eq=False)
class OffspringScene:
    """The offspring in a scene."""

    views: list[RobotView]
    labels: list[viser.LabelHandle]
    boxes: Array
    """Lowest and highest corner of each robot in the world, shape (n, 2, 3) [m]."""


def add_offspring(
    client: viser.ClientHandle, parent: Robot, robots: Sequence[Robot]
) -> OffspringScene:
    """Draw the offspring beside the parent, which stands at the origin, and look at all."""
    bounds = np.array([robot_bounds(robot) for robot in (parent, *robots)])
    sizes = (bounds[:, 1] - bounds[:, 0]).max(axis=0)
    step_x = _GAP * float(sizes[0])
    step_y = max(_GAP * float(sizes[1]), _ROW * float(sizes.max()))
    views, labels = [], []
    boxes = np.empty((len(robots), 2, 3))
    with client.atomic():
        for i, robot in enumerate(robots):
            row, column = divmod(i, COLUMNS)
            position = ((column + 1.3) * step_x, (1 - row) * step_y, 0.0)
            boxes[i] = bounds[i + 1] + position
            views.append(add_robot(client.scene, split_colours(robot), f"/offspring{i}", position))
            above = (0.0, 0.0, float(bounds[i + 1, 1, 2]) + 0.04 * step_x)
            labels.append(
                client.scene.add_label(
                    f"/offspring{i}/label", str(i + 1), position=above, anchor="bottom-center"
                )
            )
        low = np.minimum(boxes[:, 0].min(axis=0), bounds[0, 0])
        high = np.maximum(boxes[:, 1].max(axis=0), bounds[0, 1])
        add_ground(client.scene, float(np.linalg.norm(high - low)))
        look_at(client, low, high, CAMERA_DIRECTION)
    return OffspringScene(views, labels, boxes)


def remove_offspring(scene: OffspringScene) -> None:
    """Remove the offspring from the scene."""
    for view in scene.views:
        view.base.remove()


def hit_robot(boxes: Array, origin: Array, direction: Array) -> int | None:
    """Return the index of the nearest box that a ray meets; None if it meets none.

    Args:
        boxes: Lowest and highest corners, shape (n, 2, 3) [m].
        origin: Start of the ray, shape (3,) [m].
        direction: Direction of the ray, shape (3,).
    """
    safe = np.where(np.abs(direction) < 1e-12, 1e-12, direction)
    distances = (boxes - origin) / safe
    near = distances.min(axis=1).max(axis=1)
    far = distances.max(axis=1).min(axis=1)
    hits = np.flatnonzero((near <= far) & (far > 0))
    return int(hits[np.argmin(near[hits])]) if len(hits) else None

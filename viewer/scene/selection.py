"""Marks on a robot: the outline of the selected link, and the axis and range of a joint."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from morphgen.model.geometry import Geometry
from morphgen.model.robot import Joint
from morphgen.model.rotation import Vec3
from morphgen.typing import Array
from morphgen.viewer.scene.robot import RobotView, robot_extent
from morphgen.viewer.scene.stage import Rgb, Triangles, grown_triangles

SELECTED: Rgb = (0, 190, 220)
"""Colour of the selected link's outline, of its slider and its card. Red means collision only."""
RANGE: Rgb = (250, 176, 5)
"""Colour of a joint's range; its axis is orange or blue as in the overlay of all axes."""
_OUTLINE_COLOUR: Rgb = (60, 240, 255)
"""Brighter than ``SELECTED``, because the outline is in the shade of its link."""
_OUTLINE = 0.009
"""Thickness of the outline, in extents of the robot."""
_RADIUS = 0.18
"""Radius of the arc that shows a range, in extents of the robot."""
_ARC_STEPS = 48


def outline_triangles(geometry: Geometry, thickness: float) -> Triangles:
    """Return the surface of a geometry, moved outwards by a thickness [m] and inside out.

    Where only front faces are drawn, it is visible around the geometry and nowhere else.
    """
    vertices, faces = grown_triangles(geometry, thickness)
    return vertices, np.ascontiguousarray(faces[:, ::-1])


def draw_outline(view: RobotView, link: int) -> list[Any]:
    """Draw the outline of a link's visual shapes; return its scene nodes."""
    thickness = _OUTLINE * robot_extent(view.robot)
    shapes = view.robot.links[link].visuals or view.robot.links[link].collisions
    return [
        view.scene.add_mesh_simple(
            f"{view.name}/{link}/outline{i}",
            *outline_triangles(shape.geometry, thickness),
            color=_OUTLINE_COLOUR,
            side="front",
            flat_shading=True,
            position=shape.T_link_shape.position,
            wxyz=shape.T_link_shape.quaternion,
            cast_shadow=False,
            receive_shadow=False,
        )
        for i, shape in enumerate(shapes)
    ]


def draw_range(view: RobotView, index: int) -> list[Any]:
    """Draw the axis and the range of a joint with a needle at its position; return the nodes.

    The range is fixed to the parent link and the needle to the child, so both follow the robot.
    """
    robot, joint = view.robot, view.robot.joints[index]
    parent, child = robot.parents[index + 1], index + 1
    size = _RADIUS * robot_extent(robot)
    needle, tracks, axis = range_lines(joint, size, _needle_direction(view, index))
    T_parent_joint = joint.T_parent_joint

    def add(name: str, node: int, lines: Array, colour: Rgb, thickness: float, *, at: bool) -> Any:  # noqa: ANN401
        return view.scene.add_line_segments(
            f"{view.name}/{node}/{name}",
            lines,
            colour,
            thickness=thickness,
            thickness_units="screen",
            position=T_parent_joint.position if at else (0.0, 0.0, 0.0),
            wxyz=T_parent_joint.quaternion if at else (1.0, 0.0, 0.0, 0.0),
        )

    return [
        add("range", parent, tracks, RANGE, 4.0, at=True),
        add("range_axis", parent, axis, RANGE, 2.0, at=True),
        add("range_needle", child, needle, SELECTED, 5.0, at=False),
    ]


def range_lines(joint: Joint, size: float, direction: Vec3) -> tuple[Array, Array, Array]:
    """Return the lines that show a joint's range.

    size: Radius of the arc, and half the length of the axis [m].

    Returns:
        Lines of the needle in the child's frame, and of the range and the axis in the joint's frame
        at position zero, each of shape (n, 2, 3) [m].
    """
    axis, side = np.array(joint.unit_axis), np.array(direction)
    low, high = joint.effective_limits
    axis_line = np.array([[-size * axis, size * axis]])
    if joint.kind == "prismatic":
        across = 0.15 * size * side
        track = np.array([[low * axis, high * axis], *_ticks(axis, across, (low, high))])
        return np.array([[-2 * across, 2 * across]]), track, axis_line
    high = min(high, low + 2 * np.pi)
    angles = np.linspace(low, high, _ARC_STEPS + 1)
    third = np.cross(axis, side)
    points = size * (np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * third)
    arc = np.stack([points[:-1], points[1:]], axis=1)
    ends = np.array([[0.8 * points[0], points[0]], [0.8 * points[-1], points[-1]]])
    needle = np.array([[0.7 * size * side, 1.25 * size * side]])
    return needle, np.concatenate([arc, ends]), axis_line


def _ticks(axis: NDArray[np.float64], across: Array, positions: tuple[float, float]) -> list[Array]:
    """Return a line across the axis at each position [m]."""
    return [np.array([p * axis - across, p * axis + across]) for p in positions]


def _needle_direction(view: RobotView, index: int) -> Vec3:
    """Return a direction perpendicular to a joint's axis that points out of its child link.

    It is also perpendicular to the direction in which the child extends, which hides lines.
    """
    robot, axis = view.robot, np.array(view.robot.joints[index].unit_axis)
    child = index + 1
    candidates = [
        np.array(joint.T_parent_joint.position)
        for joint, parent in zip(robot.joints, robot.parents[1:], strict=True)
        if parent == child
    ]
    inertial = robot.links[child].inertial
    if inertial is not None:
        candidates.append(np.array(inertial.com))
    candidates += list(np.eye(3))
    across = [point - (point @ axis) * axis for point in candidates]
    best = next(vector for vector in across if np.linalg.norm(vector) > 1e-3)
    x, y, z = (np.cross(axis, best) / np.linalg.norm(best)).tolist()
    return (x, y, z)

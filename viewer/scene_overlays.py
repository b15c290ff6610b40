"""What can be drawn over a robot: axes, centres of mass, ignored pairs, workspace and trail."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from morphgen.model.kinematics import frame_positions, random_configurations
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array
from morphgen.viewer.scene_robot import RobotView, robot_extent

POINTS = 12_000
"""Of a workspace."""
TRAIL = 400
"""FileAccess of the tool that a trail keeps."""
_ORANGE, _BLUE, _GREY = (247, 103, 7), (25, 113, 194), (134, 142, 150)


@dataclass(eq=False)
class Overlays:
    """What is drawn over a robot now."""

    view: RobotView
    nodes: dict[str, list[Any]] = field(default_factory=dict)
    """viser's nodes by the overlay."""
    trail: deque[Array] = field(default_factory=lambda: deque(maxlen=TRAIL))


def has_tool(robot: Robot) -> bool:
    """Whether a robot has a tool frame."""
    return any(frame.name == TOOL for frame in robot.frames)


def remove(overlays: Overlays, name: str) -> None:
    """Take an overlay away."""
    for node in overlays.nodes.pop(name, []):
        node.remove()
    if name == "trail":
        overlays.trail.clear()


def show_joint_axes(overlays: Overlays) -> None:
    """An arrow along every movable joint's axis, orange for turns and blue for slides."""
    view = overlays.view
    length = 0.14 * robot_extent(view.robot)
    nodes = overlays.nodes.setdefault("joint axes", [])
    for k in view.robot.movable_joints:
        joint = view.robot.joints[k]
        arrow = np.array([[np.zeros(3), length * np.array(joint.unit_axis)]])
        nodes.append(
            view.scene.add_arrows(
                f"{view.name}/{k + 1}/axis",
                arrow,
                _BLUE if joint.kind == "prismatic" else _ORANGE,
                shaft_radius=0.02 * length,
                head_radius=0.06 * length,
                head_length=0.2 * length,
            )
        )


def show_mass_centres(overlays: Overlays) -> None:
    """A ball at every link's centre of mass, its volume in proportion to the mass."""
    view = overlays.view
    heaviest = max((link.inertial.mass for link in view.robot.links if link.inertial), default=0.0)
    nodes = overlays.nodes.setdefault("centres of mass", [])
    for i, link in enumerate(view.robot.links):
        if link.inertial is None or link.inertial.mass <= 0:
            continue
        share = (link.inertial.mass / heaviest) ** (1 / 3)
        nodes.append(
            view.scene.add_icosphere(
                f"{view.name}/{i}/com",
                radius=0.022 * robot_extent(view.robot) * share,
                color=(33, 37, 41),
                position=link.inertial.com,
            )
        )


def show_ignored_pairs(overlays: Overlays) -> None:
    """A line between the links of every pair that is not tested for collision."""
    remove(overlays, "ignored pairs")
    view = overlays.view
    points = _link_points(view)
    index = view.robot.link_index
    lines = [
        (points[index[a]], points[index[b]])
        for a, b in view.robot.ignore_pairs
        if a in index and b in index
    ]
    if lines:
        name = f"{view.name}/ignored"
        node = view.scene.add_line_segments(
            name, np.array(lines), _GREY, thickness=2.0, thickness_units="screen"
        )
        overlays.nodes["ignored pairs"] = [node]


def workspace_points(robot: Robot) -> Array:
    """Where the tool goes, at configurations drawn uniformly, shape (n, 3), metres."""
    q = random_configurations(robot, POINTS, np.random.default_rng(0))
    return frame_positions(robot, q.T).T


def show_workspace(overlays: Overlays, points: Array) -> None:
    """A cloud of places of the tool, coloured by their distance from the root."""
    remove(overlays, "workspace")
    view = overlays.view
    far = np.linalg.norm(points, axis=1)
    share = ((far - far.min()) / max(float(np.ptp(far)), 1e-9))[:, None]
    colours = (1 - share) * np.array([32, 129, 226]) + share * np.array([250, 176, 5])
    node = view.scene.add_point_cloud(
        f"{view.name}/workspace",
        points,
        colours.astype(np.uint8),
        point_size=0.0014 * max(float(far.max()), 0.1),
        point_shape="circle",
        precision="float32",
    )
    overlays.nodes["workspace"] = [node]


def extend_trail(overlays: Overlays, position: Array) -> None:
    """Draw the way that the tool went, to a new place."""
    if overlays.trail and np.linalg.norm(overlays.trail[-1] - position) < 1e-5:
        return
    overlays.trail.append(position)
    for node in overlays.nodes.pop("trail", []):
        node.remove()
    if len(overlays.trail) > 1:
        places = np.array(overlays.trail)
        node = overlays.view.scene.add_line_segments(
            f"{overlays.view.name}/trail",
            np.stack([places[:-1], places[1:]], axis=1),
            _ORANGE,
            thickness=3.0,
            thickness_units="screen",
        )
        overlays.nodes["trail"] = [node]


def _link_points(view: RobotView) -> Array:
    """The centres of mass, or origins, of links where they are now, shape (n_links, 3)."""
    if view.T_root_link is None:
        raise ValueError("the robot was not placed yet")
    centres = np.array(
        [link.inertial.com if link.inertial else (0, 0, 0) for link in view.robot.links]
    )
    return np.asarray(
        np.einsum("nij,nj->ni", view.T_root_link[:, :3, :3], centres) + view.T_root_link[:, :3, 3]
    )

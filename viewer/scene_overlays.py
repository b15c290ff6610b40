"""Drawings over a robot: joint axes, centres of mass, ignored pairs, workspace and tool trail."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from morphgen.model.frame_positions import frame_positions
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.scene_robot import RobotView, robot_extent

NUM_POINTS = 12_000
"""Configurations that are sampled to draw a workspace."""
TRAIL_LENGTH = 400
"""Tool positions that a trail keeps."""
_ORANGE, _BLUE, _GREY, _BLACK = (247, 103, 7), (25, 113, 194), (134, 142, 150), (33, 37, 41)
_NEAR, _FAR = np.array([32, 129, 226]), np.array([250, 176, 5])
"""Colours of the workspace nearest to and farthest from the root."""


@dataclass(eq=False)
class Overlays:
    """The overlays of a robot."""

    view: RobotView
    nodes: dict[str, list[Any]] = field(default_factory=dict)
    """viser's scene nodes by overlay."""
    trail: deque[Array] = field(default_factory=lambda: deque(maxlen=TRAIL_LENGTH))
    """Recent tool positions [m]."""


def remove_overlay(overlays: Overlays, name: str) -> None:
    """Remove an overlay."""
    for node in overlays.nodes.pop(name, []):
        node.remove()
    if name == "trail":
        overlays.trail.clear()


def show_joint_axes(overlays: Overlays) -> None:
    """Draw an arrow along every movable joint's axis: orange rotates, blue slides."""
    view = overlays.view
    length = 0.14 * robot_extent(view.robot)
    overlays.nodes["joint axes"] = [
        view.scene.add_arrows(
            f"{view.name}/{k + 1}/axis",  # joint k attaches link k + 1
            np.array([[np.zeros(3), length * np.array(view.robot.joints[k].unit_axis)]]),
            _BLUE if view.robot.joints[k].kind == "prismatic" else _ORANGE,
            shaft_radius=0.02 * length,
            head_radius=0.06 * length,
            head_length=0.2 * length,
        )
        for k in view.robot.movable_joints
    ]


def show_mass_centres(overlays: Overlays) -> None:
    """Draw a ball at every link's centre of mass; its volume is proportional to the mass."""
    view = overlays.view
    inertials = {i: link.inertial for i, link in enumerate(view.robot.links) if link.inertial}
    heaviest = max((inertial.mass for inertial in inertials.values()), default=0.0)
    overlays.nodes["centres of mass"] = [
        view.scene.add_icosphere(
            f"{view.name}/{i}/com",
            radius=0.022 * robot_extent(view.robot) * (inertial.mass / heaviest) ** (1 / 3),
            color=_BLACK,
            position=inertial.com,
        )
        for i, inertial in inertials.items()
        if inertial.mass > 0
    ]


def show_ignored_pairs(overlays: Overlays) -> None:
    """Draw a line between the links of every pair whose contacts are ignored.

    A line ends at the links' centres of mass, or at their origins for links without inertia.
    """
    remove_overlay(overlays, "ignored pairs")
    view = overlays.view
    centres = np.array(
        [link.inertial.com if link.inertial else (0, 0, 0) for link in view.robot.links]
    )
    rotations, origins = view.T_root_link[:, :3, :3], view.T_root_link[:, :3, 3]
    points = np.einsum("nij,nj->ni", rotations, centres) + origins
    index = view.robot.link_index
    lines = [
        (points[index[a]], points[index[b]])
        for a, b in view.robot.ignore_pairs
        if a in index and b in index
    ]
    if lines:
        node = view.scene.add_line_segments(
            f"{view.name}/ignored", np.array(lines), _GREY, thickness=2.0, thickness_units="screen"
        )
        overlays.nodes["ignored pairs"] = [node]


def sample_workspace(robot: Robot) -> Array:
    """Return tool positions at uniformly random configurations, shape (n, 3) [m]."""
    q = random_configurations(robot, NUM_POINTS, np.random.default_rng(0))
    return frame_positions(robot, q.T).T


def show_workspace(overlays: Overlays, points: Array) -> None:
    """Draw tool positions as a cloud, coloured by their distance from the root."""
    remove_overlay(overlays, "workspace")
    view = overlays.view
    distances = np.linalg.norm(points, axis=1)
    spread = max(float(np.ptp(distances)), 1e-9)
    share = ((distances - distances.min()) / spread)[:, None]
    node = view.scene.add_point_cloud(
        f"{view.name}/workspace",
        points,
        ((1 - share) * _NEAR + share * _FAR).astype(np.uint8),
        point_size=0.0014 * max(float(distances.max()), 0.1),
        point_shape="circle",
        precision="float32",
    )
    overlays.nodes["workspace"] = [node]


def extend_trail(overlays: Overlays, position: Array) -> None:
    """Extend the trail of the tool to a position, unless it has not moved (10 um)."""
    if overlays.trail and np.linalg.norm(overlays.trail[-1] - position) < 1e-5:
        return
    overlays.trail.append(position)
    for node in overlays.nodes.pop("trail", []):
        node.remove()
    if len(overlays.trail) > 1:
        positions = np.array(overlays.trail)
        node = overlays.view.scene.add_line_segments(
            f"{overlays.view.name}/trail",
            np.stack([positions[:-1], positions[1:]], axis=1),
            _ORANGE,
            thickness=3.0,
            thickness_units="screen",
        )
        overlays.nodes["trail"] = [node]

"""Drawings over a robot: axes, names, workspace, and marks of a selection."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from morphgen.model.kinematics import frame_positions, random_configurations
from morphgen.model.robot import Link, Robot
from morphgen.model.rotation import Vec3
from morphgen.typing import Array
from morphgen.viewer.scene.robot import RobotView, robot_extent
from morphgen.viewer.scene.stage import Rgb, Triangles, grown_triangles

NUM_POINTS = 200_000  # configurations that are sampled for a workspace
_SHELL_SUBDIVISIONS = 3  # divisions of an icosahedron: 642 vertices, the shell's directions


def workspace_shell(robot: Robot) -> Triangles:
    """Return the outermost tool positions of uniformly random configurations."""
    q = random_configurations(robot, NUM_POINTS, np.random.default_rng(0))
    return shell(frame_positions(robot, q.T).T)


def shell(points: Array) -> Triangles:
    """Return the outermost of positions (n, 3) [m] by direction, with faces between them."""
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    ball = trimesh.creation.icosphere(subdivisions=_SHELL_SUBDIVISIONS)
    length = np.linalg.norm(points - middle, axis=1)
    _, nearest = cKDTree(ball.vertices).query((points - middle) / np.maximum(length, 1e-9)[:, None])
    farthest = np.zeros(len(ball.vertices))
    np.maximum.at(farthest, nearest, length)
    vertices = middle + farthest[:, None] * ball.vertices
    faces = ball.faces[(farthest > 0)[ball.faces].all(axis=1)]
    return vertices.astype(np.float32), faces.astype(np.uint32)


_ORANGE, _BLUE, _BLACK = (247, 103, 7), (25, 113, 194), (33, 37, 41)
_SHELL: Rgb = (76, 110, 245)
_NAME_DISTANCE = 0.045  # distance below which links share a label, in extents of the robot


def remove_overlay(view: RobotView, name: str) -> None:
    """Remove an overlay."""
    for node in view.overlays.pop(name, []):
        node.remove()


def _centre(link: Link) -> Vec3:
    """Return a link's centre of mass, or its origin if it has no mass."""
    return link.inertial.com if link.inertial else (0.0, 0.0, 0.0)


def show_joint_axes(view: RobotView) -> None:
    """Draw an arrow along every movable joint's axis: orange rotates, blue slides."""
    length = 0.14 * robot_extent(view.robot)
    view.overlays["joint axes"] = [
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


def show_mass_centres(view: RobotView) -> None:
    """Draw a ball at every link's centre of mass; its volume is proportional to the mass."""
    inertials = {i: link.inertial for i, link in enumerate(view.robot.links) if link.inertial}
    heaviest = max((inertial.mass for inertial in inertials.values()), default=0.0)
    view.overlays["centres of mass"] = [
        view.scene.add_icosphere(
            f"{view.name}/{i}/com",
            radius=0.022 * robot_extent(view.robot) * (inertial.mass / heaviest) ** (1 / 3),
            color=_BLACK,
            position=inertial.com,
        )
        for i, inertial in inertials.items()
        if inertial.mass > 0
    ]


def show_names(view: RobotView) -> None:
    """Write the name of every link at its centre of mass; near ones share a label."""
    near = _NAME_DISTANCE * robot_extent(view.robot)
    groups: list[tuple[int, Array, list[str]]] = []
    for i, link in enumerate(view.robot.links):
        T_root_link = view.T_root_link[i]
        position = T_root_link[:3, :3] @ _centre(link) + T_root_link[:3, 3]
        group = next((g for g in groups if np.linalg.norm(g[1] - position) < near), None)
        if group is None:
            groups.append((i, position, [link.name]))
        else:
            group[2].append(link.name)
    view.overlays["names"] = [
        view.scene.add_label(
            f"{view.name}/{i}/name",
            f"{first} + {len(more)}" if more else first,
            font_screen_scale=0.75,
            position=_centre(view.robot.links[i]),
            anchor="center-left",
        )
        for i, _, (first, *more) in groups
    ]


def show_workspace(view: RobotView, outside: Triangles) -> None:
    """Draw the shell of the tool's positions."""
    view.overlays["workspace"] = [
        view.scene.add_mesh_simple(
            f"{view.name}/workspace",
            *outside,
            color=_SHELL,
            opacity=0.22,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
        )
    ]


SELECTED: Rgb = (0, 190, 220)  # outline, slider and card of the link; red means collision only
_OUTLINE_COLOUR: Rgb = (60, 240, 255)  # brighter: the outline is in its link's shade
_OUTLINE = 0.009  # thickness of the outline, in extents of the robot


def show_outline(view: RobotView, link: int | None) -> None:
    """Draw the outline of a link's visual shapes; without a link, of none.

    It is the surface moved outwards and turned inside out: where only front faces are drawn, it is
    visible around the shapes and nowhere else.
    """
    remove_overlay(view, "outline")
    if link is None:
        return
    thickness = _OUTLINE * robot_extent(view.robot)
    shapes = view.robot.links[link].visuals or view.robot.links[link].collisions
    surfaces = [grown_triangles(shape.geometry, thickness) for shape in shapes]
    view.overlays["outline"] = [
        view.scene.add_mesh_simple(
            f"{view.name}/{link}/outline{i}",
            vertices,
            np.ascontiguousarray(faces[:, ::-1]),
            color=_OUTLINE_COLOUR,
            side="front",
            flat_shading=True,
            position=shape.T_link_shape.position,
            wxyz=shape.T_link_shape.quaternion,
            cast_shadow=False,
            receive_shadow=False,
        )
        for i, (shape, (vertices, faces)) in enumerate(zip(shapes, surfaces, strict=True))
    ]

"""A robot in a browser's scene: its links, in several layers, at any configuration."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np
import viser
from numpy.typing import ArrayLike

from morphgen.model.geometry import Pose, Shape
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Inertial, Link, Robot
from morphgen.typing import Array
from morphgen.viewer.shapes import Triangles, ellipsoid, triangles

Rgb = tuple[int, int, int]
Layer = Literal["visual", "collision", "primitives", "inertia"]
LAYERS: tuple[Layer, ...] = get_args(Layer)

PLAIN: Rgb = (176, 182, 190)
"""Colour of what names none."""
RED: Rgb = (224, 49, 49)
_COLOURS: Mapping[Layer, Rgb] = {
    "collision": (64, 192, 87),
    "primitives": (253, 126, 20),
    "inertia": (151, 117, 250),
}
_OPACITY: Mapping[Layer, float] = {"collision": 0.45, "primitives": 0.6, "inertia": 0.5}


@dataclass(eq=False)
class Drawn:
    """A mesh in the scene."""

    handle: viser.MeshHandle
    colour: Rgb


@dataclass(eq=False)
class RobotView:
    """A robot in a scene."""

    scene: viser.SceneApi
    robot: Robot
    name: str
    """Of its node in the scene."""
    base: viser.FrameHandle
    links: list[viser.FrameHandle]
    """Where each link is, in the order of the robot's."""
    layers: dict[Layer, list[list[Drawn]]] = field(default_factory=dict)
    """What was drawn so far, by link."""
    hidden: set[Layer] = field(default_factory=set)
    red: frozenset[str] = frozenset()
    T_root_link: Array | None = None
    """Where the links are now, shape (n_links, 4, 4)."""


def add_robot(
    scene: viser.SceneApi,
    robot: Robot,
    name: str,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> RobotView:
    """Draw a robot's visual shapes at home.

    Args:
        scene: Where.
        robot: The body.
        name: Of its node in the scene, such as ``/robot``.
        position: Of its root, metres.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    base = scene.add_frame(name, show_axes=False, position=position)
    size = 0.12 * robot_extent(robot)
    links = [
        scene.add_frame(
            f"{name}/{i}",
            show_axes=False,
            axes_length=size,
            axes_radius=0.04 * size,
            origin_radius=0.08 * size,
        )
        for i in range(len(robot.links))
    ]
    view = RobotView(scene, robot, name, base, links)
    move(view, robot.home)
    show_layer(view, "visual", [link.visuals or link.collisions for link in robot.links])
    return view


def move(view: RobotView, q: ArrayLike) -> Array:
    """Show a robot at a configuration.

    Args:
        view: The robot.
        q: Independent joint positions, shape (dof,), rad or m.

    Returns:
        Pose of every link in the root frame, shape (n_links, 4, 4).
    """
    T_root_link = forward_kinematics(view.robot, q)
    for handle, T in zip(view.links, T_root_link, strict=True):
        pose = Pose.from_matrix(T)
        handle.position, handle.wxyz = pose.position, pose.quaternion
    view.T_root_link = T_root_link
    return T_root_link


def show_layer(view: RobotView, layer: Layer, shapes: Sequence[Sequence[Shape]]) -> None:
    """Draw shapes by link; what the layer showed before is removed."""
    drop_layer(view, layer)
    view.hidden.discard(layer)
    opacity = _OPACITY.get(layer)
    view.layers[layer] = [
        [
            _draw(view, f"{view.name}/{i}/{layer}{j}", shape, _colour(layer, shape), opacity)
            for j, shape in enumerate(of_link)
        ]
        for i, of_link in enumerate(shapes)
    ]


def show_inertia(view: RobotView) -> None:
    """Draw the ellipsoid of every link's inertia: solid, of the link's mass and inertia."""
    drop_layer(view, "inertia")
    view.hidden.discard("inertia")
    view.layers["inertia"] = [
        _draw_inertia(view, i, link) for i, link in enumerate(view.robot.links)
    ]


def drop_layer(view: RobotView, layer: Layer) -> None:
    """Remove a layer's shapes."""
    for of_link in view.layers.pop(layer, []):
        for drawn in of_link:
            drawn.handle.remove()


def set_visible(view: RobotView, layer: Layer, visible: bool) -> None:
    """Show or hide a layer that was drawn."""
    (view.hidden.discard if visible else view.hidden.add)(layer)
    for of_link in view.layers.get(layer, []):
        for drawn in of_link:
            drawn.handle.visible = visible


def set_opacity(view: RobotView, opacity: float) -> None:
    """Make the visual shapes see-through: 0 nothing is seen, 1 nothing behind."""
    for of_link in view.layers.get("visual", []):
        for drawn in of_link:
            drawn.handle.opacity = None if opacity >= 1 else opacity


def paint_red(view: RobotView, names: Collection[str]) -> None:
    """Paint links red, and those that were red before as they were."""
    if (names := frozenset(names)) == view.red:
        return
    for layer in ("visual", "collision"):
        for link, of_link in zip(view.robot.links, view.layers.get(layer, []), strict=False):
            if (link.name in names) != (link.name in view.red):
                for drawn in of_link:
                    drawn.handle.color = RED if link.name in names else drawn.colour
    view.red = names


def paint(view: RobotView, layer: Layer, colours: Mapping[str, Rgb]) -> None:
    """Give links other colours in a layer."""
    for link, of_link in zip(view.robot.links, view.layers.get(layer, []), strict=False):
        for drawn in of_link:
            if link.name in colours:
                drawn.handle.color = drawn.colour = colours[link.name]


def show_axes(view: RobotView, visible: bool) -> None:
    """Show or hide the frame of every link."""
    for handle in view.links:
        handle.show_axes = visible


def robot_bounds(robot: Robot, q: ArrayLike | None = None) -> tuple[Array, Array]:
    """Lowest and highest corner of a robot with its root's origin, in the root frame, metres."""
    T_root_link = forward_kinematics(robot, robot.home if q is None else q)
    points = [np.zeros((1, 3))]
    for T, link in zip(T_root_link, robot.links, strict=True):
        if shapes := link.visuals or link.collisions:
            low, high = bounding_box(shapes)
            corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
            points.append(corners @ T[:3, :3].T + T[:3, 3])
    every = np.concatenate(points)
    return every.min(axis=0), every.max(axis=0)


def robot_extent(robot: Robot) -> float:
    """Longest side of what holds a robot at home, metres; at least 5 cm."""
    low, high = robot_bounds(robot)
    return max(float((high - low).max()), 0.05)


def look_at(
    client: viser.ClientHandle,
    low: Array,
    high: Array,
    direction: tuple[float, float, float] = (0.82, 0.52, 0.42),
) -> None:
    """Turn a browser's camera so that a box is seen whole, obliquely from the front."""
    middle, size = (low + high) / 2, float(np.linalg.norm(high - low))
    away = max(0.66 * size, 0.12)
    client.camera.position = middle + 1.35 * away * np.array(direction)
    client.camera.look_at = middle
    client.camera.near = min(0.01, away / 50)


def inertia_semi_axes(inertial: Inertial) -> tuple[Array, Array] | None:
    """The solid ellipsoid with a link's mass and inertia.

    Of an ellipsoid with semi-axes a, b, c: I_a = m (b^2 + c^2) / 5.

    Returns:
        Semi-axes (3,), metres, and their directions as columns (3, 3) in link axes; None without
        mass or with an inertia that no body has.
    """
    if inertial.mass <= 0:
        return None
    moments, axes = np.linalg.eigh(inertial.matrix)
    squares = 2.5 / inertial.mass * (moments.sum() - 2 * moments)
    if (squares < -1e-9).any() or not (squares > 0).any():
        return None
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return np.sqrt(np.maximum(squares, 1e-8)), axes


def _draw(view: RobotView, name: str, shape: Shape, colour: Rgb, opacity: float | None) -> Drawn:
    return _add(view, name, triangles(shape.geometry), shape.T_link_shape, colour, opacity)


def _draw_inertia(view: RobotView, i: int, link: Link) -> list[Drawn]:
    found = inertia_semi_axes(link.inertial) if link.inertial else None
    if link.inertial is None or found is None:
        return []
    (a, b, c), axes = found[0].tolist(), found[1]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = axes, link.inertial.com
    pose = Pose.from_matrix(T)
    name = f"{view.name}/{i}/inertia"
    return [_add(view, name, ellipsoid((a, b, c)), pose, _COLOURS["inertia"], _OPACITY["inertia"])]


def _add(
    view: RobotView,
    name: str,
    surface: Triangles,
    pose: Pose,
    colour: Rgb,
    opacity: float | None,
) -> Drawn:
    vertices, faces = surface
    handle = view.scene.add_mesh_simple(
        name,
        vertices,
        faces,
        color=colour,
        opacity=opacity,
        side="double",
        position=pose.position,
        wxyz=pose.quaternion,
        cast_shadow=opacity is None,
    )
    return Drawn(handle, colour)


def _colour(layer: Layer, shape: Shape) -> Rgb:
    if layer in _COLOURS:
        return _COLOURS[layer]
    if shape.rgba is None:
        return PLAIN
    red, green, blue = (round(255 * channel) for channel in shape.rgba[:3])
    return (red, green, blue)

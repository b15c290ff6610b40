"""A robot in viser's scene: its links in several layers, at any configuration."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal, get_args

import numpy as np
import trimesh
import viser
from numpy.typing import ArrayLike, NDArray

from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Pose, Shape, Sphere
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Inertial, Robot
from morphgen.typing import Array

Rgb = tuple[int, int, int]
Triangles = tuple[NDArray[np.float32], NDArray[np.uint32]]
"""Vertices (n, 3) [m] and faces (m, 3)."""
Layer = Literal["visual", "collision", "primitives", "inertia"]
LAYERS: tuple[Layer, ...] = get_args(Layer)

GREY: Rgb = (176, 182, 190)
"""Colour of shapes without their own."""
RED: Rgb = (224, 49, 49)
"""Colour of colliding or selected links."""
_COLOURS: Mapping[Layer, Rgb] = {
    "collision": (64, 192, 87),
    "primitives": (253, 126, 20),
    "inertia": (151, 117, 250),
}
_OPACITY: Mapping[Layer, float] = {"collision": 0.45, "primitives": 0.6, "inertia": 0.5}
SHARP_ANGLE = np.radians(35.0)
"""Edges between faces that meet at a larger angle are drawn sharp. Tuned by eye on real arms."""
_MAX_SMOOTHED_FACES = 150_000
"""Largest mesh whose sharp edges are searched; larger ones would take seconds [faces]."""
_CYLINDER_SECTIONS = 48
_MIN_EXTENT = 0.05
"""Smallest extent by which axes and markers are scaled [m]."""


@dataclass(eq=False)
class DrawnShape:
    """A mesh in the scene and its own colour."""

    handle: viser.MeshHandle
    colour: Rgb


@dataclass(eq=False)
class RobotView:
    """A robot in a scene."""

    scene: viser.SceneApi
    robot: Robot
    name: str
    """Name of the robot's node in the scene, such as ``/robot``."""
    base: viser.FrameHandle
    links: list[viser.FrameHandle]
    """Frames of the links, in the order of ``robot.links``."""
    layers: dict[Layer, list[list[DrawnShape]]] = field(default_factory=dict)
    """Shapes by link of the layers drawn so far."""
    red: frozenset[str] = frozenset()
    """Names of the links that are painted red."""
    T_root_link: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """Current pose of every link in the root frame, shape (n_links, 4, 4)."""

    def set_configuration(self, q: ArrayLike) -> None:
        """Move the robot to independent joint positions, shape (dof,) [rad or m]."""
        self.T_root_link = forward_kinematics(self.robot, q)
        for handle, T in zip(self.links, self.T_root_link, strict=True):
            pose = Pose.from_matrix(T)
            handle.position, handle.wxyz = pose.position, pose.quaternion

    def show_shapes(self, layer: Layer, shapes: Sequence[Sequence[Shape]]) -> None:
        """Draw shapes, given by link, in a layer; they replace the layer's previous shapes."""
        self.remove_layer(layer)
        self.layers[layer] = [
            [
                _add_mesh(
                    self,
                    f"{self.name}/{i}/{layer}{j}",
                    triangles(shape.geometry),
                    shape.T_link_shape,
                    layer,
                    _COLOURS.get(layer) or shape_colour(shape),
                )
                for j, shape in enumerate(link_shapes)
            ]
            for i, link_shapes in enumerate(shapes)
        ]

    def show_inertia(self) -> None:
        """Draw for every link the solid ellipsoid that has its mass and inertia."""
        self.remove_layer("inertia")
        shapes = self.layers["inertia"] = []
        for i, link in enumerate(self.robot.links):
            ellipsoid = inertia_ellipsoid(link.inertial) if link.inertial else None
            shapes.append([])
            if link.inertial is None or ellipsoid is None:
                continue
            semi_axes, axes = ellipsoid
            T_link_ellipsoid = np.eye(4)
            T_link_ellipsoid[:3, :3], T_link_ellipsoid[:3, 3] = axes, link.inertial.com
            ball = trimesh.creation.icosphere(subdivisions=3)
            surface = _triangles(ball.vertices * semi_axes, ball.faces)
            name, pose = f"{self.name}/{i}/inertia", Pose.from_matrix(T_link_ellipsoid)
            shapes[i].append(_add_mesh(self, name, surface, pose, "inertia", _COLOURS["inertia"]))

    def remove_layer(self, layer: Layer) -> None:
        """Remove a layer's shapes."""
        for shape in self._shapes(layer):
            shape.handle.remove()
        self.layers.pop(layer, None)

    def set_visible(self, layer: Layer, visible: bool) -> None:
        """Show or hide a layer that was drawn."""
        for shape in self._shapes(layer):
            shape.handle.visible = visible

    def set_opacity(self, opacity: float) -> None:
        """Set the opacity of the visual shapes, from 0 (invisible) to 1."""
        for shape in self._shapes("visual"):
            shape.handle.opacity = None if opacity >= 1 else opacity

    def paint_red(self, names: Collection[str]) -> None:
        """Paint the named links red, and the other links in their own colours."""
        if (names := frozenset(names)) == self.red:
            return
        for layer in ("visual", "collision"):
            for link, shapes in zip(self.robot.links, self.layers.get(layer, []), strict=False):
                if (link.name in names) != (link.name in self.red):
                    for shape in shapes:
                        shape.handle.color = RED if link.name in names else shape.colour
        self.red = names

    def paint(self, layer: Layer, colours: Mapping[str, Rgb]) -> None:
        """Set the colours of a layer's shapes, by link."""
        for link, shapes in zip(self.robot.links, self.layers.get(layer, []), strict=False):
            for shape in shapes if link.name in colours else ():
                shape.handle.color = shape.colour = colours[link.name]

    def show_axes(self, visible: bool) -> None:
        """Show or hide the frame of every link."""
        for handle in self.links:
            handle.show_axes = visible

    def _shapes(self, layer: Layer) -> list[DrawnShape]:
        return [shape for shapes in self.layers.get(layer, []) for shape in shapes]


def add_robot(
    scene: viser.SceneApi,
    robot: Robot,
    name: str,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> RobotView:
    """Draw a robot's visual shapes at its home configuration.

    Args:
        scene: Scene of a browser or of a server.
        robot: The robot.
        name: Name of its node in the scene, such as ``/robot``.
        position: Position of its root [m].

    Raises:
        MeshError: If a mesh cannot be read.
    """
    base = scene.add_frame(name, show_axes=False, position=position)
    length = 0.12 * robot_extent(robot)
    links = [
        scene.add_frame(
            f"{name}/{i}",
            show_axes=False,
            axes_length=length,
            axes_radius=0.04 * length,
            origin_radius=0.08 * length,
        )
        for i in range(len(robot.links))
    ]
    view = RobotView(scene, robot, name, base, links)
    view.set_configuration(robot.home)
    view.show_shapes("visual", [link.visuals or link.collisions for link in robot.links])
    return view


def robot_bounds(robot: Robot, q: ArrayLike | None = None) -> tuple[Array, Array]:
    """Return the lowest and highest corner of a robot in its root frame [m].

    Args:
        robot: The robot; the origin of its root counts too.
        q: Configuration, shape (dof,); the home configuration by default.
    """
    T_root_link = forward_kinematics(robot, robot.home if q is None else q)
    points = [np.zeros((1, 3))]
    for T, link in zip(T_root_link, robot.links, strict=True):
        if shapes := link.visuals or link.collisions:
            low, high = bounding_box(shapes)
            corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T
            points.append(corners @ T[:3, :3].T + T[:3, 3])
    stacked = np.concatenate(points)
    return stacked.min(axis=0), stacked.max(axis=0)


def robot_extent(robot: Robot) -> float:
    """Return the longest side of a robot's bounding box at home, at least 5 cm [m]."""
    low, high = robot_bounds(robot)
    return max(float((high - low).max()), _MIN_EXTENT)


def inertia_ellipsoid(inertial: Inertial) -> tuple[Array, Array] | None:
    """Return the solid ellipsoid with a link's mass and inertia.

    An ellipsoid with semi-axes a, b, c has I_a = m (b^2 + c^2) / 5, and likewise I_b and I_c; the
    sum of all three gives a^2 = 5 / (2 m) (I_a + I_b + I_c - 2 I_a).

    Returns:
        Semi-axes (3,) [m], and their directions in the link frame as columns (3, 3). None for
        a massless link, or if no rigid body has such an inertia.
    """
    if inertial.mass <= 0:
        return None
    moments, axes = np.linalg.eigh(inertial.matrix)
    squares = 2.5 / inertial.mass * (moments.sum() - 2 * moments)
    if (squares < -1e-9).any() or not (squares > 0).any():
        return None
    if np.linalg.det(axes) < 0:  # a reflection is not a rotation
        axes[:, 0] *= -1
    return np.sqrt(np.maximum(squares, 1e-8)), axes


def shape_colour(shape: Shape) -> Rgb:
    """Return the colour of a shape, grey if it has none."""
    if shape.rgba is None:
        return GREY
    red, green, blue = (round(255 * channel) for channel in shape.rgba[:3])
    return (red, green, blue)


def batch_colours(colours: ArrayLike) -> NDArray[np.uint8]:
    """Return colours (n, 3) for batched meshes, which viser takes as linear, not as sRGB.

    The transfer function is that of IEC 61966-2-1.
    """
    share = np.asarray(colours, dtype=np.float64) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(255 * linear), dtype=np.uint8)


def triangles(geometry: Geometry) -> Triangles:
    """Return the surface of a geometry in its own frame.

    Vertices at sharp edges are doubled, so that the browser shades them as edges.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    if isinstance(geometry, Mesh):
        return _mesh_triangles(geometry, load_mesh(geometry))
    return _primitive_triangles(geometry)


@lru_cache(maxsize=512)
def _mesh_triangles(mesh: Mesh, loaded: trimesh.Trimesh) -> Triangles:
    """Cached by the loaded mesh, too, which is another object once the file has changed."""
    del mesh
    if len(loaded.faces) <= _MAX_SMOOTHED_FACES:
        loaded = trimesh.graph.smooth_shade(loaded, angle=SHARP_ANGLE)
    return _triangles(loaded.vertices, loaded.faces)


@lru_cache(maxsize=1024)
def _primitive_triangles(geometry: Box | Sphere | Cylinder | Capsule) -> Triangles:
    """Return the surface of a primitive; cached by its kind and size."""
    match geometry:
        case Box(size):
            mesh = trimesh.creation.box(size)
        case Sphere(radius):
            mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
        case Cylinder(radius, length):
            mesh = trimesh.creation.cylinder(
                radius=radius, height=length, sections=_CYLINDER_SECTIONS
            )
        case Capsule(radius, length):
            mesh = trimesh.creation.capsule(radius=radius, height=length)
            mesh.apply_translation(-mesh.bounds.mean(axis=0))  # trimesh's starts at the origin
    if isinstance(geometry, Box | Cylinder):
        mesh = trimesh.graph.smooth_shade(mesh, angle=SHARP_ANGLE)
    return _triangles(mesh.vertices, mesh.faces)


def _triangles(vertices: NDArray[np.float64], faces: NDArray[np.int64]) -> Triangles:
    return np.asarray(vertices, dtype=np.float32), np.asarray(faces, dtype=np.uint32)


def _add_mesh(
    view: RobotView, name: str, surface: Triangles, pose: Pose, layer: Layer, colour: Rgb
) -> DrawnShape:
    """Add a mesh to a robot's node, in the opacity of its layer."""
    opacity = _OPACITY.get(layer)
    handle = view.scene.add_mesh_simple(
        name,
        *surface,
        color=colour,
        opacity=opacity,
        side="double",  # some meshes have their faces inside out
        position=pose.position,
        wxyz=pose.quaternion,
        cast_shadow=opacity is None,
    )
    return DrawnShape(handle, colour)

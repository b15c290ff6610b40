"""A robot in viser's scene: its links in several layers, and drawings over it."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

import numpy as np
import trimesh
import viser
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from morphgen.model.geometry import Box, Pose, Shape
from morphgen.model.inertia import robot_corners
from morphgen.model.kinematics import forward_kinematics, frame_positions, random_configurations
from morphgen.model.robot import Link, Robot
from morphgen.model.rotation import Vec3
from morphgen.typing import Array
from morphgen.viewer.scene.stage import (
    MIN_EXTENT,
    Rgb,
    Triangles,
    grown_triangles,
    inertia_box,
    shape_colour,
    triangles,
)

Layer = Literal["visual", "collision", "primitives", "inertia"]
LAYERS: tuple[Layer, ...] = get_args(Layer)

RED: Rgb = (224, 49, 49)  # colour of colliding links
_COLOURS: Mapping[Layer, Rgb] = {
    "collision": (64, 192, 87),
    "primitives": (253, 126, 20),
    "inertia": (151, 117, 250),
}
_OPACITY: Mapping[Layer, float] = {"collision": 0.45, "primitives": 0.6, "inertia": 0.5}


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
    name: str  # name of the robot's node in the scene, such as `/robot`
    base: viser.FrameHandle
    links: list[viser.FrameHandle]  # frames of the links, in the order of `robot.links`
    layers: dict[Layer, list[list[DrawnShape]]] = field(default_factory=dict)
    """Shapes by link of the layers drawn so far."""
    overlays: dict[str, list[Any]] = field(default_factory=dict)
    """Nodes of the drawings over the robot by their names, such as `joint axes`."""
    red: frozenset[str] = frozenset()  # names of the links that are painted red
    T_root_link: Array = field(default_factory=lambda: np.zeros((0, 4, 4)))
    """Current pose of every link in the root frame, shape (n_links, 4, 4)."""

    def set_configuration(self, q: ArrayLike) -> None:
        """Move the robot to independent joint positions, shape (dof,) [rad or m]."""
        before, self.T_root_link = self.T_root_link, forward_kinematics(self.robot, q)
        for i, (handle, T) in enumerate(zip(self.links, self.T_root_link, strict=True)):
            if i < len(before) and np.array_equal(before[i], T):
                continue  # each message to a browser takes time
            pose = Pose.from_matrix(T)
            handle.position, handle.wxyz = pose.position, pose.quaternion

    def show_shapes(
        self, layer: Layer, shapes: Sequence[Sequence[Shape]], growth: float = 0.0
    ) -> None:
        """Draw shapes by link in place of a layer's, grown [m] so that none coincide."""
        self.remove_layer(layer)
        self.layers[layer] = [
            [
                _add_mesh(
                    self,
                    f"{self.name}/{i}/{layer}{j}",
                    grown_triangles(shape.geometry, growth)
                    if growth
                    else triangles(shape.geometry),
                    shape.T_link_shape,
                    layer,
                    _COLOURS.get(layer) or shape_colour(shape),
                )
                for j, shape in enumerate(link_shapes)
            ]
            for i, link_shapes in enumerate(shapes)
        ]

    def show_inertia(self) -> None:
        """Draw for every link the solid box that has its mass and inertia."""
        self.remove_layer("inertia")
        shapes = self.layers["inertia"] = []
        for i, link in enumerate(self.robot.links):
            box = inertia_box(link.inertial) if link.inertial else None
            shapes.append([])
            if link.inertial is None or box is None:
                continue
            sides, axes = box
            T_link_box = np.eye(4)
            T_link_box[:3, :3], T_link_box[:3, 3] = axes, link.inertial.com
            x, y, z = sides.tolist()
            surface, pose = triangles(Box((x, y, z))), Pose.from_matrix(T_link_box)
            name = f"{self.name}/{i}/inertia"
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

    def cast_no_shadow(self) -> None:
        """Let the visual shapes cast no shadow."""
        for shape in self._shapes("visual"):
            shape.handle.cast_shadow = False

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
    """Draw a robot's visual shapes at its home configuration, its root at a position [m]."""
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
    """Return the lowest and highest corner of a robot in its root frame, by default at home [m]."""
    corners = robot_corners(robot, robot.home if q is None else q)
    points = np.concatenate([np.zeros((1, 3)), corners])
    return points.min(axis=0), points.max(axis=0)


def robot_extent(robot: Robot) -> float:
    """Return the longest side of a robot's bounding box at home, at least 5 cm [m]."""
    low, high = robot_bounds(robot)
    return max(float((high - low).max()), MIN_EXTENT)


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


_ORANGE, _BLUE = (247, 103, 7), (25, 113, 194)
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

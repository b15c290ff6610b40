"""The stage on which robots stand: light, background, ground and camera."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Literal

import numpy as np
import trimesh
import viser
from numpy.typing import ArrayLike, NDArray

from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Shape, Sphere
from morphgen.model.inertia import box_corners, fit_camera, solid_mesh
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Inertial
from morphgen.model.rotation import to_matrix
from morphgen.typing import Array
from morphgen.viewer.app.viser_internals import remove_camera_callbacks

Rgb = tuple[int, int, int]
Triangles = tuple[NDArray[np.float32], NDArray[np.uint32]]  # vertices (n, 3) [m] and faces (m, 3)

GREY: Rgb = (176, 182, 190)  # colour of shapes without their own
SHARP_ANGLE = np.radians(35.0)  # larger angles are drawn as edges; tuned by eye on real arms
_MAX_SMOOTHED_FACES = 150_000  # to find the edges of larger meshes would take seconds


def shape_colour(shape: Shape) -> Rgb:
    """Return the colour of a shape, grey if it has none."""
    if shape.rgba is None:
        return GREY
    red, green, blue = (round(255 * channel) for channel in shape.rgba[:3])
    return (red, green, blue)


def batch_colours(colours: ArrayLike) -> NDArray[np.uint8]:
    """Return colours (n, 3) for batched meshes, which viser takes as linear, not as sRGB."""
    # The transfer function is that of IEC 61966-2-1.
    share = np.asarray(colours, dtype=np.float64) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(np.round(255 * linear), dtype=np.uint8)


def triangles(geometry: Geometry) -> Triangles:
    """Return the surface of a geometry, with double vertices at edges that are to look sharp."""
    if isinstance(geometry, Mesh):
        return _mesh_triangles(geometry, load_mesh(geometry))
    return _primitive_triangles(geometry)


def grown_triangles(geometry: Geometry, thickness: float) -> Triangles:
    """Return the surface of a geometry, moved outwards by a thickness [m]; its edges are closed."""
    mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
    mesh = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    if mesh.volume < 0:  # its faces are inside out
        mesh.invert()
    mesh.vertices = mesh.vertices + thickness * mesh.vertex_normals
    return mesh_arrays(mesh)


def inertia_box(inertial: Inertial) -> tuple[Array, Array] | None:
    """Return the sides (3,) [m] of the solid box with a link's mass and inertia, and its axes.

    They are columns in the link frame. None if no rigid body has such an inertia.
    """
    if inertial.mass <= 0:
        return None
    # A box with sides a, b, c has I_a = m (b^2 + c^2) / 12, and likewise I_b and I_c; the sum of
    # all three gives a^2 = 6 / m (I_a + I_b + I_c - 2 I_a).
    moments, axes = np.linalg.eigh(inertial.matrix)
    squares = 6 / inertial.mass * (moments.sum() - 2 * moments)
    if (squares < -1e-9).any() or not (squares > 0).any():
        return None
    if np.linalg.det(axes) < 0:  # a reflection is not a rotation
        axes[:, 0] *= -1
    return np.sqrt(np.maximum(squares, 1e-8)), axes


@lru_cache(maxsize=512)
def _mesh_triangles(mesh: Mesh, loaded: trimesh.Trimesh) -> Triangles:
    """Cached by the loaded mesh, too, which is another object once the file has changed."""
    del mesh
    if len(loaded.faces) <= _MAX_SMOOTHED_FACES:
        loaded = trimesh.graph.smooth_shade(loaded, angle=SHARP_ANGLE)
    return mesh_arrays(loaded)


@lru_cache(maxsize=1024)
def _primitive_triangles(geometry: Box | Sphere | Cylinder | Capsule) -> Triangles:
    """Return the surface of a primitive; cached by its kind and size."""
    mesh = solid_mesh(geometry)
    if isinstance(geometry, Box | Cylinder):
        mesh = trimesh.graph.smooth_shade(mesh, angle=SHARP_ANGLE)
    return mesh_arrays(mesh)


def mesh_arrays(mesh: trimesh.Trimesh) -> Triangles:
    """Return the vertices and faces of a mesh in the types that viser sends."""
    return np.asarray(mesh.vertices, dtype=np.float32), np.asarray(mesh.faces, dtype=np.uint32)


BRAND: Rgb = (24, 100, 171)  # colour of links, buttons and sliders
CAMERA_DIRECTION = (0.72, -0.60, 0.34)  # to the camera, that of the thumbnails
MIN_EXTENT = 0.05  # smallest extent by which axes and markers are drawn [m]
_BACKGROUNDS: dict[bool, tuple[Rgb, Rgb]] = {
    False: ((246, 248, 250), (206, 212, 219)),
    True: ((52, 57, 64), (24, 26, 30)),
}
"""Colours at the top and bottom of the background, for light and dark pages. The light one is grey
enough for white robots."""
_GRADIENT_ROWS = 128
_LIGHT: Literal["studio"] = "studio"  # environment map of viser: soft boxes in a grey room
_LIGHT_INTENSITY, _KEY_INTENSITY = 0.35, 0.75
"""Factor on the environment map, and intensity of the light that casts shadows; tuned by eye, so
that white robots keep their edges."""
_KEY_POSITION = (0.9, -1.0, 2.4)  # the light with shadows is above the camera's shoulder
_GRID: Rgb = (150, 157, 166)  # visible on light and on dark backgrounds
_SHADOW_OPACITY = 0.3
_FADE = 5.0  # distance at which the ground has faded, in sizes of what stands on it
_FOV = math.radians(35.0)  # vertical field of view [rad], that of the thumbnails
_MARGIN = 0.92  # share of the picture that what the camera looks at may fill
_MAX_ASPECT = 1.2  # largest aspect of the picture that is used: panels may still open beside it
_STRIP_ASPECT, _PAGE_ASPECT = 0.3, 1.0
"""Aspect below which the picture is still the strip beside the panel of a gallery that the browser
is leaving, and the aspect that is used instead."""


def set_stage(scene: viser.SceneApi, *, dark: bool) -> None:
    """Set the light and the background."""
    scene.configure_environment_map(_LIGHT, environment_intensity=_LIGHT_INTENSITY)
    scene.configure_default_lights(enabled=False)
    scene.add_light_directional(
        "/light", intensity=_KEY_INTENSITY, cast_shadow=True, position=_KEY_POSITION
    )
    top, bottom = np.array(_BACKGROUNDS[dark], dtype=np.float64)
    share = np.linspace(0, 1, _GRADIENT_ROWS)[:, None, None]
    image = (1 - share) * top + share * bottom
    scene.set_background_image(np.repeat(image, 2, axis=1).astype(np.uint8), format="png")


def background_colour(*, dark: bool) -> Rgb:
    """Return the colour behind the middle of the scene."""
    top, bottom = _BACKGROUNDS[dark]
    red, green, blue = ((a + b) // 2 for a, b in zip(top, bottom, strict=True))
    return (red, green, blue)


def add_ground(scene: viser.SceneApi, size: float, height: float = 0.0) -> None:
    """Draw an endless grid at a height [m]; its cells have 10 cm, or 1 m under large things."""
    cell = 0.1 if size < 8 else 1.0
    scene.add_grid(
        "/ground",
        cell_size=cell,
        section_size=10 * cell,
        cell_color=_GRID,
        section_color=_GRID,
        cell_thickness=0.6,
        section_thickness=1.1,
        infinite_grid=True,
        fade_distance=_FADE * max(size, 1.0),
        fade_strength=2.0,
        shadow_opacity=_SHADOW_OPACITY,
        position=(0.0, 0.0, height),
    )


def look_at(
    client: viser.ClientHandle,
    low: Array,
    high: Array,
    direction: tuple[float, float, float] = CAMERA_DIRECTION,
) -> None:
    """Point a browser's camera at a box, from a direction and so near that it just is in view.

    It is placed again when panels open, unless the user has moved it.
    """
    placement = _Placement(low, high, direction)
    placement.place(client.camera)
    remove_camera_callbacks(client.camera, _Placement)
    client.camera.on_update(placement)


@dataclass(eq=False)
class _Placement:
    """Callback of a camera that points it at a box again when the aspect of the scene changes."""

    low: Array  # lower corner of the box, shape (3,) [m]
    high: Array  # upper corner of the box, shape (3,) [m]
    direction: tuple[float, float, float]  # direction from the box to the camera
    aspect: float = 0.0  # aspect for which the camera was placed last
    position: Array = field(default_factory=lambda: np.zeros(3))
    """Position of the camera when it was placed last, shape (3,) [m]."""

    def place(self, camera: viser.CameraHandle) -> None:
        """Point a camera at the box."""
        self.aspect = _used_aspect(camera)
        place_camera(camera, self.low, self.high, self.direction, self.aspect)
        self.position = camera.position

    def __call__(self, camera: viser.CameraHandle) -> None:
        """Place a camera again for another aspect, unless the user has moved it."""
        has_moved = not np.allclose(camera.position, self.position, atol=1e-3)
        if _used_aspect(camera) != self.aspect and not has_moved:
            self.place(camera)


def _used_aspect(camera: viser.CameraHandle) -> float:
    return min(camera.aspect, _MAX_ASPECT) if camera.aspect > _STRIP_ASPECT else _PAGE_ASPECT


def place_camera(
    camera: viser.CameraHandle | viser.InitialCameraConfig,
    low: Array,
    high: Array,
    direction: tuple[float, float, float] = CAMERA_DIRECTION,
    aspect: float = _MAX_ASPECT,
) -> None:
    """Point a camera at a box with corners (3,) [m]; see ``look_at``."""
    forward = -np.array(direction) / np.linalg.norm(direction)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(right, forward), forward])
    corners = box_corners(low, high) @ axes.T
    tangent = _MARGIN * math.tan(_FOV / 2)
    offset = fit_camera(corners, np.array([tangent * aspect, tangent]))
    distance = max(float(corners[:, 2].mean() - offset[2]), 0.15)
    position = offset @ axes
    camera.fov = _FOV
    camera.position, camera.look_at = position, position + distance * forward
    camera.near = min(0.01, distance / 50)


_NEAR = 1e-3  # smallest distance from the camera by which points are divided [m]


def project_points(camera: viser.CameraHandle, points: Array) -> tuple[Array, Array]:
    """Return where points (..., 3) are in a browser's picture, and depths [m], < 0 behind.

    Places (..., 2) are shares of its width and height, from the upper left corner.
    """
    w, x, y, z = camera.wxyz.tolist()
    local = (points - camera.position) @ np.array(to_matrix((w, x, y, z)))
    depth = local[..., 2]
    safe = np.where(np.abs(depth) < _NEAR, _NEAR, depth)
    sides = 2 * np.tan(camera.fov / 2) * np.array([camera.aspect, 1.0])
    return local[..., :2] / safe[..., None] / sides + 0.5, depth

"""A scene as a MuJoCo model for rendering, never simulated: visuals, ground and markers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from morphgen.formats.bundle import split_colours
from morphgen.formats.mjcf.write import to_spec
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.task import Marker
from morphgen.typing import Array

Colour = tuple[float, float, float, float]

BLOCK = "block"
"""Name of the block among the mocap bodies."""
_BLOCK, _OBSTACLE = (0.90, 0.55, 0.15, 1.0), (0.55, 0.25, 0.25, 1.0)
_FRAME_MARKER, _BOX_MARKER = (0.10, 0.65, 0.25, 0.45), (0.10, 0.65, 0.25, 0.9)
_AXES = ((0.85, 0.15, 0.15, 1.0), (0.15, 0.70, 0.15, 1.0), (0.15, 0.30, 0.90, 1.0))
_GREY = (0.65, 0.67, 0.70, 1.0)
_GROUND_SPACING = 2.0
"""Distance between the ground's vertices [m]. Without a GPU, a frame takes 15 ms longer with 0.1 m,
and no pixel changes by more than 1%."""
_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))
"""Corners of a cube of edge 1."""


@dataclass(frozen=True, eq=False)
class RenderModel:
    """A MuJoCo model for rendering, and indices into its state."""

    model: mujoco.MjModel
    q_at: NDArray[np.int64]
    """Indices of the robot's movable joints in ``qpos``."""
    mocap: dict[str, int]
    """Mocap indices of the markers and, if there is one, of ``block``."""
    obstacles: list[int]
    """Mocap indices of the obstacles."""
    points: Array
    """Points that must be in view, shape (n, 3) [m]."""


def render_model(
    scene: Scene, markers: Sequence[Marker], configurations: Array, points: Array
) -> RenderModel:
    """Compile a scene whose robot stands at the origin for rendering.

    markers: Shapes that show a goal.
    configurations: Joint positions at which the robot must be in view, shape (n, dof).
    points: Further points that must be in view, shape (m, 3) [m].
    """
    robot = scene.robot
    points = np.concatenate(
        [
            np.zeros((1, 3)),
            box_corners(scene.obstacles),
            points,
            _robot_corners(robot, configurations),
        ]
    )
    if scene.ground is not None:
        points = points[points[:, 2] >= scene.ground - 1e-6]
    spec = to_spec(_visible(robot))
    _add_surroundings(spec, scene, float(np.ptp(points, axis=0).max()))
    obstacles = []
    for obstacle in scene.obstacles:
        obstacles.append(spec.worldbody.add_body(mocap=True))
        obstacles[-1].pos, obstacles[-1].quat = obstacle.pose.position, obstacle.pose.quaternion
        _add_box(obstacles[-1], obstacle.size, _OBSTACLE)
    bodies = {}
    if scene.block is not None:
        bodies[BLOCK] = spec.worldbody.add_body(mocap=True)
        _add_box(bodies[BLOCK], scene.block.size, _BLOCK)
    for marker in markers:
        bodies[marker.name] = _add_marker(spec, marker)
    model = spec.compile()
    at = [int(model.joint(robot.joints[k].name).qposadr[0]) for k in robot.movable_joints]
    mocap = {name: int(model.body_mocapid[body.id]) for name, body in bodies.items()}
    obstacle_rows = [int(model.body_mocapid[body.id]) for body in obstacles]
    return RenderModel(model, np.array(at, dtype=np.int64), mocap, obstacle_rows, points)


def box_corners(boxes: Sequence[Block]) -> Array:
    """Return the corners of boxes in the world, shape (8 boxes, 3) [m]."""
    corners = [np.zeros((0, 3))]
    for box in boxes:
        T = box.pose.matrix
        corners.append(_SIGNS * box.size @ T[:3, :3].T + T[:3, 3])
    return np.concatenate(corners)


def _visible(robot: Robot) -> Robot:
    """Return the robot with visuals only: grey without colour, collision shapes without visuals."""
    coloured = split_colours(robot)
    links = []
    for link in coloured.links:
        shapes = link.visuals or link.collisions
        visuals = tuple(replace(shape, rgba=shape.rgba or _GREY) for shape in shapes)
        links.append(replace(link, visuals=visuals, collisions=()))
    return replace(coloured, links=tuple(links), ignore_pairs=())


def _add_surroundings(spec: mujoco.MjSpec, scene: Scene, extent: float) -> None:
    """Add sky, light and ground."""
    spec.add_texture(
        name="morphgen/sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.75, 0.80, 0.86],
        width=64,
        height=384,
    )
    spec.worldbody.add_light(
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        pos=[extent, -extent, 3 * extent],
        dir=[-0.4, 0.3, -1.0],
        diffuse=[0.5, 0.5, 0.5],
        specular=[0.1, 0.1, 0.1],
        castshadow=True,
    )
    if scene.ground is not None:
        _add_ground(spec, scene.ground)


def _add_ground(spec: mujoco.MjSpec, height: float) -> None:
    """Add a plane with squares of 0.1 m in groups of five."""
    spec.add_texture(
        name="morphgen/squares",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.86, 0.87, 0.88],
        rgb2=[0.82, 0.83, 0.85],
        markrgb=[0.70, 0.71, 0.73],
        width=256,
        height=256,
    )
    material = spec.add_material(name="morphgen/ground", texrepeat=[4, 4], texuniform=True)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "morphgen/squares"
    spec.worldbody.add_geom(
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[20, 20, _GROUND_SPACING],
        pos=[0.0, 0.0, height],
        material="morphgen/ground",
    )


def _add_box(body: mujoco.MjsBody, edges: Vec3, rgba: Colour) -> mujoco.MjsGeom:
    size = [edge / 2 for edge in edges]
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=rgba)


def _add_marker(spec: mujoco.MjSpec, marker: Marker) -> mujoco.MjsBody:
    """Add a box, or axes inside a translucent ball."""
    body = spec.worldbody.add_body(mocap=True)
    if marker.shape == "box":
        _add_box(body, marker.size, _BOX_MARKER)
        return body
    radius = marker.size[0] / 2
    for axis, rgba in zip(np.eye(3) * 2 * radius, _AXES, strict=True):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, *axis],
            size=[0.1 * radius, 0, 0],
            rgba=rgba,
        )
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0], rgba=_FRAME_MARKER)
    return body


def _robot_corners(robot: Robot, q: Array) -> Array:
    """Return corners of the links' bounding boxes in configurations (n, dof), shape (m, 3)."""
    T_root_link = forward_kinematics(robot, q)
    points = [np.zeros((0, 3))]
    for i, link in enumerate(robot.links):
        if link.visuals or link.collisions:
            corners = np.array(list(product(*bounding_box(link.visuals or link.collisions).T)))
            T = T_root_link[:, i]
            at = corners @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
            points.append(at.reshape(-1, 3))
    return np.concatenate(points)

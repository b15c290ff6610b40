"""A setting as a MuJoCo model that is only looked at: visuals, ground, obstacles and marks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from morphgen.formats.bundle import split_colours
from morphgen.formats.mjcf import to_spec
from morphgen.model.inertia import bounding_box
from morphgen.model.kinematics import forward_kinematics
from morphgen.model.robot import Robot
from morphgen.tasks.config import ReachConfig
from morphgen.tasks.settings import Setting
from morphgen.tasks.sim.base import Block

Array = NDArray[np.float64]
Colour = tuple[float, float, float, float]

_STARTS = 32
"""Configurations of a set that are to be in view."""
_BLOCK, _OBSTACLE = (0.90, 0.55, 0.15, 1.0), (0.55, 0.25, 0.25, 1.0)
_GOAL, _LINE = (0.10, 0.65, 0.25, 0.45), (0.10, 0.65, 0.25, 0.9)
_AXES = ((0.85, 0.15, 0.15, 1.0), (0.15, 0.70, 0.15, 1.0), (0.15, 0.30, 0.90, 1.0))
_BODY = (0.65, 0.67, 0.70, 1.0)
_LINE_WIDTH, _LINE_HEIGHT = 0.012, 0.001
_SIGNS = np.array(list(product((-0.5, 0.5), repeat=3)))
"""Corners of a cube of edge 1."""


@dataclass(frozen=True, eq=False)
class StageModel:
    """What is drawn, and where its state is."""

    model: mujoco.MjModel
    q_at: NDArray[np.int64]
    """Where ``qpos`` has the robot's movable joints."""
    marks: dict[str, int]
    """Mocap bodies of ``block``, ``goal`` and ``line``."""
    points: Array
    """What is to be in view, shape (n, 3), metres."""


def stage_model(setting: Setting) -> StageModel:
    """Compile what is to be seen of a setting, whose robot stands at the origin.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    robot, points = setting.robot, _in_view(setting)
    spec = to_spec(_as_seen(robot))
    _add_surroundings(spec, setting, float(np.ptp(points, axis=0).max()))
    marks = {"block": _add_block, "goal": _add_goal, "line": _add_line}
    bodies = {name: add(spec, setting) for name, add in marks.items()}
    model = spec.compile()
    at = [int(model.joint(robot.joints[k].name).qposadr[0]) for k in robot.movable]
    found = {name: int(model.body_mocapid[body.id]) for name, body in bodies.items()}
    return StageModel(model, np.array(at, dtype=np.int64), found, points)


def _as_seen(robot: Robot) -> Robot:
    """The robot with nothing but what is to be drawn: visuals, or collision shapes without."""
    coloured = split_colours(robot)
    links = tuple(
        replace(link, visuals=link.visuals or link.collisions, collisions=())
        for link in coloured.links
    )
    grey = tuple(
        replace(
            link,
            visuals=tuple(replace(shape, rgba=shape.rgba or _BODY) for shape in link.visuals),
        )
        for link in links
    )
    return replace(coloured, links=grey, ignore_pairs=())


def _add_surroundings(spec: mujoco.MjSpec, setting: Setting, extent: float) -> None:
    """Sky, light, ground and obstacles."""
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
    if setting.scene.ground is not None:
        _add_ground(spec, setting.scene.ground)
    for obstacle in setting.scene.obstacles:
        geom = _add_box(spec.worldbody, obstacle, _OBSTACLE)
        geom.pos, geom.quat = obstacle.pose.position, obstacle.pose.quaternion


def _add_ground(spec: mujoco.MjSpec, height: float) -> None:
    """A plane with squares of 0.1 m in groups of five."""
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
        size=[20, 20, 0.1],
        pos=[0.0, 0.0, height],
        material="morphgen/ground",
    )


def _add_box(body: mujoco.MjsBody, block: Block, rgba: Colour) -> mujoco.MjsGeom:
    size = [edge / 2 for edge in block.size]
    return body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=rgba)


def _add_block(spec: mujoco.MjSpec, setting: Setting) -> mujoco.MjsBody:
    body = spec.worldbody.add_body(mocap=True)
    if setting.scene.block is not None:
        _add_box(body, setting.scene.block, _BLOCK)
    return body


def _add_goal(spec: mujoco.MjSpec, setting: Setting) -> mujoco.MjsBody:
    """A ball in which the tool is near, and axes of the wanted pose."""
    near = ReachConfig.near
    body = spec.worldbody.add_body(mocap=True)
    for axis, rgba in zip(np.eye(3) * 2 * near, _AXES, strict=True):
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, *axis],
            size=[0.1 * near, 0, 0],
            rgba=rgba,
        )
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[near, 0, 0], rgba=_GOAL)
    return body


def _add_line(spec: mujoco.MjSpec, setting: Setting) -> mujoco.MjsBody:
    """A strip on the ground, along x, as long as the starts of the block are spread and more."""
    body = spec.worldbody.add_body(mocap=True)
    if setting.pushes is not None:
        low, high = setting.pushes.blocks[:, 0].min(), setting.pushes.blocks[:, 0].max()
        spare = 2 * max(setting.pushes.block.size)
        size = [(high - low) / 2 + spare, _LINE_WIDTH / 2, _LINE_HEIGHT]
        strip = body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, rgba=_LINE)
        strip.pos = [(low + high) / 2, 0.0, 0.0]
    return body


def _in_view(setting: Setting) -> Array:
    """The robot at home and at starts, its goals, the block's ways and obstacles, shape (n, 3)."""
    robot, scene = setting.robot, setting.scene
    points = [np.zeros((1, 3)), *(_corners(block) for block in scene.obstacles)]
    configurations = [np.array([robot.home])]
    if setting.goals is not None:
        configurations.append(setting.goals.q[:_STARTS])
        points.append(setting.goals.poses[:, :3])
    if setting.pushes is not None:
        configurations.append(setting.pushes.q[:_STARTS])
        across = setting.pushes.blocks[:, :3].copy()
        across[:, 1] = setting.pushes.line
        corners = _SIGNS * setting.pushes.block.size
        for centres in (setting.pushes.blocks[:, :3], across):
            points.append((centres[:, None] + corners).reshape(-1, 3))
    points.append(_robot_corners(robot, np.concatenate(configurations)))
    found = np.concatenate(points)
    return found if scene.ground is None else found[found[:, 2] >= scene.ground - 1e-6]


def _robot_corners(robot: Robot, q: Array) -> Array:
    """Corners of the boxes around the links' shapes in configurations (n, dof), shape (m, 3)."""
    T_root_link = forward_kinematics(robot, q)
    found = [np.zeros((0, 3))]
    for i, link in enumerate(robot.links):
        if link.visuals or link.collisions:
            corners = np.array(list(product(*bounding_box(link.visuals or link.collisions).T)))
            T = T_root_link[:, i]
            at = corners @ T[:, :3, :3].transpose(0, 2, 1) + T[:, None, :3, 3]
            found.append(at.reshape(-1, 3))
    return np.concatenate(found)


def _corners(block: Block) -> Array:
    T = block.pose.matrix
    return np.asarray(_SIGNS * block.size @ T[:3, :3].T + T[:3, 3])

"""Draw a robot without a display or GPU, with MuJoCo."""

from __future__ import annotations

import math
from contextlib import suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np
from PIL import Image

from morphgen.errors import MissingDependencyError
from morphgen.formats.quiet import log_mujoco_warnings
from morphgen.model.geometry import Pose
from morphgen.model.inertia import robot_corners
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.typing import Array

SIZE = (640, 480)  # width and height of a picture [px]
_FOV = 35.0  # vertical field of view [deg]
_YAW, _PITCH = 50.0, -20.0  # direction of the camera [deg]
_CAMERA = Pose.from_xyz_rpy(rpy=(math.radians(_PITCH), 0.0, math.radians(_YAW)))
_MARGIN = 0.92  # share of the picture that the robot may fill


class GlContext(Protocol):
    """Interface of MuJoCo's OpenGL contexts."""

    def make_current(self) -> None:
        """Make this the context that OpenGL draws to."""

    def free(self) -> None:
        """Release the context."""


def render(robot: Robot, mjcf: Path, size: tuple[int, int] = SIZE) -> Image.Image:
    """Draw a robot at home with MuJoCo's renderer; size in pixels."""
    import mujoco

    log_mujoco_warnings()
    target, distance = _framing(robot, size[0] / size[1])
    model = mujoco.MjModel.from_xml_path(str(mjcf))
    mujoco.mj_clearCache(mujoco.mj_getCache())  # up to 500 MB of meshes by paths, mostly new ones
    data = mujoco.MjData(model)
    for k, position in zip(robot.movable_joints, movable_positions(robot, robot.home), strict=True):
        data.qpos[model.joint(robot.joints[k].name).qposadr[0]] = position
    mujoco.mj_forward(model, data)
    model.vis.global_.fovy = _FOV
    model.vis.global_.offwidth, model.vis.global_.offheight = size
    model.vis.headlight.ambient[:], model.vis.headlight.diffuse[:] = 0.4, 0.7
    camera = mujoco.MjvCamera()
    camera.lookat[:] = target
    # MuJoCo's azimuth of 90 looks along y, as the axes below do at a yaw of zero.
    camera.distance, camera.azimuth, camera.elevation = distance, 90 + _YAW, _PITCH
    options = mujoco.MjvOption()
    options.geomgroup[3] = 0  # the collision shapes
    context = gl_context(*size)
    try:
        context.make_current()
        scene = mujoco.MjvScene(model, maxgeom=10_000)
        gpu = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, gpu)
        mujoco.mjv_updateScene(
            model, data, options, None, camera, mujoco.mjtCatBit.mjCAT_ALL.value, scene
        )
        pixels = np.empty((size[1], size[0], 3), dtype=np.uint8)
        depth = np.empty((size[1], size[0]), dtype=np.float32)
        mujoco.mjr_render(mujoco.MjrRect(0, 0, *size), scene, gpu)
        mujoco.mjr_readPixels(pixels, depth, mujoco.MjrRect(0, 0, *size), gpu)
        gpu.free()
    finally:
        context.free()
    pixels[depth >= 1.0] = 255  # where nothing is drawn, the picture is white
    return Image.fromarray(pixels[::-1])  # OpenGL's rows begin at the bottom


def _framing(robot: Robot, aspect: float) -> tuple[Array, float]:
    """Return centre (3,) and distance [m] of the closest view of the whole robot and its origin."""
    axes = _CAMERA.matrix[:3, :3]
    points = np.concatenate([np.zeros((1, 3)), robot_corners(robot, robot.home)])
    across, ahead, up = (points @ axes).T
    middle = np.array([(v.min() + v.max()) / 2 for v in (across, ahead, up)])
    tangent = _MARGIN * math.tan(math.radians(_FOV / 2))
    distances = np.maximum(
        np.abs(across - middle[0]) / (tangent * aspect), np.abs(up - middle[2]) / tangent
    )
    distance = max(float((distances - (ahead - middle[1])).max()), 0.05)
    return axes @ middle, distance


def gl_context(width: int, height: int) -> GlContext:
    """Create an offscreen OpenGL context of MuJoCo by EGL or OSMesa."""
    # Triton, a part of PyTorch's CUDA build, and Mesa's software renderer contain LLVM. A process
    # that loads triton after Mesa crashes, such as one that draws and then loads a policy.
    if find_spec("triton") is not None:
        with suppress(ImportError):
            import_module("triton")
    reasons = []
    for backend in ("egl", "osmesa"):
        try:
            context: GlContext = import_module(f"mujoco.{backend}").GLContext(width, height)
        except (ImportError, AttributeError, RuntimeError, OSError) as error:
            reasons.append(f"{backend}: {error}")
        else:
            return context
    raise MissingDependencyError(
        "cannot draw: no offscreen OpenGL (on Debian and Ubuntu: apt-get install "
        "libegl1 libgl1-mesa-dri): " + "; ".join(reasons)
    )

"""Pictures of environments, rendered without display or GPU, and videos of them.

A scene becomes a MuJoCo model that is never simulated: visuals, ground and markers.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import imageio.v2 as imageio
import imageio_ffmpeg
import mujoco
import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from morphgen.errors import FormatError
from morphgen.files import replacing_file
from morphgen.formats.bundle import split_colours
from morphgen.formats.files import require_writable_file
from morphgen.formats.mjcf.write import to_spec
from morphgen.formats.picture import gl_context
from morphgen.model.geometry import Box, Pose, Shape
from morphgen.model.inertia import box_corners, fit_camera, robot_corners
from morphgen.model.kinematics import movable_positions
from morphgen.model.robot import Robot
from morphgen.model.rotation import Vec3
from morphgen.tasks.batch import TaskBatch
from morphgen.tasks.registry import TASKS
from morphgen.tasks.scenes.obstacles import place_boxes
from morphgen.tasks.sim.articulated import ArticulatedObject
from morphgen.tasks.sim.base import Block, Scene
from morphgen.tasks.sim.mujoco_model import add_shape
from morphgen.tasks.task import EnvSpec, Marker
from morphgen.typing import Array

BLOCK = "block"  # name of the block among the mocap bodies
_BLOCK, _OBSTACLE = (0.90, 0.55, 0.15, 1.0), (0.55, 0.25, 0.25, 1.0)
_FRAME_MARKER, _BOX_MARKER = (0.10, 0.65, 0.25, 0.45), (0.10, 0.65, 0.25, 0.9)
_AXES = ((0.85, 0.15, 0.15, 1.0), (0.15, 0.70, 0.15, 1.0), (0.15, 0.30, 0.90, 1.0))
_GREY = (0.65, 0.67, 0.70, 1.0)
_GROUND_SPACING = 2.0
"""Distance between the ground's vertices [m]. Without a GPU, a frame takes 15 ms longer with 0.1 m,
and no pixel changes by more than 1%."""


def _corners_in_world(boxes: Sequence[Block]) -> list[Array]:
    """Return the corners of boxes in the world, shape (8, 3) each [m]."""
    halves = (np.array(box.size) / 2 for box in boxes)
    return [
        box_corners(-half, half) @ box.pose.matrix[:3, :3].T + box.pose.position
        for box, half in zip(boxes, halves, strict=True)
    ]


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
    if scene.ground is None:
        return
    spec.add_texture(  # squares of 0.1 m in groups of five
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
        pos=[0.0, 0.0, scene.ground],
        material="morphgen/ground",
    )


def _add_marker(spec: mujoco.MjSpec, marker: Marker) -> mujoco.MjsBody:
    """Add a box, or axes inside a translucent ball."""
    body = spec.worldbody.add_body(mocap=True)
    if marker.shape == "box":
        add_shape(body, Shape(Box(marker.size))).rgba = _BOX_MARKER
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


Frame = NDArray[np.uint8]


def look_at(position: Vec3, target: Vec3) -> Pose:
    """Return the pose of a camera that looks along its -z at a target, with x about upwards."""
    back = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross((1.0, 0.0, 0.0), back)
    right /= np.linalg.norm(right)
    matrix = np.eye(4)
    matrix[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
    return Pose.from_matrix(matrix)


SIZE = (640, 480)  # width and height of a frame [pixels]
SUFFIXES = (".mp4", ".gif")  # suffixes of video files

Camera = Literal["front", "wrist"]
FRONT_FOV, WRIST_FOV = 35.0, 70.0  # vertical fields of view of the cameras [degrees]
WRIST = look_at((0.15, 0.0, -0.15), (0.0, 0.0, 0.05))
"""Pose of the camera ``wrist`` in the tool frame: beside and behind the tool, it looks at what is
before the tool, along its own -z; y is up."""
_AZIMUTH, _ELEVATION = 220.0, -25.0
"""MuJoCo camera angles [degrees]: from ahead and the left, so that no tool hides the block."""
_MARGIN = 0.92  # fraction of the picture that the points in view fill
_SHADOW_SIZE = 1536
"""Size of the shadow map [pixels]. Shadows show how high a tool is. Without a GPU they take two
thirds of the time; smoothed edges would take even longer, and are hardly visible in a video."""
_SHADOW_CLIP = 2.0
"""Half the width of the shadow map, as a multiple of the extent of the scene. With 1.5, dark dots
appear on the ground at the edge of some pictures of a turn."""
_AWAY = (0.0, 0.0, -1e4, 1.0, 0.0, 0.0, 0.0)  # pose of bodies that must not be visible
_NUM_STARTS = 32  # number of configurations of a goal set that must be in view


@dataclass(frozen=True, eq=False)
class RenderState:
    """State of an environment for a picture."""

    q: NDArray[np.float32]  # positions of the robot's independent joints, shape (dof,) [rad or m]
    block: NDArray[np.float32] | None = None
    """Pose of the block, (x, y, z, qw, qx, qy, qz), or None."""
    markers: Mapping[str, NDArray[np.float32]] = field(default_factory=dict)
    """Poses of the markers by name; markers without a pose are invisible."""
    obstacles: NDArray[np.float32] | None = None
    """Poses of the obstacles, shape (O, 7); None for those of the scene."""


class Renderer:
    """Renders a scene from a fixed camera.

    MuJoCo renders it with EGL or OSMesa, whichever simulator steps it. PyBullet's software renderer
    would need no system library, but cannot draw translucent shapes.
    """

    def __init__(
        self,
        scene: Scene,
        markers: Sequence[Marker],
        configurations: NDArray[np.float64],
        points: NDArray[np.float64],
        size: tuple[int, int] = SIZE,
    ) -> None:
        """Compile the scene and place the camera.

        The robot at the configurations (n, dof), and further points (m, 3) [m], must be in view.
        """
        self.size, self._robot = size, scene.robot
        self.points = np.concatenate(
            [
                np.zeros((1, 3)),
                *_corners_in_world(scene.obstacles),
                points,
                robot_corners(scene.robot, configurations).reshape(-1, 3),
            ]
        )
        if scene.ground is not None:
            self.points = self.points[self.points[:, 2] >= scene.ground - 1e-6]
        self._model = model = self._compiled(scene, markers)
        model.vis.global_.fovy = FRONT_FOV
        model.vis.global_.offwidth, model.vis.global_.offheight = size
        model.vis.quality.shadowsize, model.vis.quality.offsamples = _SHADOW_SIZE, 0
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        model.stat.center[:], model.stat.extent = (low + high) / 2, 1.5 * (high - low).max()
        model.vis.map.shadowclip = _SHADOW_CLIP
        light = model.vis.headlight
        light.ambient[:], light.diffuse[:], light.specular[:] = 0.35, 0.35, 0.1
        self._data = mujoco.MjData(model)
        self._camera = _camera(self.points, size[0] / size[1])
        self._view = (self._camera.lookat.copy(), model.light_pos.copy(), model.light_dir.copy())
        self._scene = mujoco.MjvScene(model, maxgeom=2 * model.ngeom + 100)
        self._scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = 0
        self._context = gl_context(*size)
        self._context.make_current()
        self._gpu = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100.value)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN.value, self._gpu)
        self._closed = False

    def _compiled(self, scene: Scene, markers: Sequence[Marker]) -> mujoco.MjModel:
        """Compile the scene; keep the indices of joints and of things that move."""
        spec = to_spec(_visible(scene.robot))
        _add_surroundings(spec, scene, float(np.ptp(self.points, axis=0).max()))
        obstacles = []
        for obstacle in scene.obstacles:
            obstacles.append(spec.worldbody.add_body(mocap=True))
            obstacles[-1].pos, obstacles[-1].quat = obstacle.pose.position, obstacle.pose.quaternion
            add_shape(obstacles[-1], Shape(Box(obstacle.size))).rgba = _OBSTACLE
        bodies = {}
        if scene.object is not None:
            bodies[BLOCK] = spec.worldbody.add_body(mocap=True)
            for shape in scene.object_shapes:
                add_shape(bodies[BLOCK], shape).rgba = shape.rgba or _BLOCK
        if isinstance(scene.object, ArticulatedObject):
            base = spec.worldbody.add_body()
            base.pos, base.quat = scene.object.pose.position, scene.object.pose.quaternion
            for shape in scene.object.base_shapes:
                add_shape(base, shape).rgba = shape.rgba or _OBSTACLE
        for marker in markers:
            bodies[marker.name] = _add_marker(spec, marker)
        if tool := scene.robot.tool:
            T_link_camera = Pose.from_matrix(tool.T_link_frame.matrix @ WRIST.matrix)
            spec.body(tool.link).add_camera(
                name="wrist",
                pos=T_link_camera.position,
                quat=T_link_camera.quaternion,
                fovy=WRIST_FOV,
            )
        model = spec.compile()
        self._wrist = mujoco.MjvCamera()
        self._wrist.type, self._wrist.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
        names = [scene.robot.joints[k].name for k in scene.robot.movable_joints]
        self._q_at = [int(model.joint(name).qposadr[0]) for name in names]
        self._mocap = {name: int(model.body_mocapid[body.id]) for name, body in bodies.items()}
        self._obstacles = [int(model.body_mocapid[body.id]) for body in obstacles]
        return model

    @classmethod
    def of_spec(cls, spec: EnvSpec, size: tuple[int, int] = SIZE) -> Renderer:
        """Return a renderer with a view of the robot at home and at starts, and of all goals."""
        task = TASKS[spec.task]
        configurations = np.concatenate([[spec.robot.home], spec.goals.q[:_NUM_STARTS]])
        markers = task.markers(spec.config, spec.goals)
        corners = [
            each
            for layout in (spec.goals.layouts if spec.scene.obstacles else ())
            for each in _corners_in_world(place_boxes(spec.scene.obstacles, layout))
        ]
        points = np.concatenate([task.points_in_view(spec.goals), *corners])
        return cls(spec.scene, markers, configurations, points, size)

    def frame(self, state: RenderState, turn: float = 0.0) -> Frame:
        """Render a state, shape (height, width, 3), with the scene turned by an angle [degrees].

        It is on a turntable in front of a fixed camera: camera and light go around its middle.
        """
        self._turn_view(turn)
        self._place(state)
        self._look(self._camera)
        return self._pixels()[0]

    def view(self, state: RenderState, camera: Camera = "front") -> tuple[Frame, Array]:
        """Render a state by a camera: pixels (height, width, 3), and depths (height, width) [m].

        ``front`` is the camera of ``frame``; ``wrist`` moves with the tool, see ``WRIST``.
        """
        self._turn_view(0.0)
        self._place(state)
        self._look(self._camera if camera == "front" else self._wrist)
        pixels, depth = self._pixels()
        extent, planes = self._model.stat.extent, self._model.vis.map
        near, far = planes.znear * extent, planes.zfar * extent
        return pixels, near / (1 - depth * (1 - near / far))  # OpenGL's depths are 0 to 1

    @property
    def front(self) -> Pose:
        """Pose of the camera ``front`` in the world; it looks along -z, and y is up."""
        self._look(self._camera)
        eyes = self._scene.camera[:2]
        up = eyes[0].up.astype(np.float64)
        back = -eyes[0].forward.astype(np.float64)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([np.cross(up, back), up, back], axis=1)
        matrix[:3, 3] = (eyes[0].pos + eyes[1].pos) / 2
        return Pose.from_matrix(matrix)

    def _place(self, state: RenderState) -> None:
        """Put everything where it is in a state."""
        model, data = self._model, self._data
        data.qpos[self._q_at] = movable_positions(self._robot, state.q)
        poses = dict(state.markers)
        if state.block is not None:
            poses[BLOCK] = state.block
        for name, index in self._mocap.items():
            pose = np.asarray(poses.get(name, _AWAY))
            data.mocap_pos[index], data.mocap_quat[index] = pose[:3], pose[3:]
        if state.obstacles is not None:
            for index, pose in zip(self._obstacles, state.obstacles, strict=True):
                data.mocap_pos[index], data.mocap_quat[index] = pose[:3], pose[3:]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_camlight(model, data)

    def _look(self, camera: mujoco.MjvCamera) -> None:
        """Fill the scene as a camera sees it."""
        everything = mujoco.mjtCatBit.mjCAT_ALL.value
        options = mujoco.MjvOption()
        data = self._data
        mujoco.mjv_updateScene(self._model, data, options, None, camera, everything, self._scene)

    def close(self) -> None:
        """Free the OpenGL context; a second call does nothing."""
        if not self._closed:
            self._closed = True
            self._context.make_current()
            self._gpu.free()
            self._context.free()

    def _turn_view(self, turn: float) -> None:
        """Turn camera and light around the vertical through the middle of the points in view."""
        model = self._model
        rotation, middle = Rotation.from_euler("Z", turn, degrees=True), model.stat.center
        look_at, light_position, light_direction = self._view
        self._camera.lookat[:] = middle + rotation.apply(look_at - middle)
        self._camera.azimuth = _AZIMUTH + turn
        model.light_pos[:] = middle + rotation.apply(light_position - middle)
        model.light_dir[:] = rotation.apply(light_direction)

    def _pixels(self) -> tuple[Frame, NDArray[np.float32]]:
        """Render the scene; return pixels and OpenGL's depths with the top row first."""
        width, height = self.size
        pixels = np.empty((height, width, 3), dtype=np.uint8)
        depth = np.empty((height, width), dtype=np.float32)
        rectangle = mujoco.MjrRect(0, 0, width, height)
        self._context.make_current()  # another renderer may have been drawing
        mujoco.mjr_render(rectangle, self._scene, self._gpu)
        mujoco.mjr_readPixels(pixels, depth, rectangle, self._gpu)
        return np.ascontiguousarray(pixels[::-1]), depth[::-1]  # OpenGL's first row is the lowest


def render_state(batch: TaskBatch, env: int = 0) -> RenderState:
    """Return the current state of an environment of a batch."""
    spec = batch.specs[int(batch.env_robot_index[env])]
    block = None if spec.scene.object is None else _copied(batch.simulation.object_pose[env])
    return RenderState(
        _copied(batch.q[env, : spec.robot.dof]),
        block,
        batch.groups.marker_poses(env),
        _copied(batch.layouts.poses[env, : len(spec.scene.obstacles)]),
    )


def _copied(values: torch.Tensor) -> NDArray[np.float32]:
    return np.array(values.cpu().numpy(), dtype=np.float32)


def require_video_path(path: Path) -> None:
    """Require that a video can be written to a path, before anything is rendered."""
    if path.suffix not in SUFFIXES:
        raise FormatError(f"{path}: the name of a video ends in {' or '.join(SUFFIXES)}")
    require_writable_file(path)


def write_video(frames: Iterable[Frame], path: Path, fps: float) -> None:
    """Write a video of one or more frames: H.264 in ``.mp4``, of even size, or an endless ``.gif``.

    The file appears when it is complete. The same frames give the same bytes.
    """
    require_video_path(path)
    written = 0
    try:
        with replacing_file(path) as partial:
            # In memory, a GIF's writer cannot fail again when Python deletes it.
            image = io.BytesIO() if path.suffix == ".gif" else None
            writer: Any = imageio.get_writer(image or partial, **_writer_options(path.suffix, fps))
            with writer:
                for frame in frames:
                    writer.append_data(frame)
                    written += 1
            if image:
                partial.write_bytes(image.getvalue())
            else:
                require_complete(partial, written, path)
    except OSError as error:  # without a text it is imageio's: the pipe to ffmpeg was closed
        reason = (
            error.strerror or "ffmpeg ended early; has it libx264, and is there room on the disk?"
        )
        raise FormatError(f"cannot write {path}: {reason}") from error


def require_complete(video: Path, frames: int, path: Path) -> None:
    """Require that a video has all frames: imageio does not report ffmpeg's exit code."""
    hint = "is the disk full, or was ffmpeg ended?"
    try:
        count, _ = imageio_ffmpeg.count_frames_and_secs(str(video))
    except RuntimeError as error:
        raise FormatError(
            f"cannot write {path}: ffmpeg left a video that cannot be read; {hint}"
        ) from error
    if count != frames:
        raise FormatError(f"cannot write {path}: ffmpeg wrote {count} of {frames} frames; {hint}")


def _writer_options(suffix: str, fps: float) -> dict[str, Any]:
    """Return the arguments of ``imageio.get_writer`` for a GIF or an MP4."""
    if suffix == ".gif":
        return {"format": "GIF", "mode": "I", "duration": 1000 / fps, "loop": 0}
    return {
        "format": "FFMPEG",
        "mode": "I",
        "fps": fps,
        "codec": "libx264",
        "quality": 8,
        "ffmpeg_log_level": "quiet",
        "macro_block_size": 2,  # imageio's default of 16 would scale 640 x 360
        # Without the version of ffmpeg in the file: the same frames give the same bytes.
        "output_params": ["-fflags", "+bitexact", "-flags:v", "+bitexact"],
    }


def _camera(points: NDArray[np.float64], aspect: float) -> mujoco.MjvCamera:
    """Return the nearest camera in the fixed direction that sees all points, shape (n, 3)."""
    rotation = Rotation.from_euler("ZX", [_AZIMUTH - 90, _ELEVATION], degrees=True)
    axes = rotation.as_matrix()[:, [0, 2, 1]]  # right, up and forward
    local = points @ axes
    half = _MARGIN * math.tan(math.radians(FRONT_FOV / 2))
    across, up, ahead = fit_camera(local, np.array([half * aspect, half]))
    middle = (local[:, 2].min() + local[:, 2].max()) / 2
    camera = mujoco.MjvCamera()
    camera.lookat[:] = axes @ (across, up, middle)
    camera.distance = middle - ahead
    camera.azimuth, camera.elevation = _AZIMUTH, _ELEVATION
    return camera

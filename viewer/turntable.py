"""Videos in which a robot turns once. Runs in worker processes."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from morphgen.model.robot import Robot
from morphgen.tasks.renderer import Frame, Renderer, RenderState, write_video
from morphgen.tasks.sim.base import Scene
from morphgen.typing import Array
from morphgen.viewer.scene_robot import robot_bounds

SIZE = (640, 480)
"""Width and height of a frame [pixels]."""
NUM_FRAMES, FPS = 72, 18
"""Frames of a turn, and frames per second: a turn takes four seconds."""
_RING_POINTS = 24


def turntable(robot: Robot, suffix: str) -> bytes:
    """Return a video of a robot at home that turns once around the vertical.

    Args:
        robot: The robot.
        suffix: ``.mp4`` or ``.gif``.

    Raises:
        FormatError: If ffmpeg is missing or fails.
        MeshError: If a mesh cannot be read.
        MissingDependencyError: If there is no offscreen OpenGL.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"turntable{suffix}"
        write_video(_frames(robot), path, FPS)
        return path.read_bytes()


def _frames(robot: Robot) -> Iterator[Frame]:
    """Yield the frames of a turn; the camera sees the robot from every side."""
    home = np.array([robot.home], dtype=np.float64)
    renderer = Renderer(Scene(robot), (), home, _ring(robot), SIZE)
    try:
        state = RenderState(home[0].astype(np.float32))
        for i in range(NUM_FRAMES):
            yield renderer.frame(state, 360 * i / NUM_FRAMES)
    finally:
        renderer.close()


def _ring(robot: Robot) -> Array:
    """Return points on the cylinder that a robot's bounding box fills as it turns, (n, 3) [m]."""
    low, high = robot_bounds(robot)
    middle, radius = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) / 2
    angles = np.linspace(0, 2 * np.pi, _RING_POINTS, endpoint=False)
    circle = middle[:2] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.insert(circle, 2, z, axis=1) for z in (max(low[2], 0.0), high[2])])

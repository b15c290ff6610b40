"""Films of a robot that turns, and of an episode.

They need PyTorch and a video encoder, which take seconds to load: only workers import this module.
"""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from morphgen.model.robot import Robot
from morphgen.tasks.renderer import SIZE, Frame, Renderer, RenderState, write_video
from morphgen.tasks.sim.base import Block, Scene
from morphgen.typing import Array
from morphgen.viewer.episode import BLOCK, STRIDE, Episode, Track
from morphgen.viewer.scene.robot import robot_bounds

NUM_FRAMES, FPS = 72, 18  # frames of a turn, and frames per second: a turn takes four seconds
_RING_POINTS = 24
_FRAMED_STEPS = 32  # steps, evenly spread over the episode, by which the camera is framed


def turntable(robot: Robot, suffix: str) -> bytes:
    """Return a video of a robot at home that turns once around the vertical."""
    return _video(_turn(robot), suffix, FPS)


def render_video(episode: Episode) -> bytes:
    """Return an ``.mp4`` of an episode in real time; several robots are tiled."""
    return _video(_render_frames(episode), ".mp4", 1 / (STRIDE * episode.period))


def _video(frames: Iterable[Frame], suffix: str, fps: float) -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix}"
        write_video(frames, path, fps)
        return path.read_bytes()


def _turn(robot: Robot) -> Iterator[Frame]:
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


def make_renderer(track: Track, size: tuple[int, int]) -> Renderer:
    """Return a renderer whose camera sees a robot's whole episode."""
    steps = np.linspace(0, track.num_steps, min(_FRAMED_STEPS, track.num_steps + 1)).astype(int)
    configurations = np.array([track.robot.home, *(track.q[i] for i in steps)], dtype=np.float64)
    block = None if track.block_size is None else Block(track.block_size)
    scene = Scene(
        track.robot, object=track.object or block, obstacles=track.obstacles, ground=track.ground
    )
    positions = [poses[i][:3] for poses in track.poses.values() for i in steps]
    points = np.array(positions, dtype=np.float64).reshape(-1, 3)
    margin = 0.0 if track.block_size is None else max(track.block_size) / 2
    points = np.concatenate([points - margin, points + margin])
    return Renderer(scene, track.markers, configurations, points, size)


def _render_frames(episode: Episode) -> Iterator[Frame]:
    columns = int(np.ceil(np.sqrt(len(episode.tracks))))
    width, height = (2 * round(edge / columns / 2) for edge in SIZE)  # video codecs want even sizes
    with contextlib.ExitStack() as stack:
        renderers = []
        for track in episode.tracks:
            renderers.append(make_renderer(track, (width, height)))
            stack.callback(renderers[-1].close)
        for step in episode.film_steps:
            tiles = [
                renderer.frame(_render_state(track, min(step, track.num_steps)))
                for renderer, track in zip(renderers, episode.tracks, strict=True)
            ]
            tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
            rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
            yield np.vstack(rows)


def _render_state(track: Track, i: int) -> RenderState:
    poses = {name: poses[i] for name, poses in track.poses.items()}
    return RenderState(track.q[i], poses.pop(BLOCK, None), poses)

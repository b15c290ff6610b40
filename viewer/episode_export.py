"""Videos of episodes, recordings of their scenes, and web pages. Runs in worker processes."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import viser
from viser.infra import StateSerializer

from morphgen.tasks.renderer import SIZE, Frame, Renderer, RenderState, write_video
from morphgen.tasks.sim.base import Block, Scene
from morphgen.viewer.episode import Episode, Track
from morphgen.viewer.scene_rollout import add_episode, show_step
from morphgen.viewer.scene_stage import place_camera, set_stage
from morphgen.viewer.web_page import scene_server, web_page

STRIDE = 2
"""Control steps between two frames."""
_FRAMED_STEPS = 32
"""Steps, evenly spread over the episode, by which the camera is framed."""


def render_video(episode: Episode) -> bytes:
    """Return an ``.mp4`` of an episode in real time; several robots are tiled.

    Raises:
        MeshError: If a mesh cannot be read.
        MissingDependencyError: If there is no offscreen OpenGL.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mp4"
        write_video(_render_frames(episode), path, 1 / (STRIDE * episode.period))
        return path.read_bytes()


def record_scene(episode: Episode) -> bytes:
    """Return a ``.viser`` file for viser's own player: the scene with all its motions.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    with scene_server() as server:
        return _record(server, episode).serialize()


def episode_page(episode: Episode, dark: bool) -> bytes:
    """Return a web page that plays an episode without a server or a network.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    with scene_server() as server:
        set_stage(server.scene, dark=dark)
        recording = _record(server, episode)
        return web_page(recording, f"{episode.task}: {episode.tracks[0].robot.name}", dark=dark)


def make_renderer(track: Track, size: tuple[int, int]) -> Renderer:
    """Return a renderer whose camera sees a robot's whole episode."""
    steps = np.linspace(0, track.num_steps, min(_FRAMED_STEPS, track.num_steps + 1)).astype(int)
    configurations = np.array([track.robot.home, *(track.q[i] for i in steps)], dtype=np.float64)
    block = None if track.block_size is None else Block(track.block_size)
    scene = Scene(track.robot, block=block, obstacles=track.obstacles, ground=track.ground)
    moving = [*([track.block] if track.block else []), *track.marker_poses.values()]
    positions = [poses[i][:3] for poses in moving for i in steps]
    points = np.array(positions, dtype=np.float64).reshape(-1, 3)
    margin = 0.0 if track.block_size is None else max(track.block_size) / 2
    points = np.concatenate([points - margin, points + margin])
    return Renderer(scene, track.markers, configurations, points, size)


def _record(server: viser.ViserServer, episode: Episode) -> StateSerializer:
    """Draw an episode in a server's scene and return its recording."""
    scene = add_episode(server.scene, episode)
    place_camera(server.initial_camera, scene.low, scene.high)
    recording = server.get_scene_serializer()
    for step in _frame_steps(episode):
        show_step(scene, step)
        recording.insert_sleep(STRIDE * episode.period)
    return recording


def _render_frames(episode: Episode) -> Iterator[Frame]:
    """Yield the frames of a video: the robots of a step, tiled."""
    columns = int(np.ceil(np.sqrt(len(episode.tracks))))
    width, height = (2 * round(edge / columns / 2) for edge in SIZE)  # video codecs want even sizes
    with contextlib.ExitStack() as stack:
        renderers = []
        for track in episode.tracks:
            renderers.append(make_renderer(track, (width, height)))
            stack.callback(renderers[-1].close)
        for step in _frame_steps(episode):
            tiles = [
                renderer.frame(_render_state(track, min(step, track.num_steps)))
                for renderer, track in zip(renderers, episode.tracks, strict=True)
            ]
            tiles += [np.full_like(tiles[0], 255)] * (-len(tiles) % columns)
            rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
            yield np.vstack(rows)


def _render_state(track: Track, i: int) -> RenderState:
    markers = {name: poses[i] for name, poses in track.marker_poses.items()}
    return RenderState(track.q[i], track.block[i] if track.block else None, markers)


def _frame_steps(episode: Episode) -> list[int]:
    """Return the steps that are shown: the start, every ``STRIDE`` steps, and the end."""
    return [*range(0, episode.num_steps, STRIDE), episode.num_steps]

"""Films of episodes, and recordings of the scene; made by worker processes."""

from __future__ import annotations

import contextlib
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from morphgen.tasks.renderer import SIZE, Frame, Renderer, RenderState, write_video
from morphgen.tasks.sim.base import Block, Scene
from morphgen.viewer.access import AccessPolicy
from morphgen.viewer.episode import Episode, Track
from morphgen.viewer.scene_episode import add_episode, show_step
from morphgen.viewer.server import start_server

STRIDE = 2
"""Control steps between two pictures."""
_SEEN = 32
"""Moments that are in view for certain."""


def film(episode: Episode) -> bytes:
    """An ``.mp4`` of an episode at its own speed; several bodies are beside each other.

    Raises:
        MeshError: If a mesh cannot be read.
        MissingDependencyError: If there is no offscreen OpenGL.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episode.mp4"
        write_video(_frames(episode), path, 1 / (STRIDE * episode.period))
        return path.read_bytes()


def recording(episode: Episode) -> bytes:
    """A ``.viser`` file: the scene with all that moves in it, for viser's own player.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    server = start_server("127.0.0.1", 0, AccessPolicy(names=frozenset()))  # nobody may ask it
    try:
        shown = add_episode(server.scene, episode)
        serializer = server.get_scene_serializer()
        for step in _steps(episode):
            show_step(shown, step)
            serializer.insert_sleep(STRIDE * episode.period)
        return serializer.serialize()
    finally:
        with contextlib.redirect_stdout(io.StringIO()):
            server.stop()


def renderer_of(track: Track, size: tuple[int, int]) -> Renderer:
    """Return a renderer with a view of all that a body's episode has."""
    every = np.linspace(0, track.steps, min(_SEEN, track.steps + 1)).astype(int)
    configurations = np.array([track.robot.home, *(track.q[i] for i in every)], dtype=np.float64)
    block = None if track.block_size is None else Block(track.block_size)
    scene = Scene(track.robot, block=block, obstacles=track.obstacles, ground=track.ground)
    tracked = [track.block] if track.block else []
    poses = [poses[i] for poses in (*tracked, *track.marker_poses.values()) for i in every]
    half = 0.0 if track.block_size is None else max(track.block_size) / 2
    points = np.array([pose[:3] for pose in poses], dtype=np.float64).reshape(-1, 3)
    points = np.concatenate([points - half, points + half])
    return Renderer(scene, track.markers, configurations, points, size)


def _frames(episode: Episode) -> Iterator[Frame]:
    columns = int(np.ceil(np.sqrt(len(episode.tracks))))
    width, height = (2 * round(edge / columns / 2) for edge in SIZE)
    with contextlib.ExitStack() as opened:
        renderers = []
        for track in episode.tracks:
            renderers.append(renderer_of(track, (width, height)))
            opened.callback(renderers[-1].close)
        for step in _steps(episode):
            tiles = [
                _frame(renderer, track, step)
                for renderer, track in zip(renderers, episode.tracks, strict=True)
            ]
            yield _tiled(tiles, columns)


def _frame(renderer: Renderer, track: Track, step: int) -> Frame:
    at = min(step, track.steps)
    block = track.block[at] if track.block else None
    markers = {name: poses[at] for name, poses in track.marker_poses.items()}
    return renderer.frame(RenderState(track.q[at], block, markers))


def _tiled(tiles: list[Frame], columns: int) -> Frame:
    empty = np.full_like(tiles[0], 255)
    tiles = tiles + [empty] * (-len(tiles) % columns)
    rows = [np.hstack(tiles[i : i + columns]) for i in range(0, len(tiles), columns)]
    return np.vstack(rows)


def _steps(episode: Episode) -> list[int]:
    """What is shown: the start, every other moment, and the end."""
    steps = list(range(0, episode.steps, STRIDE))
    return [*steps, episode.steps]

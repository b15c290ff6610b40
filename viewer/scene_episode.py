"""An episode in a scene: its bodies beside each other, each with its goal, obstacles and block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser

from morphgen.model.geometry import Pose
from morphgen.tasks.sim.base import Block
from morphgen.tasks.task import Marker
from morphgen.typing import Array
from morphgen.viewer.episode import Episode, Track
from morphgen.viewer.scene_robot import Rgb, RobotView, add_robot, move, robot_bounds

Position = tuple[float, float, float]

NODE = "/play"
"""Of all that belongs to an episode."""
GAP = 0.3
"""Between the areas of two bodies, metres."""
_GOAL: Rgb = (26, 166, 64)
_BLOCK: Rgb = (230, 140, 38)
_OBSTACLE: Rgb = (140, 64, 64)


@dataclass(eq=False)
class Stand:
    """A body in the scene."""

    track: Track
    view: RobotView
    block: viser.BoxHandle | None
    markers: dict[str, viser.FrameHandle | viser.BoxHandle]


@dataclass(eq=False)
class PlayScene:
    """An episode in a scene."""

    episode: Episode
    root: viser.FrameHandle
    stands: list[Stand]
    low: Array
    """Lowest corner of what holds all of it, shape (3,), metres."""
    high: Array


def add_episode(scene: viser.SceneApi, episode: Episode) -> PlayScene:
    """Draw an episode's bodies and surroundings at its start.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    areas = [area(track) for track in episode.tracks]
    root = scene.add_frame(NODE, show_axes=False)
    spots = places_in_grid(areas)
    stands = [
        _add_track(scene, f"{NODE}/{i}", track, spot, named=len(spots) > 1)
        for i, (track, spot) in enumerate(zip(episode.tracks, spots, strict=True))
    ]
    low = np.min([a[0] + spot for a, spot in zip(areas, spots, strict=True)], axis=0)
    high = np.max([a[1] + spot for a, spot in zip(areas, spots, strict=True)], axis=0)
    shown = PlayScene(episode, root, stands, low, high)
    _add_ground(scene, shown)
    show_step(shown, 0)
    return shown


def show_step(shown: PlayScene, step: int) -> None:
    """Move everything to where it was after some control steps; what ended before stays."""
    for stand in shown.stands:
        at = min(step, stand.track.steps)
        move(stand.view, stand.track.q[at])
        if stand.block is not None:
            pose = stand.track.block[at].tolist()
            stand.block.position, stand.block.wxyz = tuple(pose[:3]), tuple(pose[3:])
        for name, handle in stand.markers.items():
            pose = stand.track.marker_poses[name][at].tolist()
            handle.position, handle.wxyz = tuple(pose[:3]), tuple(pose[3:])


def area(track: Track) -> tuple[Array, Array]:
    """Lowest and highest corner of what a body has around it at the start, metres."""
    points = [np.zeros(3)]
    for q in (track.robot.home, track.q[0]):
        points += robot_bounds(track.robot, q)
    shown = [track.block[0]] if track.block else []
    shown += [poses[0] for poses in track.marker_poses.values()]
    points += [pose[:3].astype(np.float64) for pose in shown]
    points += [np.array(block.pose.position) for block in track.obstacles]
    return np.min(points, axis=0), np.max(points, axis=0)


def places_in_grid(areas: Sequence[tuple[Array, Array]]) -> list[Position]:
    """Where bodies stand so that none is in the area of another: rows along y, roots at z = 0."""
    columns = math.ceil(math.sqrt(len(areas)))
    reach = np.max([np.maximum(np.abs(low), np.abs(high))[:2] for low, high in areas], axis=0)
    across, along = (2 * reach + GAP).tolist()
    middle = (columns - 1) / 2
    return [
        (-(i // columns) * across, (middle - i % columns) * along, 0.0) for i in range(len(areas))
    ]


def _add_track(
    scene: viser.SceneApi, name: str, track: Track, spot: Position, *, named: bool
) -> Stand:
    scene.add_frame(name, show_axes=False, position=spot)
    view = add_robot(scene, track.robot, f"{name}/robot")
    for i, obstacle in enumerate(track.obstacles):
        _add_box(scene, f"{name}/obstacle{i}", obstacle, _OBSTACLE)
    markers = {m.name: _add_marker(scene, f"{name}/{m.name}", m) for m in track.markers}
    block = None
    if track.block and track.block_size is not None:
        start = Pose(tuple(track.block[0][:3].tolist()), tuple(track.block[0][3:].tolist()))
        block = _add_box(scene, f"{name}/block", Block(track.block_size, start), _BLOCK)
    if named:
        top = float(robot_bounds(track.robot)[1][2])
        scene.add_label(f"{name}/label", track.robot.name, position=(0.0, 0.0, top + 0.1))
    return Stand(track, view, block, markers)


def _add_marker(
    scene: viser.SceneApi, name: str, marker: Marker
) -> viser.FrameHandle | viser.BoxHandle:
    """Add a box, or axes inside a translucent ball."""
    if marker.shape == "box":
        return scene.add_box(name, _GOAL, marker.size, cast_shadow=False)
    radius = marker.size[0] / 2
    frame = scene.add_frame(
        name, axes_length=2 * radius, axes_radius=0.1 * radius, origin_radius=0.15 * radius
    )
    scene.add_icosphere(f"{name}/near", radius, _GOAL, opacity=0.45, cast_shadow=False)
    return frame


def _add_box(scene: viser.SceneApi, name: str, block: Block, colour: Rgb) -> viser.BoxHandle:
    return scene.add_box(
        name, colour, block.size, position=block.pose.position, wxyz=block.pose.quaternion
    )


def _add_ground(scene: viser.SceneApi, shown: PlayScene) -> None:
    """A grid as low as the lowest ground: a cell is 10 cm, a section 1 m."""
    size, middle = shown.high - shown.low, (shown.low + shown.high) / 2
    heights = [track.ground for track in shown.episode.tracks if track.ground is not None]
    scene.add_grid(
        f"{NODE}/ground",
        width=2.0 * math.ceil(float(size[0]) / 2 + 1),
        height=2.0 * math.ceil(float(size[1]) / 2 + 1),
        cell_size=0.1,
        section_size=1.0,
        position=(float(middle[0]), float(middle[1]), min(heights, default=0.0)),
    )

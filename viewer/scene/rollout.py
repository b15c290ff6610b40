"""An episode in viser's scene: its robots side by side, with goals, obstacles and blocks."""

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
from morphgen.viewer.robot_files import scene_server, web_page
from morphgen.viewer.rollout import BLOCK, Episode, Track
from morphgen.viewer.scene.robot import RobotView, add_robot, robot_bounds
from morphgen.viewer.scene.stage import Rgb, add_ground, place_camera, set_stage

Position = tuple[float, float, float]

NODE = "/play"  # name of the scene node above everything of an episode
GAP = 0.3  # distance between the areas of two robots [m]
_GOAL: Rgb = (26, 166, 64)
_BLOCK: Rgb = (230, 140, 38)
_OBSTACLE: Rgb = (140, 64, 64)


@dataclass(eq=False)
class DrawnTrack:
    """A robot of an episode in the scene."""

    track: Track
    view: RobotView
    moving: dict[str, viser.FrameHandle | viser.BoxHandle]  # markers and the block, by name
    object: RobotView | None  # the articulated object


@dataclass(eq=False)
class RolloutScene:
    """An episode in a scene."""

    root: viser.FrameHandle
    tracks: list[DrawnTrack]
    low: Array  # lowest corner of the episode's bounding box, shape (3,) [m]
    high: Array  # highest corner of the episode's bounding box, shape (3,) [m]


def add_episode(scene: viser.SceneApi, episode: Episode) -> RolloutScene:
    """Draw an episode's robots and their surroundings at its start."""
    areas = [track_area(track) for track in episode.tracks]
    positions = grid_positions(areas)
    root = scene.add_frame(NODE, show_axes=False)
    tracks = [
        _add_track(scene, f"{NODE}/{i}", track, position, labelled=len(positions) > 1)
        for i, (track, position) in enumerate(zip(episode.tracks, positions, strict=True))
    ]
    corners = np.array(areas) + np.array(positions)[:, None]
    low, high = corners[:, 0].min(axis=0), corners[:, 1].max(axis=0)
    heights = [track.ground for track in episode.tracks if track.ground is not None]
    ground = min(heights, default=0.0)
    add_ground(scene, float(np.linalg.norm(high - low)), ground)
    rollout_scene = RolloutScene(root, tracks, low, high)
    show_step(rollout_scene, 0)
    return rollout_scene


def show_step(scene: RolloutScene, step: int) -> None:
    """Move everything to its pose after a number of control steps, or after its last one."""
    for drawn in scene.tracks:
        track = drawn.track
        i = min(step, track.num_steps)
        drawn.view.set_configuration(track.q[i])
        for name, handle in drawn.moving.items():
            pose = track.poses[name][i].tolist()
            handle.position, handle.wxyz = tuple(pose[:3]), tuple(pose[3:])
        if drawn.object is not None and track.object is not None:
            pose = track.poses[BLOCK][i][None].astype(np.float64)
            drawn.object.set_configuration(track.object.placed_joint.positions(pose))


_MOMENTS = 8  # moments of an episode that must be in view


def track_area(track: Track) -> tuple[Array, Array]:
    """Return the lowest and highest corner of a robot with its surroundings in its motion [m]."""
    points = [np.zeros(3)]
    every = math.ceil(len(track.q) / _MOMENTS)
    for q in [np.array(track.robot.home), *track.q[::every]]:
        points += robot_bounds(track.robot, q)
    for poses in track.poses.values():
        points += [pose[:3].astype(np.float64) for pose in poses[::every]]
    points += [np.array(block.pose.position) for block in track.obstacles]
    return np.min(points, axis=0), np.max(points, axis=0)


def grid_positions(areas: Sequence[tuple[Array, Array]]) -> list[Position]:
    """Return positions of roots in a square grid, so that no area overlaps another."""
    columns = math.ceil(math.sqrt(len(areas)))
    reach = np.max([np.maximum(np.abs(low), np.abs(high))[:2] for low, high in areas], axis=0)
    dx, dy = (2 * reach + GAP).tolist()
    centre_column = (columns - 1) / 2
    cells = (divmod(i, columns) for i in range(len(areas)))
    return [(-row * dx, (centre_column - column) * dy, 0.0) for row, column in cells]


def _add_track(
    scene: viser.SceneApi, name: str, track: Track, position: Position, *, labelled: bool
) -> DrawnTrack:
    scene.add_frame(name, show_axes=False, position=position)
    view = add_robot(scene, track.robot, f"{name}/robot")
    for i, obstacle in enumerate(track.obstacles):
        _add_box(scene, f"{name}/obstacle{i}", obstacle, _OBSTACLE)
    moving = {m.name: _add_marker(scene, f"{name}/{m.name}", m) for m in track.markers}
    if track.block_size is not None:
        moving[BLOCK] = _add_box(scene, f"{name}/block", Block(track.block_size, Pose()), _BLOCK)
    thing = None
    if track.object is not None:
        pose = track.object.pose
        thing = add_robot(scene, track.object.body, f"{name}/object", pose.position)
        thing.base.wxyz = pose.quaternion
    if labelled:
        foot = (0.0, 0.0, track.ground or 0.0)  # a robot moves away from a name above it
        scene.add_label(f"{name}/label", track.robot.name, position=foot, anchor="top-center")
    return DrawnTrack(track, view, moving, thing)


def _add_marker(
    scene: viser.SceneApi, name: str, marker: Marker
) -> viser.FrameHandle | viser.BoxHandle:
    """Add a marker of a goal: a box, or axes inside a translucent ball."""
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


STRIDE = 2  # control steps between two pictures of a web page


def episode_page(episode: Episode, dark: bool) -> bytes:
    """Return a web page that plays an episode without a server or a network."""
    with scene_server() as server:
        set_stage(server.scene, dark=dark)
        scene = add_episode(server.scene, episode)
        place_camera(server.initial_camera, scene.low, scene.high)
        recording = server.get_scene_serializer()
        for step in (*range(0, episode.num_steps, STRIDE), episode.num_steps):
            show_step(scene, step)
            recording.insert_sleep(STRIDE * episode.period)
        return web_page(recording, f"{episode.task}: {episode.tracks[0].robot.name}", dark=dark)

"""Web pages that show a robot without a server or a network: viser's client with the scene."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape

import numpy as np
import viser
from viser.infra import StateSerializer

from morphgen.formats.bundle import split_colours
from morphgen.model.kinematics import joint_limits
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.app.server import AccessPolicy, start_server, stop_server
from morphgen.viewer.scene.robot import add_robot, robot_bounds
from morphgen.viewer.scene.stage import (
    add_ground,
    place_camera,
    set_stage,
)

_TITLE = re.compile(r"<title>[^<]*</title>")
_JOINT_TIME, _HOME_TIME, _FRAME_TIME = 2.4, 1.0, 0.05
"""Time in which a joint moves through its range, at home before the first one, and of a picture
[s]."""
_BOUNDED_STEPS = 8  # configurations of each joint by which the camera is framed
_LABEL_SHARE = 0.08  # height of the room for the label, as a share of the robot's


@contextmanager
def scene_server() -> Iterator[viser.ViserServer]:
    """Start a server whose scene can be recorded; having no name, it accepts no request."""
    server = start_server("127.0.0.1", 0, AccessPolicy(names=frozenset()))
    try:
        yield server
    finally:
        stop_server(server)


def robot_page(robot: Robot, dark: bool = False) -> bytes:
    """Return a web page of a robot that moves its joints in turn, with slider and space bar."""
    robot = split_colours(robot)
    low, high = robot_bounds(robot)
    with scene_server() as server:
        set_stage(server.scene, dark=dark)
        add_ground(server.scene, float(np.linalg.norm(high - low)))
        view = add_robot(server.scene, robot, "/robot")
        low, high = sweep_bounds(robot)
        place_camera(server.initial_camera, low, high)
        if not robot.dof:
            return web_page(server.get_scene_serializer(), robot.name, dark=dark)
        top = (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2, float(high[2]))
        label = server.scene.add_label("/joint", "home", position=top, anchor="top-center")
        recording = server.get_scene_serializer()
        recording.insert_sleep(_HOME_TIME)
        for column, text in enumerate(joint_titles(robot)):
            label.text = text
            for q in joint_sweep(robot, column, round(_JOINT_TIME / _FRAME_TIME)):
                view.set_configuration(q)
                recording.insert_sleep(_FRAME_TIME)
        return web_page(recording, robot.name, dark=dark)


def joint_sweep(robot: Robot, column: int, n: int) -> Array:
    """Return configurations (n, dof) in which a joint moves from home to both limits and back."""
    home = np.array(robot.home, dtype=np.float64)
    low, high = joint_limits(robot)[column]
    stops = np.array([home[column], low, high, home[column]])
    times = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(stops)))])
    share = (1 - np.cos(np.pi * np.arange(1, n + 1) / n)) / 2
    configurations = np.tile(home, (n, 1))
    configurations[:, column] = np.interp(share * times[-1], times, stops)
    return configurations


def sweep_bounds(robot: Robot) -> tuple[Array, Array]:
    """Return the corners of a robot while its joints move as the page shows, and of its label."""
    sweeps = [joint_sweep(robot, column, _BOUNDED_STEPS) for column in range(robot.dof)]
    configurations = np.concatenate([np.array(robot.home, dtype=np.float64)[None], *sweeps])
    lows, highs = zip(*(robot_bounds(robot, q) for q in configurations), strict=True)
    low, high = np.min(lows, axis=0), np.max(highs, axis=0)
    high[2] += _LABEL_SHARE * (high[2] - low[2])
    return low, high


def joint_titles(robot: Robot) -> list[str]:
    """Return the number, name and range of each independent joint."""
    titles = []
    for column, (low, high) in enumerate(joint_limits(robot)):
        joint = robot.joints[robot.independent_joints[column]]
        is_angle = joint.kind != "prismatic"
        ends = np.degrees((low, high)) if is_angle else np.array((low, high))
        limits = f"{ends[0]:.3g} to {ends[1]:.3g} {'deg' if is_angle else 'm'}"
        titles.append(f"joint {column + 1} of {robot.dof}, {joint.name}: {limits}")
    return titles


def web_page(recording: StateSerializer, title: str, *, dark: bool) -> bytes:
    """Return a recorded scene as a web page."""
    html, count = _TITLE.subn(f"<title>{escape(title)}</title>", recording.as_html(dark), count=1)
    if count != 1:
        raise RuntimeError("this version of viser has another page; see viewer/app/web_page.py")
    return html.encode()

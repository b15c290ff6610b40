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
from morphgen.model.robot import Robot
from morphgen.viewer.access import AccessPolicy
from morphgen.viewer.scene_robot import add_robot, robot_bounds
from morphgen.viewer.scene_stage import (
    CAMERA_DIRECTION,
    add_ground,
    add_scale_bar,
    place_camera,
    set_stage,
)
from morphgen.viewer.server import start_server, stop_server

_TITLE = re.compile(r"<title>[^<]*</title>")


@contextmanager
def scene_server() -> Iterator[viser.ViserServer]:
    """Start a server whose scene can be recorded: viser records only scenes of servers.

    It accepts no request, because it has no name.
    """
    server = start_server("127.0.0.1", 0, AccessPolicy(names=frozenset()))
    try:
        yield server
    finally:
        stop_server(server)


def robot_page(robot: Robot, dark: bool = False) -> bytes:
    """Return a web page with a robot at home on the viewer's stage.

    Raises:
        MeshError: If a mesh cannot be read.
    """
    robot = split_colours(robot)
    low, high = robot_bounds(robot)
    with scene_server() as server:
        set_stage(server.scene, dark=dark)
        add_ground(server.scene, float(np.linalg.norm(high - low)))
        add_scale_bar(server.scene, low, high, CAMERA_DIRECTION)
        add_robot(server.scene, robot, "/robot")
        place_camera(server.initial_camera, low, high)
        return web_page(server.get_scene_serializer(), robot.name, dark=dark)


def web_page(recording: StateSerializer, title: str, *, dark: bool) -> bytes:
    """Return a recorded scene as a web page.

    Raises:
        RuntimeError: If the installed viser has another page.
    """
    html, count = _TITLE.subn(f"<title>{escape(title)}</title>", recording.as_html(dark), count=1)
    if count != 1:
        raise RuntimeError("this version of viser has another page; see viewer/web_page.py")
    return html.encode()

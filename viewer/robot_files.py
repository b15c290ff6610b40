"""Files made from robots: thumbnails with facts of a gallery, bundles, web pages, turntables."""

from __future__ import annotations

import base64
import io
import re
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path

import numpy as np
import viser
from PIL import Image
from viser.infra import StateSerializer

from morphgen.benchmark.survey import robot_stats
from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.files import kept
from morphgen.formats.bundle import CARD, MJCF, split_colours, write_bundle
from morphgen.formats.picture import render
from morphgen.formats.zip_files import write_entries
from morphgen.model.kinematics import joint_limits
from morphgen.model.mesh_files import read_picture
from morphgen.model.robot import Robot
from morphgen.typing import Array
from morphgen.viewer.app.address import AddressError
from morphgen.viewer.app.server import AccessPolicy, start_server, stop_server
from morphgen.viewer.app.session import Session
from morphgen.viewer.robot_uri import FileAccess, UriError, content_hash, read_robot_uri, uri_name
from morphgen.viewer.scene.robot import add_robot, robot_bounds
from morphgen.viewer.scene.stage import add_ground, place_camera, set_stage

SIZE = (240, 180)  # largest width and height of a thumbnail [pixels]
_JPEG_QUALITY = 82  # JPEG quality of thumbnails, 0 to 100; tuned by eye at the size of a card
_CACHE_FORMAT = 3  # increase it when a thumbnail or its facts change for the same robot


@dataclass(frozen=True)
class Thumbnail:
    """A small picture of a robot and its facts."""

    image: str  # a JPEG as a `data:` URL; empty if the robot cannot be drawn
    facts: dict[str, object]  # values of `Row` fields
    error: str = ""  # reason why the robot cannot be read; empty if it can


def make_thumbnail(uri: str, files: FileAccess) -> Thumbnail:
    """Return the thumbnail of a robot, from the user's cache or drawn now. Runs in a worker."""
    try:
        key = (_CACHE_FORMAT, content_hash(uri, files))
        return kept("thumbnail", key, lambda: _draw_thumbnail(uri, files), (Thumbnail,))
    except (MorphgenError, OSError) as error:
        return Thumbnail("", {"findings": ("broken",)}, files.redact(error))


def thumbnail_of_picture(path: Path) -> str:
    """Return a picture file as a small JPEG in a ``data:`` URL; empty if it is not a picture."""
    try:
        return _data_url(read_picture(path))
    except (OSError, ValueError):
        return ""


def bundle_files(uri: str, files: FileAccess) -> dict[str, bytes]:
    """Return the files of a robot's bundle by path; a robot without bundle gets a new one."""
    if ":" not in uri and (folder := files.path(uri)).is_dir() and (folder / CARD).is_file():
        return _read_files(folder)
    return new_bundle_files(read_robot_uri(uri, files))


def new_bundle_files(robot: Robot) -> dict[str, bytes]:
    """Return the files of a new bundle of a robot by their paths."""
    with tempfile.TemporaryDirectory() as folder:
        return _read_files(write_bundle(robot, Path(folder) / "robot", check(robot), picture=False))


def zip_files(folder: str, files: dict[str, bytes]) -> bytes:
    """Return a zip with the files in a folder; the same files give the same bytes."""
    content = io.BytesIO()
    write_entries(content, {f"{folder}/{path}": data for path, data in files.items()})
    return content.getvalue()


def _read_files(folder: Path) -> dict[str, bytes]:
    """Read the files below a folder, except links that lead out of it."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.resolve().is_relative_to(folder.resolve())
    }


def _draw_thumbnail(uri: str, files: FileAccess) -> Thumbnail:
    robot = read_robot_uri(uri, files)
    findings = {finding.code for finding in check(robot) if finding.severity != "info"}
    facts = robot_facts(robot) | {"findings": tuple(sorted(findings))}
    with tempfile.TemporaryDirectory() as folder:
        bundle = write_bundle(robot, Path(folder) / "robot", picture=False)
        picture = render(robot, bundle / MJCF, size=(2 * SIZE[0], 2 * SIZE[1]))
    return Thumbnail(_data_url(picture), facts)


def robot_facts(robot: Robot) -> dict[str, object]:
    """Return the numbers that rows of galleries have of a robot; no reach without a tool."""
    stats = robot_stats(robot)
    reach = stats.reach if robot.tool and stats.dof else None
    return {"dof": stats.dof, "links": stats.links, "reach": reach, "mass": stats.mass}


def _data_url(picture: Image.Image) -> str:
    content = io.BytesIO()
    small = picture.convert("RGB")
    small.thumbnail(SIZE)
    small.save(content, "JPEG", quality=_JPEG_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(content.getvalue()).decode()


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


def robot_page(robot: Robot) -> bytes:
    """Return a web page of a robot that moves its joints in turn, with slider and space bar."""
    robot = split_colours(robot)
    low, high = robot_bounds(robot)
    with scene_server() as server:
        set_stage(server.scene, dark=False)
        add_ground(server.scene, float(np.linalg.norm(high - low)))
        view = add_robot(server.scene, robot, "/robot")
        low, high = sweep_bounds(robot)
        place_camera(server.initial_camera, low, high)
        if not robot.dof:
            return web_page(server.get_scene_serializer(), robot.name, dark=False)
        top = (float(low[0] + high[0]) / 2, float(low[1] + high[1]) / 2, float(high[2]))
        label = server.scene.add_label("/joint", "home", position=top, anchor="top-center")
        recording = server.get_scene_serializer()
        recording.insert_sleep(_HOME_TIME)
        for column, text in enumerate(joint_titles(robot)):
            label.text = text
            for q in joint_sweep(robot, column, round(_JOINT_TIME / _FRAME_TIME)):
                view.set_configuration(q)
                recording.insert_sleep(_FRAME_TIME)
        return web_page(recording, robot.name, dark=False)


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
        raise RuntimeError("this version of viser has another page; see viewer/robot_files.py")
    return html.encode()


NUM_FRAMES, FPS = 72, 18  # frames of a turn, and frames per second: a turn takes four seconds
_RING_POINTS = 24


def turntable(robot: Robot, suffix: str) -> bytes:
    """Return a video of a robot at home that turns once around the vertical."""
    # PyTorch and the video encoder take seconds to load, for which web pages need not wait.
    from morphgen.tasks.renderer import SIZE, Renderer, RenderState, write_video
    from morphgen.tasks.sim.base import Scene

    home = np.array([robot.home], dtype=np.float64)
    renderer = Renderer(Scene(robot), (), home, _ring(robot), SIZE)
    state = RenderState(home[0].astype(np.float32))
    frames = (renderer.frame(state, 360 * i / NUM_FRAMES) for i in range(NUM_FRAMES))
    with closing(renderer), tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"film{suffix}"
        write_video(frames, path, FPS)
        return path.read_bytes()


def _ring(robot: Robot) -> Array:
    """Return points on the cylinder that a robot's bounding box fills as it turns, (n, 3) [m]."""
    low, high = robot_bounds(robot)
    middle, radius = (low + high) / 2, float(np.linalg.norm((high - low)[:2])) / 2
    angles = np.linspace(0, 2 * np.pi, _RING_POINTS, endpoint=False)
    circle = middle[:2] + radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return np.concatenate([np.insert(circle, 2, z, axis=1) for z in (max(low[2], 0.0), high[2])])


MAX_EXPORT = 200 * 2**20  # largest export before compression [bytes]
MAX_NAME = 60  # longest name of a robot's folder in an export, after its number [characters]
_NOT_IN_NAMES = re.compile(r"[^\w.-]+")


def change_tray(session: Session, action: str, uri: str) -> None:
    """Do what a page's script asks for: keep the open tabs, or an action of the tray."""
    if action == "tab":
        session.keep_tabs(uri)
    elif action == "choose":
        session.choose((*session.chosen, uri))
    elif action == "drop":
        session.choose([other for other in session.chosen if other != uri])
    elif action == "clear":
        session.choose(())
    elif action == "download":
        session.run_in_background(lambda: send_bundles(session, session.chosen))
    else:
        raise AddressError(
            f"{action!r:.40}: unknown action; expected choose, drop, clear or download"
        )


def send_bundles(session: Session, uris: Sequence[str]) -> None:
    """Send a zip with the bundles of robots, each in a folder of its name."""
    files: dict[str, bytes] = {}
    size = 0
    with session.activity("packing {} robots"):
        bundles = session.workers.map(partial(bundle_files, files=session.files), uris)
        for i, (uri, bundle) in enumerate(zip(uris, bundles, strict=True)):
            name = _NOT_IN_NAMES.sub("-", uri_name(uri))[:MAX_NAME]
            files |= {f"{i:04d}-{name}/{path}": data for path, data in bundle.items()}
            size += sum(map(len, bundle.values()))
            if size > MAX_EXPORT:
                raise UriError(
                    f"the first {i + 1} of {len(uris)} robots have {size / 2**20:.0f} MB; at most "
                    f"{MAX_EXPORT // 2**20} MB are exported: select fewer, or copy their folders"
                )
    session.send_file("robots.zip", zip_files("robots", files))

"""Thumbnails of robots, and the facts that a gallery shows of them; made by worker processes."""

from __future__ import annotations

import base64
import io
import json
import tempfile
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from PIL import Image
from platformdirs import user_cache_path

from morphgen.benchmark.survey import robot_stats
from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.formats.bundle import MJCF, PICTURE, URDF, write_bundle
from morphgen.formats.files import write_atomic, write_cache_file
from morphgen.formats.picture import render
from morphgen.viewer.robot_uri import FileAccess, content_hash, is_robot, read_robot_uri
from morphgen.viewer.workers import Workers

SIZE = (240, 180)
_QUALITY = 82
_FORMAT = 1


@dataclass(frozen=True)
class Portrait:
    """A robot at a glance."""

    thumbnail: str
    """A JPEG as a ``data:`` URL; empty if none can be drawn."""
    facts: dict[str, object]
    """For ``entries.with_facts``."""
    error: str = ""
    """Why there is no robot; empty if there is."""


def ask(workers: Workers, place: str, places: FileAccess) -> Future[Portrait]:
    """Have a portrait made."""
    return workers.submit(portrait, place, places)


def portrait(place: str, places: FileAccess) -> Portrait:
    """The portrait of the robot at a place, from the cache or made and kept there."""
    try:
        name = f"{content_hash(place, places)}.json"
        path = user_cache_path("morphgen") / f"viewer-{_FORMAT}" / name
        if path.is_file():
            data = json.loads(path.read_text(encoding="utf-8"))
            facts = {**data["facts"], "findings": tuple(data["facts"]["findings"])}
            return Portrait(data["thumbnail"], facts)
        made = _made(place, places)
    except (MorphgenError, OSError) as error:
        return Portrait("", {"findings": ("broken",)}, places.told(error))
    with suppress(OSError):  # where nothing can be kept it is drawn again next time
        write_cache_file(path, json.dumps({"thumbnail": made.thumbnail, "facts": made.facts}))
    return made


def thumbnail_of_picture(path: Path) -> str:
    """A picture file as a small JPEG in a ``data:`` URL; empty if it is none."""
    try:
        with Image.open(path) as picture:
            return _data_url(picture)
    except OSError:
        return ""


def _made(place: str, places: FileAccess) -> Portrait:
    robot = read_robot_uri(place, places)
    loud = sorted({finding.code for finding in check(robot) if finding.severity != "info"})
    known = robot_stats(robot)
    has_tool = any(frame.name == "tool" for frame in robot.frames)
    facts: dict[str, object] = {
        "dof": known.dof,
        "links": known.links,
        "reach": known.reach if has_tool and known.dof else None,
        "mass": known.mass,
        "findings": tuple(loud),
    }
    with tempfile.TemporaryDirectory() as folder:
        bundle = write_bundle(robot, Path(folder) / "robot", picture=False)
        picture = render(robot, bundle / URDF, bundle / MJCF, size=(2 * SIZE[0], 2 * SIZE[1]))
    if ":" not in place and is_robot(places.path(place)):
        _keep_picture(robot_folder=places.path(place), picture=picture)
    return Portrait(_data_url(picture), facts)


def _keep_picture(robot_folder: Path, picture: Image.Image) -> None:
    """Leave the picture in a bundle that has none, where that can be written."""
    path = robot_folder / PICTURE
    if path.exists():
        return
    content = io.BytesIO()
    picture.save(content, "PNG")
    with suppress(OSError):  # where others own the folder, the user's cache has the thumbnail
        write_atomic(path, content.getvalue())


def _data_url(picture: Image.Image) -> str:
    content = io.BytesIO()
    small = picture.convert("RGB")
    small.thumbnail(SIZE)
    small.save(content, "JPEG", quality=_QUALITY)
    return "data:image/jpeg;base64," + base64.b64encode(content.getvalue()).decode()

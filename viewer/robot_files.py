"""Files made from robots: thumbnails with the facts of a gallery, and bundles to download."""

from __future__ import annotations

import base64
import io
import json
import re
import tempfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from PIL import Image
from platformdirs import user_cache_path

from morphgen.benchmark.survey import robot_stats
from morphgen.checks import check
from morphgen.errors import MorphgenError
from morphgen.files import write_cache_file
from morphgen.formats.bundle import CARD, MJCF, write_bundle
from morphgen.formats.picture import render
from morphgen.formats.zip_files import write_entries
from morphgen.model.robot import Robot
from morphgen.model.scene_files import read_picture
from morphgen.viewer.app.address import AddressError
from morphgen.viewer.app.session import Session
from morphgen.viewer.robot_uri import FileAccess, UriError, content_hash, read_robot_uri, uri_name

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
        name = f"{content_hash(uri, files)}.json"
        path = user_cache_path("morphgen") / f"viewer-{_CACHE_FORMAT}" / name
        if path.is_file():
            data = json.loads(path.read_text(encoding="utf-8"))
            facts = {**data["facts"], "findings": tuple(data["facts"]["findings"])}
            return Thumbnail(data["thumbnail"], facts)
        thumbnail = _draw_thumbnail(uri, files)
    except (MorphgenError, OSError) as error:
        return Thumbnail("", {"findings": ("broken",)}, files.redact(error))
    with suppress(OSError):  # without a writable cache it is drawn again next time
        write_cache_file(path, json.dumps({"thumbnail": thumbnail.image, "facts": thumbnail.facts}))
    return thumbnail


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

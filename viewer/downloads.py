"""Files that a page hands out: a robot's bundle."""

from __future__ import annotations

import io
import tempfile
import zipfile
from pathlib import Path

from morphgen.checks import check
from morphgen.formats.bundle import CARD, write_bundle
from morphgen.model.robot import Robot
from morphgen.viewer.robot_uri import FileAccess, read_robot_uri

_STAMP = (1980, 1, 1, 0, 0, 0)
"""Of every file in a zip, so that the same robot gives the same bytes."""


def bundle_files(place: str, places: FileAccess) -> dict[str, bytes]:
    """The files of a robot's bundle by their paths in it, made where there is none.

    Raises:
        MorphgenError: If there is no robot, or it cannot be written.
    """
    if ":" not in place and (folder := places.path(place)).is_dir() and (folder / CARD).is_file():
        return _files(folder)
    return robot_files(read_robot_uri(place, places))


def robot_files(robot: Robot) -> dict[str, bytes]:
    """The files of a robot's new bundle by their paths in it.

    Raises:
        MorphgenError: If it cannot be written.
    """
    with tempfile.TemporaryDirectory() as folder:
        return _files(write_bundle(robot, Path(folder) / "robot", check(robot), picture=False))


def zipped(name: str, files: dict[str, bytes]) -> bytes:
    """A zip of files below a folder of that name; the same files give the same bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for path, data in sorted(files.items()):
            entry = zipfile.ZipInfo(f"{name}/{path}", _STAMP)
            entry.external_attr = 0o644 << 16
            archive.writestr(entry, data, zipfile.ZIP_DEFLATED)
    return content.getvalue()


def _files(folder: Path) -> dict[str, bytes]:
    """The files below a folder; links that lead out of it are left out."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.resolve().is_relative_to(folder.resolve())
    }

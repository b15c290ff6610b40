"""Robots that users send: a URDF, or a zip of a bundle, kept while the viewer runs.

Nothing of an upload may lie, or point, outside of its own folder.
"""

from __future__ import annotations

import io
import re
import secrets
import zipfile
import zlib
from pathlib import PurePosixPath

from morphgen.errors import MorphgenError
from morphgen.formats.bundle import CARD, URDF
from morphgen.formats.xml import parse_xml
from morphgen.viewer.places import UPLOAD, Places

LARGEST = 100 * 2**20
"""Bytes of an upload, packed or unpacked."""
MOST_FILES = 2000
_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,99}")


class UploadError(MorphgenError):
    """A file that is no robot, or none that is taken from strangers."""


def keep(name: str, content: bytes, places: Places) -> str:
    """Keep an upload.

    Args:
        name: Of the file.
        content: All of it.
        places: Where uploads are kept.

    Returns:
        The place of the robot.

    Raises:
        UploadError: If it is too large, no URDF and no zip of one, or names a path outside of its
            folder.
    """
    if len(content) > LARGEST:
        raise UploadError(
            f"{name}: {len(content) / 2**20:.0f} MB; at most {LARGEST // 2**20} MB are taken: open "
            "it on this machine instead, with morphgen view"
        )
    file = PurePosixPath(name.replace("\\", "/")).name
    if not _NAME.fullmatch(file):
        raise UploadError(f"{name!r} is no file name that can be kept: use letters, digits and '.'")
    suffix = PurePosixPath(file).suffix.lower()
    if suffix not in (".urdf", ".zip"):
        raise UploadError(f"{file}: expected a .urdf, or a .zip of a folder with one")
    files = _unpacked(file, content) if suffix == ".zip" else {file: content}
    main = _main_file(file, files)
    for path, data in files.items():
        if path.endswith(".urdf"):
            _require_own_meshes(path, data)
    folder = places.uploads / secrets.token_hex(4)
    for path, data in files.items():
        target = folder / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)
    is_bundle = PurePosixPath(main).name == URDF and str(PurePosixPath(main).parent / CARD) in files
    shown = str(PurePosixPath(main).parent) if is_bundle else main
    return f"{UPLOAD}{folder.name}/{shown}".removesuffix("/.")


def _unpacked(name: str, content: bytes) -> dict[str, bytes]:
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [entry for entry in archive.infolist() if not entry.is_dir()]
            if len(entries) > MOST_FILES or sum(each.file_size for each in entries) > LARGEST:
                raise UploadError(
                    f"{name}: unpacks to more than {MOST_FILES} files or {LARGEST // 2**20} MB"
                )
            for entry in entries:
                _require_inside(name, entry.filename)
            return {entry.filename: archive.read(entry) for entry in entries}
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError) as error:
        raise UploadError(f"{name}: no readable zip: {error}") from error


def _main_file(name: str, files: dict[str, bytes]) -> str:
    """The URDF to show: the shortest path, so that a bundle's is before others below it."""
    found = sorted(
        (path for path in files if path.endswith(".urdf")), key=lambda p: (p.count("/"), p)
    )
    if not found:
        raise UploadError(f"{name}: holds no .urdf")
    return found[0]


def _require_own_meshes(path: str, data: bytes) -> None:
    """Require that a URDF names meshes of its own folder, or of installed packages, only."""
    root = parse_xml(data, path)
    if root.tag != "robot":
        raise UploadError(f"{path}: no URDF: its root is <{root.tag}>, not <robot>")
    for element in root.iter("mesh", "texture"):
        uri = element.get("filename", "")
        if uri.startswith("package://"):
            _require_inside(path, uri.removeprefix("package://"))
        else:
            below = PurePosixPath(path).parent / uri
            if ":" in uri:
                raise UploadError(f"{path}: {uri!r}: only relative paths and package:// are taken")
            _require_inside(path, str(below), shown=uri)


def _require_inside(name: str, path: str, shown: str = "") -> None:
    parts = path.replace("\\", "/").split("/")
    depth = 0
    for part in parts:
        depth += {"..": -1, ".": 0, "": 0}.get(part, 1)
        if depth < 0:
            break
    if path.startswith(("/", "\\")) or ":" in parts[0] or depth < 0:
        raise UploadError(f"{name}: {shown or path!r} leads out of its folder; nothing was kept")

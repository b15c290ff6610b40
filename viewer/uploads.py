"""Robots that users upload: a URDF, or a zip of a bundle, kept while the viewer runs.

Threat: whoever can open the page can upload a file made to do harm. Therefore

- a zip is read within limits of size, number of files and length of names, and rejected if a name
  leads out of its folder, is a link, or occurs twice;
- only descriptions, meshes and cards are stored, in a new folder with a random name;
- every path that they contain must stay inside that folder, so that an upload cannot make the
  viewer read, draw or send another file;
- a xacro is a program, so an upload's xacro is never expanded.

If any check fails, nothing of the upload is kept.
"""

from __future__ import annotations

import io
import json
import re
import secrets
import shutil
import zipfile
from pathlib import Path, PurePosixPath

from lxml import etree

from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import CARD, PICTURE, URDF
from morphgen.formats.resolve import PackageFinder, resolve_uri
from morphgen.formats.xml import parse_xml
from morphgen.formats.zip_files import (
    UNREADABLE,
    ZipLimits,
    require_few_entries,
    safe_entries,
    stays_inside,
)
from morphgen.model.geometry import MESH_SUFFIXES
from morphgen.viewer.messages import MAX_UPLOAD
from morphgen.viewer.robot_uri import UPLOAD, FileAccess, shorten

MAX_UPLOADS = 50
"""Uploads that a viewer keeps."""
LIMITS = ZipLimits(max_bytes=100 * 2**20, max_files=2000, max_name=100, max_depth=20)
"""Bounds on a zip."""
PACKAGE = "package.xml"
"""Marks a ROS package, which ``package://`` needs."""
_FILE_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,99}")
_MESH_PARTS = (".bin", ".jpeg", ".jpg", ".mtl", ".png")
"""Suffixes of files that meshes refer to."""
_PATH_ATTRIBUTES = (
    *("assetdir", "file", "filename", "meshdir", "texturedir"),
    *(f"file{side}" for side in ("back", "down", "front", "left", "right", "up")),
)
"""Attributes of URDF and MJCF that name files or folders."""


class UploadError(MorphgenError):
    """An upload is not a robot, or is unsafe."""


def store_upload(name: str, content: bytes, files: FileAccess) -> str:
    """Check and store an upload.

    Args:
        name: Name of the file.
        content: Content of the file.
        files: Has the folder of uploads.

    Returns:
        The URI of the robot.

    Raises:
        UploadError: If the file is too large, not a URDF or a zip of one, or unsafe.
    """
    if len(content) > MAX_UPLOAD:
        raise UploadError(
            f"{shorten(name)}: {len(content) / 2**20:.0f} MB; at most {MAX_UPLOAD // 2**20} "
            "MB are accepted: open it on this machine instead, with morphgen view"
        )
    file = PurePosixPath(name.replace("\\", "/")).name
    if not _FILE_NAME.fullmatch(file):
        raise UploadError(
            f"invalid file name: {shorten(name)!r}; use letters, digits and '.', at most 100"
        )
    suffix = PurePosixPath(file).suffix.lower()
    if suffix not in (".urdf", ".zip"):
        raise UploadError(f"{file}: expected a .urdf, or a .zip of a folder with one")
    unpacked = _unzip(file, content) if suffix == ".zip" else {file: content}
    stored = {path: data for path, data in unpacked.items() if _is_kept(path, data)}
    main_urdf = _main_urdf(file, unpacked, stored)
    for path, data in stored.items():
        _require_inner_paths(path, data)
    folder = _write_upload(stored, files.uploads)
    is_bundle = (
        PurePosixPath(main_urdf).name == URDF
        and str(PurePosixPath(main_urdf).parent / CARD) in stored
    )
    target = str(PurePosixPath(main_urdf).parent) if is_bundle else main_urdf
    return f"{UPLOAD}{folder}/{target}".removesuffix("/.")


def _unzip(name: str, content: bytes) -> dict[str, bytes]:
    """Return the files of a zip by their paths, after checking its table of contents."""
    try:
        require_few_entries(io.BytesIO(content), LIMITS)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return {path: archive.read(entry) for entry, path in safe_entries(archive, LIMITS)}
    except FormatError as error:
        raise UploadError(f"{name}: {error}; nothing was kept") from error
    except UNREADABLE as error:
        raise UploadError(
            f"{name}: not a readable zip: {shorten(str(error))}; nothing was kept"
        ) from error


def _is_kept(path: str, data: bytes) -> bool:
    """Return whether a file is a description, a mesh or part of one, a card or a package file."""
    file = PurePosixPath(path)
    if any(part.startswith((".", "__MACOSX")) for part in file.parts):
        return False
    if file.suffix == ".xml":
        return file.name == PACKAGE or _is_mjcf(data)
    return (
        file.name in (CARD, PICTURE)
        or file.suffix in (".urdf", *_MESH_PARTS)
        or file.suffix.lower() in MESH_SUFFIXES
    )


def _is_mjcf(data: bytes) -> bool:
    try:
        return bool(parse_xml(data, "").tag == "mujoco")
    except FormatError:
        return False


def _main_urdf(name: str, unpacked: dict[str, bytes], stored: dict[str, bytes]) -> str:
    """Return the URDF with the shortest path, which in a bundle is the bundle's own."""
    urdfs = [path for path in stored if path.endswith(".urdf")]
    if urdfs:
        return min(urdfs, key=lambda path: (path.count("/"), path))
    hint = ""
    if any(path.endswith(".xacro") for path in unpacked):
        hint = (
            "; no xacro of an upload is expanded: import it on this machine, with morphgen import"
        )
    raise UploadError(f"{name}: holds no .urdf{hint}")


def _require_inner_paths(path: str, data: bytes) -> None:
    """Require that a description or card names files of its own upload only."""
    file = PurePosixPath(path)
    if file.name == CARD:
        try:
            card = json.loads(data)
        except (ValueError, RecursionError) as error:
            raise UploadError(f"{path}: invalid JSON: {shorten(str(error))}") from error
        hashes = card.get("hashes") if isinstance(card, dict) else None
        for name in hashes if isinstance(hashes, dict) else ():
            _require_inner_uri(path, name)
    elif file.suffix in (".urdf", ".xml") and file.name != PACKAGE:
        root = _parse(path, data)
        if file.suffix == ".urdf":
            _require_plain_urdf(path, root)
        for element in root.iter(etree.Element):
            for key in _PATH_ATTRIBUTES:
                if uri := element.get(key):
                    _require_inner_uri(path, uri)


def _parse(path: str, data: bytes) -> etree._Element:
    try:
        return parse_xml(data, path)
    except FormatError as error:
        raise UploadError(f"{error}; nothing was kept") from error


def _require_plain_urdf(path: str, root: etree._Element) -> None:
    """Require that a description is a URDF without xacro."""
    if root.tag != "robot":
        raise UploadError(
            f"{path}: not a URDF: its root is <{shorten(str(root.tag))}>; expected <robot>"
        )
    for element in root.iter(etree.Element):
        if "xacro" in (etree.QName(element).namespace or "") or element.prefix == "xacro":
            raise UploadError(
                f"{path}:{element.sourceline}: is a xacro; none of an upload is expanded: import "
                "it on this machine, with morphgen import"
            )


def _require_inner_uri(path: str, uri: str) -> None:
    """Require that a path or ``package://`` URI in a file stays inside the upload."""
    name = uri.removeprefix("package://")
    if ":" in name:
        raise UploadError(
            f"{path}: {shorten(uri)!r}: only relative paths and package:// are accepted"
        )
    joined = name if name != uri else str(PurePosixPath(path).parent / name)
    if name.startswith(("/", "\\")) or not stays_inside(joined):
        raise UploadError(f"{path}: {shorten(uri)!r} leads out of its folder; nothing was kept")


def _write_upload(files: dict[str, bytes], uploads: Path) -> str:
    """Write an upload into a new folder, or nothing; return the folder's name."""
    if sum(1 for _ in uploads.iterdir()) >= MAX_UPLOADS:
        raise UploadError(f"{MAX_UPLOADS} uploads are kept already; start the viewer again")
    folder = uploads / secrets.token_hex(16)  # cannot be guessed by other users of the viewer
    try:
        for path, data in files.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        for path, data in files.items():
            if path.endswith(".urdf"):
                _require_inner_meshes(folder, path, data)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError):
            raise UploadError(f"the upload cannot be kept: {error.strerror}") from error
        raise
    return folder.name


def _require_inner_meshes(folder: Path, path: str, data: bytes) -> None:
    """Require that every mesh of a URDF exists in its upload.

    Checked by the function that later reads the meshes, after the text of each path has been
    checked: it also decodes escapes (``%2f``) and finds packages elsewhere on this machine.
    """
    for element in _parse(path, data).iter("mesh"):
        uri = element.get("filename", "")
        try:
            mesh = resolve_uri(uri, folder / path, PackageFinder())
        except FormatError:
            mesh = None
        if mesh is None or not mesh.resolve().is_relative_to(folder):
            raise UploadError(
                f"{path}:{element.sourceline}: mesh {shorten(uri)!r} is not in the upload: send "
                "a zip of the folder with its meshes; nothing was kept"
            )

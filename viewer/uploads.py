"""Robots that users send: a URDF, or a zip of a bundle, kept while the viewer runs.

Of an upload only descriptions, meshes and cards are kept, and nothing of it may lie, or point,
outside of its own folder. A xacro is a program, so none of an upload is expanded.
"""

from __future__ import annotations

import json
import re
import secrets
import shutil
from pathlib import Path, PurePosixPath

from lxml import etree

from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import CARD, PICTURE, URDF
from morphgen.formats.resolve import PackageFinder, resolve_uri
from morphgen.formats.xml import parse_xml
from morphgen.model.geometry import MESH_SUFFIXES
from morphgen.viewer.archives import ArchiveError, is_inside, unpacked
from morphgen.viewer.messages import LARGEST_UPLOAD
from morphgen.viewer.robot_uri import UPLOAD, FileAccess, shortened

MOST_KEPT = 50
"""Uploads that a viewer keeps."""
PACKAGE = "package.xml"
"""Names a ROS package, which ``package://`` needs."""
_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,99}")
_MESH_PARTS = (".bin", ".jpeg", ".jpg", ".mtl", ".png")
"""What meshes consist of, besides themselves."""
_PATHS = (
    "assetdir",
    "file",
    "fileback",
    "filedown",
    "filefront",
    "fileleft",
    "filename",
    "fileright",
    "fileup",
    "meshdir",
    "texturedir",
)
"""Attributes of URDF and MJCF that name files or folders."""


class UploadError(MorphgenError):
    """A file that is no robot, or none that is taken from strangers."""


def keep(name: str, content: bytes, places: FileAccess) -> str:
    """Keep an upload.

    Args:
        name: Of the file.
        content: All of it.
        places: Where uploads are kept.

    Returns:
        The place of the robot.

    Raises:
        UploadError: If it is too large, no URDF and no zip of one, or names a path outside of its
            folder; then nothing is kept.
    """
    if len(content) > LARGEST_UPLOAD:
        raise UploadError(
            f"{shortened(name)}: {len(content) / 2**20:.0f} MB; at most {LARGEST_UPLOAD // 2**20} "
            "MB are taken: open it on this machine instead, with morphgen view"
        )
    file = PurePosixPath(name.replace("\\", "/")).name
    if not _NAME.fullmatch(file):
        raise UploadError(
            f"{shortened(name)!r} is no file name that can be kept: use letters, digits and '.', "
            "at most 100"
        )
    suffix = PurePosixPath(file).suffix.lower()
    if suffix not in (".urdf", ".zip"):
        raise UploadError(f"{file}: expected a .urdf, or a .zip of a folder with one")
    try:
        every = unpacked(file, content) if suffix == ".zip" else {file: content}
    except ArchiveError as error:
        raise UploadError(f"{error}; nothing was kept") from error
    files = {path: data for path, data in every.items() if _is_kept(path, data)}
    main = _main_file(file, every, files)
    for path, data in files.items():
        _require_own_paths(path, data)
    token = _written(files, places.uploads)
    is_bundle = PurePosixPath(main).name == URDF and str(PurePosixPath(main).parent / CARD) in files
    shown = str(PurePosixPath(main).parent) if is_bundle else main
    return f"{UPLOAD}{token}/{shown}".removesuffix("/.")


def _is_kept(path: str, data: bytes) -> bool:
    """Whether a file is a description, a mesh, a card or the name of a package."""
    file = PurePosixPath(path)
    if any(part.startswith((".", "__MACOSX")) for part in file.parts):
        return False
    if file.suffix == ".xml":
        return file.name == PACKAGE or _is_mjcf(data)
    suffixes = (".urdf", *_MESH_PARTS)
    return file.name in (CARD, PICTURE) or file.suffix in suffixes or _is_mesh(file)


def _is_mjcf(data: bytes) -> bool:
    try:
        return bool(parse_xml(data, "").tag == "mujoco")
    except FormatError:
        return False


def _is_mesh(file: PurePosixPath) -> bool:
    return file.suffix.lower() in MESH_SUFFIXES


def _main_file(name: str, every: dict[str, bytes], files: dict[str, bytes]) -> str:
    """The URDF to show: the shortest path, so that a bundle's is before others below it."""
    found = sorted(
        (path for path in files if path.endswith(".urdf")), key=lambda p: (p.count("/"), p)
    )
    if found:
        return found[0]
    hint = ""
    if any(path.endswith(".xacro") for path in every):
        hint = (
            "; no xacro of an upload is expanded: import it on this machine, with morphgen import"
        )
    raise UploadError(f"{name}: holds no .urdf{hint}")


def _require_own_paths(path: str, data: bytes) -> None:
    """Require that a description or card names files of its own upload only."""
    file = PurePosixPath(path)
    if file.name == CARD:
        _require_own_card(path, data)
    elif file.suffix in (".urdf", ".xml") and file.name != PACKAGE:
        root = _root(path, data)
        if file.suffix == ".urdf":
            _require_plain_urdf(path, root)
        for element in root.iter(etree.Element):
            for key in _PATHS:
                if uri := element.get(key):
                    _require_own_uri(path, uri)


def _root(path: str, data: bytes) -> etree._Element:
    try:
        return parse_xml(data, path)
    except FormatError as error:
        raise UploadError(f"{error}; nothing was kept") from error


def _require_plain_urdf(path: str, root: etree._Element) -> None:
    if root.tag != "robot":
        raise UploadError(f"{path}: no URDF: its root is <{shortened(str(root.tag))}>, not <robot>")
    for element in root.iter(etree.Element):
        if "xacro" in (etree.QName(element).namespace or "") or element.prefix == "xacro":
            raise UploadError(
                f"{path}:{element.sourceline}: is a xacro; none of an upload is expanded: import "
                "it on this machine, with morphgen import"
            )


def _require_own_uri(path: str, uri: str) -> None:
    name = uri.removeprefix("package://")
    if ":" in name:
        raise UploadError(
            f"{path}: {shortened(uri)!r}: only relative paths and package:// are taken"
        )
    below = name if name != uri else str(PurePosixPath(path).parent / name)
    if name.startswith(("/", "\\")) or not is_inside(below):
        raise UploadError(f"{path}: {shortened(uri)!r} leads out of its folder; nothing was kept")


def _require_own_card(path: str, data: bytes) -> None:
    try:
        card = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise UploadError(f"{path}: no valid JSON: {shortened(str(error))}") from error
    hashes = card.get("hashes") if isinstance(card, dict) else None
    for name in hashes if isinstance(hashes, dict) else ():
        _require_own_uri(path, name)


def _written(files: dict[str, bytes], uploads: Path) -> str:
    """Write an upload into a folder of its own, or nothing; return the folder's name."""
    if sum(1 for _ in uploads.iterdir()) >= MOST_KEPT:
        raise UploadError(f"{MOST_KEPT} uploads are kept already; start the viewer again")
    folder = uploads / secrets.token_hex(16)
    try:
        for path, data in files.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        for path, data in files.items():
            if path.endswith(".urdf"):
                _require_own_meshes(folder, path, data)
    except OSError as error:
        shutil.rmtree(folder, ignore_errors=True)
        raise UploadError(f"the upload cannot be kept: {error.strerror}") from error
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder.name


def _require_own_meshes(folder: Path, path: str, data: bytes) -> None:
    """Require that every mesh of a URDF is found, and in its upload."""
    for element in _root(path, data).iter("mesh"):
        uri = element.get("filename", "")
        try:
            found = resolve_uri(uri, folder / path, PackageFinder())
        except FormatError:
            found = None
        if found is None or not found.resolve().is_relative_to(folder):
            raise UploadError(
                f"{path}:{element.sourceline}: mesh {shortened(uri)!r} is not in the upload: send "
                "a zip of the folder with its meshes; nothing was kept"
            )

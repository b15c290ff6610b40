"""Robots that users upload: a URDF, an MJCF, or a zip with one, kept while the viewer runs.

Threat: whoever can open the page can upload a file made to do harm. Therefore

- a zip is read within limits of size, number of files and length of names, and rejected if a name
  leads out of its folder, is a link, or occurs twice;
- only descriptions, meshes and cards are stored, in a new folder with a random name;
- every path that they contain must stay inside that folder, so that an upload cannot make the
  viewer read, draw or send another file;
- a xacro is a program, so an upload's xacro is never expanded; an MJCF has no plugins.

If any check fails, nothing of the upload is kept.
"""

from __future__ import annotations

import io
import posixpath
import re
import secrets
import shutil
import zipfile
from collections.abc import Collection
from pathlib import Path, PurePosixPath

from lxml import etree

from morphgen.errors import FormatError, MorphgenError
from morphgen.formats.bundle import CARD, PICTURE, URDF
from morphgen.formats.data_files import parse_json
from morphgen.formats.mjcf.document import listed
from morphgen.formats.resolve import PackageFinder, resolve_uri
from morphgen.formats.urdf.read import MAX_URDF_BYTES, UnsoundError
from morphgen.formats.xml import parse_description
from morphgen.formats.zip_files import (
    UNREADABLE,
    ZipLimits,
    require_few_entries,
    safe_entries,
    stays_inside,
)
from morphgen.model.geometry import MESH_SUFFIXES
from morphgen.viewer.robot_uri import UPLOAD, FileAccess, UriError, require_own_files, shorten

MAX_UPLOADS = 50  # uploads that a viewer keeps
LIMITS = ZipLimits(max_bytes=100 * 2**20, max_files=2000, max_name=100, max_depth=20)
"""Bounds on a zip."""
PACKAGE = "package.xml"  # marks a ROS package, which `package://` needs
_FORMATS = {"robot": "URDF", "mujoco": "MJCF", "mujocoinclude": "included MJCF"}
"""Formats of descriptions by their root element."""
_SUFFIXES = (".urdf", ".xml")  # suffixes of descriptions
_Documents = dict[str, etree._Element | FormatError]
"""Roots of descriptions by their paths, or why a file is not XML."""
_FILE_NAME = re.compile(r"[A-Za-z0-9][\w.-]{0,99}")
_MESH_PARTS = (".jpeg", ".jpg", ".mtl", ".png")  # suffixes of files that meshes refer to
_PATH_ATTRIBUTES = (
    *("assetdir", "file", "filename", "meshdir", "texturedir"),
    *(f"file{side}" for side in ("back", "down", "front", "left", "right", "up")),
)
"""Attributes of URDF and MJCF that name files or folders."""


class UploadError(MorphgenError):
    """An upload is not a robot, or is unsafe."""


def store_upload(name: str, content: bytes, files: FileAccess) -> str:
    """Check and store an upload, whose size the server has limited; return its robot's URI."""
    file = PurePosixPath(name.replace("\\", "/")).name
    if not _FILE_NAME.fullmatch(file):
        raise UploadError(
            f"invalid file name: {shorten(name)!r}; use letters, digits and '.', at most 100"
        )
    suffix = PurePosixPath(file).suffix.lower()
    if suffix not in (*_SUFFIXES, ".zip"):
        raise UploadError(
            f"{file}: expected a .urdf, an MJCF as .xml, or a .zip of a folder with one"
        )
    unpacked = _unzip(file, content) if suffix == ".zip" else {file: content}
    documents = _parse_descriptions(unpacked)
    formats = {path: _format(document) for path, document in documents.items()}
    if suffix != ".zip" and formats[file] is None:
        root = _root(documents, file)
        raise UploadError(
            f"{file}: its root is <{shorten(str(root.tag))}>; expected <robot> of a URDF, or "
            "<mujoco> of an MJCF"
        )
    main = _main_description(file, formats, documents, unpacked)
    stored = {path: data for path, data in unpacked.items() if formats.get(path) or _is_kept(path)}
    for path, data in stored.items():
        if PurePosixPath(path).name == CARD:
            _require_inner_card(path, data)
        elif formats.get(path) or PurePosixPath(path).suffix.lower() == ".urdf":
            _require_inner_paths(path, _root(documents, path), formats[path])
    roots = {path: _root(documents, path) for path in stored if formats.get(path) == "URDF"}
    mjcf = main if formats[main] == "MJCF" else None
    is_bundle = (
        PurePosixPath(main).name == URDF and str(PurePosixPath(main).parent / CARD) in stored
    )
    if is_bundle and mjcf is not None:
        raise UploadError(
            f"{main}: is the {URDF} of a bundle, but an MJCF; give it another name, or send it "
            f"without {CARD}"
        )
    folder = _write_upload(stored, roots, mjcf, files)
    target = str(PurePosixPath(main).parent) if is_bundle else main
    return f"{UPLOAD}{folder}/{target}".removesuffix("/.")


def _unzip(name: str, content: bytes) -> dict[str, bytes]:
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


def _parse_descriptions(unpacked: dict[str, bytes]) -> _Documents:
    """Parse every file that may be a description, once."""
    documents: _Documents = {}
    size = 0
    for path, data in unpacked.items():
        file = PurePosixPath(path)
        if file.suffix.lower() in _SUFFIXES and not _is_hidden(file):
            size += len(data)
            if size > MAX_URDF_BYTES:  # a tree takes thirty times the memory of its text
                raise UploadError(
                    f"{path}: the descriptions have more than {MAX_URDF_BYTES // 2**20} MB "
                    "together; leave out files that the robot does not need; nothing was kept"
                )
            try:
                documents[path], _ = parse_description(data, path)
            except FormatError as error:
                documents[path] = error
    return documents


def _format(document: etree._Element | FormatError) -> str | None:
    """Return the format of a description, a value of ``_FORMATS``; None for other XML."""
    return None if isinstance(document, FormatError) else _FORMATS.get(str(document.tag))


def _root(documents: _Documents, path: str) -> etree._Element:
    document = documents[path]
    if isinstance(document, FormatError):
        raise UploadError(f"{document}; nothing was kept") from document
    return document


def _is_kept(path: str) -> bool:
    """Return whether a file is a mesh or part of one, a card, a package file or a ``.urdf``."""
    file = PurePosixPath(path)
    return not _is_hidden(file) and (
        file.name in (CARD, PICTURE, PACKAGE)
        or file.suffix.lower() in (".urdf", *_MESH_PARTS, *MESH_SUFFIXES)
    )


def _is_hidden(file: PurePosixPath) -> bool:
    return any(part.startswith((".", "__MACOSX")) for part in file.parts)


def _main_description(
    name: str, formats: dict[str, str | None], documents: _Documents, unpacked: Collection[str]
) -> str:
    """Return the description to show: the URDF with the shortest path, in a bundle its own.

    Without one, it is the MJCF with the archive's name, or the only one that no other includes.
    """
    urdfs = [
        path
        for path, form in formats.items()
        if form == "URDF" or (form is None and path.lower().endswith(".urdf") and _is_kept(path))
    ]
    if urdfs:
        return min(urdfs, key=lambda path: (path.count("/"), path))
    mjcfs = {path: _root(documents, path) for path, form in formats.items() if form == "MJCF"}
    if mjcfs:
        return _main_mjcf(name, mjcfs)
    for path in documents:
        _root(documents, path)  # says why a malformed MJCF is none
    hint = ""
    if any(path.endswith(".xacro") for path in unpacked):
        hint = (
            "; no xacro of an upload is expanded: import it on this machine, with morphgen import"
        )
    raise UploadError(f"{name}: holds no .urdf and no MJCF{hint}")


def _main_mjcf(name: str, mjcfs: dict[str, etree._Element]) -> str:
    stem = PurePosixPath(name).stem
    named = [path for path in mjcfs if PurePosixPath(path).stem == stem]
    # A name is relative to the main file, which lies beside the including file or above it.
    included = {
        posixpath.normpath(folder / element.get("file", ""))
        for path, root in mjcfs.items()
        for element in root.iter("include")
        for folder in PurePosixPath(path).parents
    }
    mains = named or [path for path in mjcfs if path not in included] or [*mjcfs]
    if len(mains) > 1:
        raise UploadError(
            f"{name}: holds several MJCFs: {listed(map(shorten, sorted(mains)))}; send only one "
            "with the files that it needs, or name the zip after it"
        )
    return mains[0]


def _require_inner_card(path: str, data: bytes) -> None:
    """Require that a card names files of its own upload only."""
    try:
        card = parse_json(data.decode(errors="replace"), path)
    except FormatError as error:
        raise UploadError(shorten(str(error))) from error
    hashes = card.get("hashes") if isinstance(card, dict) else None
    for name in hashes if isinstance(hashes, dict) else ():
        _require_inner_uri(path, name)


def _require_inner_paths(path: str, root: etree._Element, form: str | None) -> None:
    """Require that a description names files of its own upload only."""
    if form in ("URDF", None):
        _require_plain_urdf(path, root)
    for element in root.iter(etree.Element):
        for key in _PATH_ATTRIBUTES:
            if uri := element.get(key):
                _require_inner_uri(path, uri)


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


def _write_upload(
    stored: dict[str, bytes], urdfs: dict[str, etree._Element], mjcf: str | None, files: FileAccess
) -> str:
    """Write an upload into a new folder, or nothing; return the folder's name."""
    if sum(1 for _ in files.uploads.iterdir()) >= MAX_UPLOADS:
        raise UploadError(f"{MAX_UPLOADS} uploads are kept already; start the viewer again")
    folder = files.uploads / secrets.token_hex(16)  # cannot be guessed by other users of the viewer
    try:
        for path, data in stored.items():
            target = folder / path
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(data)
        for path, root in urdfs.items():
            _require_inner_meshes(folder, path, root)
        if mjcf is not None:
            _require_inner_files(folder, mjcf, files)
    except BaseException as error:
        shutil.rmtree(folder, ignore_errors=True)
        if isinstance(error, OSError):
            raise UploadError(f"the upload cannot be kept: {error.strerror}") from error
        raise
    return folder.name


def _require_inner_files(folder: Path, path: str, files: FileAccess) -> None:
    """Require that every mesh and include of an MJCF exists in its upload."""
    try:
        require_own_files(folder / path, folder)
    except UnsoundError as error:
        names = [finding.where.removeprefix(f"{folder / path}: ") for finding in error.findings]
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        raise UploadError(
            f"{path}: {shorten(', '.join(names[:5]), 300)}{more}: not in the upload: send a zip of "
            "the folder with its meshes; nothing was kept"
        ) from error
    except (FormatError, UriError) as error:
        text = files.redact(str(error).replace(f"{folder}/", ""))
        raise UploadError(f"{text}; nothing was kept") from error


def _require_inner_meshes(folder: Path, path: str, root: etree._Element) -> None:
    """Require that every mesh of a URDF exists in its upload.

    Checked by the function that later reads the meshes, after the text of each path has been
    checked: it also decodes escapes (``%2f``) and finds packages elsewhere on this machine.
    """
    for element in root.iter("mesh"):
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

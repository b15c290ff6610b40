"""Read mesh files from untrusted sources: STL and OBJ here, COLLADA by ``scene_files``.

Every count in a file is compared with the file's bytes before anything is allocated. What trimesh
would lose or misread is rewritten before it reads the file, left out with a note, or refused.
"""

from __future__ import annotations

import io
import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np
import trimesh

from morphgen.errors import MeshError
from morphgen.model import scene_files
from morphgen.model.geometry import MESH_SUFFIXES, MeshContent, MeshPart
from morphgen.typing import Array


def _parts(mesh: trimesh.Trimesh) -> list[MeshPart]:
    scene_files.require_faces(len(mesh.faces))
    return scene_files.scene_parts(trimesh.Scene(mesh))


_MAX_TOKENS = 20_000_000  # number of words in the largest OBJ file that is read
_MAX_LINE = 2**16  # length of the longest line of an OBJ file that is read [characters]


def read_mesh_file(path: Path) -> MeshContent:
    """Return the coloured triangles of a mesh file, and what was left out."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        valid = ", ".join(MESH_SUFFIXES)
        raise MeshError(f"{path}: cannot read {path.suffix!r} meshes; valid: {valid}")
    files = scene_files.FolderResolver(path.parent)
    try:
        data = files.get(path.name)
        _require_mesh(data, suffix)
        parts = _READERS[suffix](data, files)
    except scene_files.UNREADABLE as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(f"{path}: not a readable {path.suffix[1:]} mesh: {reason}") from error
    notes = [
        f"{note} ({n} times)" if n > 1 else note for note, n in Counter(files.left_out).items()
    ]
    return MeshContent(tuple(parts), tuple(notes), files.pixels, files.reads == 1)


def _require_mesh(data: bytes, suffix: str) -> None:
    """Raise ValueError with the true reason if a file is empty or no mesh of its suffix."""
    start = data[:1000].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if not data:
        raise ValueError("the file is empty")
    if start.startswith(b"version https://git-lfs"):
        raise ValueError("the file is a Git LFS pointer; run 'git lfs pull' to get the mesh")
    if start.startswith((b"<!doctype html", b"<html")):
        raise ValueError("the file is a web page; download the mesh itself")
    kinds = {
        ".dae": start.startswith(b"<") and b"<collada" in start,
        ".stl": re.match(rb"solid\b.*\s+facet\s+normal\s", start) is not None,
    }
    actual = next((kind for kind, matches in kinds.items() if matches and kind != suffix), None)
    if actual is not None and not kinds.get(suffix):
        raise ValueError(f"the file has the content of a {actual} file; rename it")


_STL_ROW = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def _read_stl(data: bytes, files: scene_files.FolderResolver) -> list[MeshPart]:
    """Read all solids of an STL file, which may have been concatenated from several."""
    if data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:1024]:
        corners = _ascii_stl(data)
    else:
        corners = _binary_stl(data, files)
    if not len(corners):
        raise ValueError("holds no triangle")
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    return _parts(trimesh.Trimesh(vertices, faces, process=False))


def _ascii_stl(data: bytes) -> Array:
    text = data.lower()
    scene_files.require_faces(text.count(b"endloop"))
    vertices = re.findall(rb"\bvertex((?:\s+[-+.\dein]\S*){3})", text)
    facets, ends = len(re.findall(rb"\bouter\s+loop\b", text)), text.count(b"endloop")
    rest = text[text.rfind(b"endloop") :].replace(b"endfacet", b"")
    is_cut = b"facet" in rest and b"endsolid" not in rest
    if is_cut or facets != ends or len(vertices) != 3 * ends:
        raise ValueError(
            f"{len(vertices)} vertices in {facets} facets, {ends} of which end; expected 3 each: "
            "it is truncated or malformed"
        )
    return scene_files.parse_numbers(b" ".join(vertices)).reshape(-1, 3, 3)


def _binary_stl(data: bytes, files: scene_files.FolderResolver) -> Array:
    solids: list[Array] = []
    start = 0
    while len(data) - start >= 84:
        (count,) = struct.unpack_from("<I", data, start + 80)
        end = start + 84 + count * _STL_ROW.itemsize
        if end > len(data) and not start:
            raise ValueError(
                f"its header counts {count} triangles, which take {end} bytes, and the file has "
                f"{len(data)}: it is truncated or not STL"
            )
        if end > len(data) or (start and not count):  # what follows is no further solid
            break
        scene_files.require_faces(sum(map(len, solids)) + count)
        solids.append(np.frombuffer(data, _STL_ROW, count, start + 84)["corners"])
        start = end
    if not solids:
        raise ValueError(f"{len(data)} bytes; a binary STL file has at least 84: it is truncated")
    if start < len(data):
        files.left_out.append(f"{len(data) - start} bytes after the last triangle")
    return np.concatenate(solids)


def _read_obj(data: bytes, files: scene_files.FolderResolver) -> list[MeshPart]:
    """Read an OBJ file by trimesh, rewritten where trimesh misreads it."""
    if data.count(b" ") + data.count(b"\t") > _MAX_TOKENS:
        raise ValueError(f"more than {_MAX_TOKENS} words")
    text = data.decode("utf-8", "replace").replace("\r\n", "\n").replace("\\\n", " ")
    _require_short_lines(text)  # first: lines are split below
    faces = re.finditer(r"^[ \t]*f[ \t]([^#\n]*)", text, re.M)
    triangles = sum(max(len(face[1].split()) - 2, 0) for face in faces)
    scene_files.require_faces(triangles)
    mixes_corners = re.search(r"^f[^\n]*//", text, re.M) and re.search(r"^f[^\n]*\d/\d", text, re.M)
    if mixes_corners or _OBJ_ODD.search(text):
        text = "\n".join(_plain_obj(text))
    vertices = text.count("\nv ") + text.startswith("v ")
    if not triangles:
        raise ValueError(f"holds {vertices} vertices and no triangle")
    for keyword, meaning in _OBJ_LEFT_OUT.items():
        if count := len(re.findall(rf"^{keyword}[ \t]", text, re.M)):
            files.left_out.append(f"{count} {meaning}")
    materials = set(re.findall(r"^usemtl +(.*?) *$", text, re.M))
    if len(materials) > scene_files.MAX_SETS or len(materials) * vertices > _MAX_WORK:
        raise ValueError(f"{len(materials)} materials for {vertices} vertices")
    libraries = re.findall(r"^[ \t]*mtllib[ \t]+(.*?)[ \t]*$", text, re.M)
    # trimesh 5.2.0 reads one library only.
    text = re.sub(r"^[ \t]*mtllib.*$", "", text, flags=re.M)
    if libraries:
        files.written["materials"] = _materials(libraries, materials, files).encode()
        text = f"mtllib materials\n{text}"
    scene = trimesh.load_scene(
        io.BytesIO(text.encode()), file_type="obj", process=False, resolver=files
    )
    parts = scene_files.scene_parts(scene)
    scene_files.note_missing(files, triangles, parts)
    return parts


_MAX_WORK = 500_000_000
"""Largest number of materials times vertices of an OBJ file; trimesh masks all for each."""
_OBJ_LEFT_OUT = {
    "l": "lines",
    "p": "points",
    "(?:curv|curv2|surf)": "free-form curves and surfaces",
}
_OBJ_ODD = re.compile(
    r"^[ \t]+[a-z]|^(?:v|vt|vn|f|usemtl)\t|^f[^\n]*#|^f[^\n]*[ /]-|^f[^\n]*[ /]0+(?![0-9])"
    r"|^f(?: +\S+){5}|^f(?: +\S+){0,2} *$",
    re.M,
)
"""Lines that trimesh skips or misreads: indented or with tabs, with comments, indices from the end
or zero, more than four or fewer than three corners."""


def _require_short_lines(text: str) -> None:
    start = -1
    while start + _MAX_LINE < len(text):
        end = text.rfind("\n", start + 1, start + 1 + _MAX_LINE)
        if end < 0:
            raise ValueError(f"a line has more than {_MAX_LINE} characters")
        start = end


def _plain_obj(text: str) -> Iterator[str]:
    """Yield the lines of an OBJ file with triangles only, their indices counted from the start."""
    counts = {"v": 0, "vt": 0, "vn": 0}
    for line in text.split("\n"):
        words = line.partition("#")[0].split()
        if words and words[0] in counts:
            counts[words[0]] += 1
        if words[:1] != ["f"]:
            yield " ".join(words)
            continue
        corners = [_plain_corner(word, counts) for word in words[1:]]
        if len({corner.count("/") for corner in corners}) > 1:
            corners = [corner.split("/")[0] for corner in corners]
        if len(corners) < 3:
            yield f"l {' '.join(corners)}"
        for k in range(1, len(corners) - 1):
            yield f"f {corners[0]} {corners[k]} {corners[k + 1]}"


def _plain_corner(word: str, counts: dict[str, int]) -> str:
    """Return a corner as ``v``, ``v/vt`` or ``v/vt/vn``, its indices counted from the first, 1."""
    indices: list[str] = []
    for kind, index in zip(counts, word.split("/"), strict=False):
        if index and (kind != "vn" or len(indices) == 2):
            number = int(index) + (counts[kind] + 1 if int(index) < 0 else 0)
            if number < 1:
                raise ValueError(f"index {word!r} of a face, after {counts[kind]} of {kind!r}")
            indices.append(str(number))
    return "/".join(indices)


def _materials(libraries: list[str], used: set[str], files: scene_files.FolderResolver) -> str:
    """Return the materials of all libraries that an OBJ file names, with readable textures only."""
    texts = []
    for line in dict.fromkeys(libraries):
        with suppress(OSError, ValueError):
            texts.append(files.get(line))  # a name may have spaces
            continue
        for name in line.split():
            try:
                texts.append(files.get(name))
            except (OSError, ValueError) as error:
                why = "no such file" if isinstance(error, FileNotFoundError) else error
                files.left_out.append(f"material file {name!r}: {why}")
    lines = []
    known: set[str] = set()
    name = ""
    for line in b"\n".join(texts).decode("utf-8", "replace").splitlines():
        key, _, value = line.strip().partition(" ")
        if key.lower() == "newmtl":
            name = " ".join(value.split())
            known.add(name)
        if key.lower() == "map_kd" and not (name in used and files.has_picture(value.strip())):
            continue
        lines.append(line.strip())
    if texts and (unknown := len(used - known)):
        files.left_out.append(f"{unknown} materials, which no material file defines")
    return "\n".join(lines)


_READERS: dict[str, Callable[[bytes, scene_files.FolderResolver], list[MeshPart]]] = {
    ".dae": scene_files.read_dae,
    ".obj": _read_obj,
    ".stl": _read_stl,
}

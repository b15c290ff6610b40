"""Read mesh files from untrusted sources: STL, OBJ and COLLADA, with bounds for all meshes.

Every count in a file is compared with the file's bytes before anything is allocated. What trimesh
would lose or misread is rewritten before it reads the file, left out with a note, or refused.

COLLADA files declare two properties of their coordinates; robot descriptions rely on the first:

* ``<unit meter="...">`` is applied. All seven visuals of the KUKA KR210 are in inches by that
  element, and only with it do they match the same links' collision STLs (mean overlap of the
  bounding boxes 0.98, without it 0.00).
* ``<up_axis>`` is ignored. Every file of rtb-data and example-robot-data that declares ``Y_UP`` and
  can be compared with another mesh of the same part matches it without a rotation: PR2 (14 visuals
  against collision STLs, mean overlap 0.94, rotated to z up 0.41), Kinova (7 against STLs, equal
  bounds), Robotiq 2F-85 (3 against ``Z_UP`` files, equal bounds), Baxter's torso (0.99, rotated
  0.14). None matches better when rotated. RViz, Pinocchio and PyBullet ignore the element too.

trimesh applies neither; it applies the transforms of the scene graph, as does this module.
"""

from __future__ import annotations

import io
import logging
import math
import re
import stat
import struct
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import collada
import numpy as np
import trimesh
from lxml import etree
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from trimesh.visual import TextureVisuals

from morphgen.errors import MALFORMED, MeshError
from morphgen.files import xml_parser
from morphgen.model.geometry import MESH_SUFFIXES, MeshContent, MeshPart, Rgba
from morphgen.typing import Array

MAX_FILE_SIZE = 64 * 2**20
"""Size of the largest mesh, texture or material file that is read, and of all such files that one
mesh names [bytes]. An STL of ``MAX_FACES`` triangles has 48 MiB."""
MAX_FACES = 1_000_000
"""Number of triangles of the largest mesh that is read, every instance counted. Reading as many
from an STL takes 0.5 GiB and 1 s of CPU (``python benchmarks/mesh_counts.py FILE``)."""
MAX_PIXELS = 2**25  # number of pixels of all textures that are read for one mesh, each use counted
MAX_COORDINATE = 1e9  # coordinate above which a mesh file counts as broken [m]
MAX_SETS = 5_000
"""Number of triangle sets in the largest scene that is read, every instance counted."""
_PICTURE_FORMATS = ("BMP", "DDS", "GIF", "JPEG", "PNG", "TGA", "TIFF", "WEBP")
"""Formats of pictures. Pillow knows others, some of which it reads by starting a program."""

UNREADABLE = (
    *MALFORMED,
    AssertionError,
    Image.DecompressionBombError,
    collada.DaeError,
    struct.error,
)
"""Exceptions that the readers raise on malformed files."""

# Without a handler, trimesh's warnings about a file would be printed on the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())


def read_picture(source: bytes | Path) -> Image.Image:
    """Return the decoded first frame of a picture."""
    try:
        with warnings.catch_warnings():  # Pillow warns on the terminal; the bound is here
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            stream = io.BytesIO(source) if isinstance(source, bytes) else source
            with Image.open(stream, formats=_PICTURE_FORMATS) as picture:
                width, height = picture.size
                if width * height > MAX_PIXELS:
                    raise ValueError(f"{width} x {height} pixels; at most {MAX_PIXELS} are read")
                picture.load()
                return picture.copy()
    except UnidentifiedImageError as error:
        raise ValueError(f"not a picture; expected {', '.join(_PICTURE_FORMATS)}") from error
    except ValueError:
        raise
    except UNREADABLE as error:
        raise ValueError(f"a broken picture: {error}") from error


class FolderResolver(trimesh.resolvers.Resolver):
    """Resolves names within a mesh file's folder only; collects what is left out of the file."""

    def __init__(self, folder: Path) -> None:
        """Restrict access to a folder and the folders below it."""
        self._folder = folder.resolve()
        self._bytes_left = 2 * MAX_FILE_SIZE
        self._pixels_left = MAX_PIXELS
        self.reads = 0  # number of files that were asked for
        self.written: dict[str, bytes] = {}
        """Content of files that exist only here, by name."""
        self.left_out: list[str] = []
        """Content that was not read, each a phrase."""

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        if name in self.written:
            return self.written[name]
        self.reads += 1
        path = (self._folder / str(name).strip().replace("\\", "/")).resolve()
        if not path.is_relative_to(self._folder):
            raise ValueError(f"{name!r} is outside the mesh's folder")
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise ValueError(f"{path.name!r} is not a regular file")
        if status.st_size > MAX_FILE_SIZE:
            raise ValueError(f"{path.name!r} holds {status.st_size} bytes; at most {MAX_FILE_SIZE}")
        self._bytes_left -= status.st_size
        if self._bytes_left < 0:
            raise ValueError(f"it names files of more than {MAX_FILE_SIZE} bytes")
        return path.read_bytes()

    def has_picture(self, name: str) -> bool:
        """Return whether a texture can be read; if not, note it as left out."""
        try:
            if self._pixels_left >= 0:  # otherwise not even decoded
                width, height = read_picture(self.get(name)).size
                self._pixels_left -= width * height
            if self._pixels_left < 0:
                raise ValueError(f"the textures have more than {MAX_PIXELS} pixels")
        except (OSError, LookupError, TypeError, ValueError) as error:
            why = "no such file" if isinstance(error, FileNotFoundError) else error
            self.left_out.append(f"texture {name!r}: {why}")
        else:
            return True
        return False

    @property
    def pixels(self) -> int:
        """Number of pixels of the textures that were read, each use counted."""
        return MAX_PIXELS - self._pixels_left

    def keys(self) -> list[str]:
        """Return no names, so that trimesh reads only the files that the mesh names."""
        return []

    def namespaced(self, namespace: str) -> FolderResolver:
        """Return this resolver, so that trimesh does not search other folders."""
        del namespace
        return self

    def write(self, name: str, data: bytes) -> None:
        """Refuse to write."""
        del data
        raise ValueError(f"{name!r} is not written")


def require_faces(count: int) -> None:
    """Require at most ``MAX_FACES`` triangles."""
    if count > MAX_FACES:
        raise ValueError(f"{count} triangles; at most {MAX_FACES} are read")


def require_sets(count: int) -> None:
    """Require at most ``MAX_SETS`` sets of triangles."""
    if count > MAX_SETS:
        raise ValueError(f"{count} sets of triangles; at most {MAX_SETS} are read")


def parse_numbers(text: bytes | str, dtype: type = np.float64) -> NDArray[Any]:
    """Return the numbers in a text, separated by white space."""
    with warnings.catch_warnings():  # NumPy warns and returns what it has read so far
        warnings.simplefilter("error", DeprecationWarning)
        try:
            return np.fromstring(text, dtype=dtype, sep=" ") if text.strip() else np.empty(0, dtype)
        except DeprecationWarning as error:
            raise ValueError("a number is malformed") from error


def scene_parts(scene: trimesh.Scene) -> list[MeshPart]:
    """Return the colour and the triangles of every geometry of a scene, in the scene frame."""
    return [
        MeshPart(_colour(geometry), *_in_scene(geometry, T_scene_node))
        for T_scene_node, name in (scene.graph[node] for node in scene.graph.nodes_geometry)
        if isinstance(geometry := scene.geometry[name], trimesh.Trimesh)
    ]


def count_triangles(parts: list[MeshPart]) -> int:
    """Return the number of triangles of all parts."""
    return sum(len(part.faces) for part in parts)


def note_missing(files: FolderResolver, expected: int, parts: list[MeshPart]) -> None:
    """Note how many of the triangles that a file holds were not read."""
    if (missing := expected - count_triangles(parts)) > 0:
        files.left_out.append(f"{missing} of {expected} triangles, which are malformed")


def _in_scene(geometry: trimesh.Trimesh, T_scene_node: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return a geometry's vertices in the scene frame [m], and faces oriented outwards."""
    faces = np.asarray(geometry.faces)
    if geometry.vertices.shape[1:] != (3,) or faces.shape[1:] != (3,):
        raise ValueError(f"vertices are {geometry.vertices.shape}, faces {faces.shape}")
    if faces.size and faces.min() < 0:
        raise ValueError(f"vertex index {faces.min()}")
    unit = geometry.metadata.get("units", "meters")
    metres_per_unit = float(trimesh.units.unit_conversion(unit, "meters"))
    vertices = trimesh.transform_points(geometry.vertices, T_scene_node) * metres_per_unit
    if not np.isfinite(vertices[faces]).all():
        raise ValueError("a vertex is not finite")
    if np.abs(vertices[faces]).max(initial=0.0) > MAX_COORDINATE:
        raise ValueError(f"a vertex is beyond {MAX_COORDINATE:g} m")
    mirrored = np.linalg.det(T_scene_node[:3, :3]) < 0
    return vertices, faces[:, ::-1] if mirrored else faces


def _colour(geometry: trimesh.Trimesh) -> Rgba | None:
    """Return a geometry's mean colour, rounded to 8 bits; None if it has none."""
    visual = geometry.visual
    if visual is None or not visual.defined:
        return None
    if isinstance(visual, TextureVisuals):
        material = visual.material
        image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
        if visual.uv is None or image is None:
            rgba = np.array(material.main_color, dtype=np.float64)
        else:
            rgba = np.mean(material.to_color(visual.uv), axis=0)
        if (opacity := _opacity(getattr(material, "kwargs", {}))) is not None:
            rgba[3] *= opacity
    else:
        rgba = np.mean(visual.vertex_colors, axis=0)
    red, green, blue, alpha = (round(float(channel)) / 255 for channel in rgba)
    return (red, green, blue, alpha)


def _opacity(properties: dict[str, Any]) -> float | None:
    """Return the opacity that the properties ``d`` or ``Tr`` of an MTL material give, in [0, 1].

    ``Tr`` is the transparency, but MeshLab writes ``Tr 1`` for opaque materials.
    """
    for key in ("d", "tr"):
        for word in properties.get(key, ()):
            try:
                value = float(word)
            except ValueError:
                continue  # "d -halo 0.5"
            if math.isfinite(value):
                return min(max(value if key == "d" or value == 1 else 1 - value, 0.0), 1.0)
    return None


_MAX_NODES = 20_000  # number of nodes of the largest scene that is read, every instance counted
_MAX_DEPTH = 100  # largest nesting depth of nodes in a scene
MAX_DAE_SIZE = 40 * 2**20
"""Size of the largest DAE file: its numbers as text take twenty times their bytes [bytes]."""
_MAX_MARKUP = 500_000
"""Number of elements and attributes in the largest scene that is read."""
_XML_ENCODINGS = ("ascii", "iso-8859-1", "latin1", "us-ascii", "utf-8", "utf8", "windows-1252")
_COLLADA_PARTS = {
    *("asset", "scene", "library_effects", "library_geometries", "library_images"),
    *("library_materials", "library_nodes", "library_visual_scenes"),
}
_COLLADA_PRIMITIVES = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_COLLADA_LOST = {
    "lines": "line sets",
    "linestrips": "line strips",
    "convex_mesh": "convex meshes",
    "spline": "splines",
    "ph": "polygons with holes",
    "instance_controller": "skins or morph targets",
}


def read_dae(data: bytes, files: FolderResolver) -> list[MeshPart]:
    """Read a COLLADA file by trimesh, with readable textures only."""
    root = _collada(data)
    for element in [*root]:
        if _tag(element) not in _COLLADA_PARTS:
            root.remove(element)
    for tag in ("extra", "instance_camera", "instance_light", "Name_array", "IDREF_array"):
        _remove(root, tag)
    for tag, meaning in _COLLADA_LOST.items():
        if count := _remove(root, tag):
            files.left_out.append(f"{count} {meaning}")
    _check_textures(root, files)
    triangles = _collada_triangles(root, files)
    if not triangles:
        raise ValueError("its scene holds no triangle")
    try:
        parts = _collada_parts(root, files)
    except UNREADABLE:
        parts = []
    if count_triangles(parts) < triangles and _remove(root, "bind_material"):
        # pycollada drops a geometry whose material is broken.
        plain = _collada_parts(root, files)
        if count_triangles(plain) > count_triangles(parts):
            files.left_out.append("materials, of which one is broken")
            parts = plain
    note_missing(files, triangles, parts)
    return parts


def _collada_parts(root: etree._Element, files: FolderResolver) -> list[MeshPart]:
    document = io.BytesIO(etree.tostring(root))
    return scene_parts(trimesh.load_scene(document, file_type="dae", process=False, resolver=files))


def _collada(data: bytes) -> etree._Element:
    if len(data) > MAX_DAE_SIZE:
        raise ValueError(f"it holds {len(data)} bytes; at most {MAX_DAE_SIZE} of a .dae are read")
    # An encoding such as UTF-7 could hide a DOCTYPE or millions of elements.
    declared = re.match(rb"""[^<]*<\?xml[^>]*encoding\s*=\s*["']([^"'>]*)""", data[:1000])
    encoding = declared[1].decode("latin-1").lower() if declared else "utf-8"
    if encoding not in _XML_ENCODINGS or b"\0" in data:
        raise ValueError(f"encoding {encoding!r} or zero bytes; expected UTF-8")
    # Without a DOCTYPE no entity can be defined.
    if b"<!DOCTYPE" in data:
        raise ValueError("has a DOCTYPE; a mesh needs none, remove it")
    if data.count(b"<") + data.count(b"=") > _MAX_MARKUP:
        raise ValueError(f"more than {_MAX_MARKUP} elements and attributes")
    # Coordinate arrays exceed libxml2's default limit on text.
    return etree.fromstring(data, xml_parser(huge_tree=True))


def _tag(element: etree._Element) -> str:
    return etree.QName(element).localname


def _remove(root: etree._Element, tag: str) -> int:
    elements = [*root.iter(f"{{*}}{tag}")]
    for element in elements:
        if (parent := element.getparent()) is not None:
            parent.remove(element)
    return len(elements)


def _check_textures(root: etree._Element, files: FolderResolver) -> None:
    """Let materials whose diffuse texture cannot be read have no colour."""
    images = {i.get("id"): (i.findtext(".//{*}init_from") or "") for i in root.iter("{*}image")}
    broken = set()
    for effect in root.iter("{*}effect"):
        texture = effect.find(".//{*}diffuse/{*}texture")
        if texture is None:
            continue
        params = {
            param.get("sid"): (
                param.findtext("{*}surface/{*}init_from")
                or param.findtext("{*}sampler2D/{*}source")
                or ""
            ).strip()
            for param in effect.iter("{*}newparam")
        }
        name = texture.get("texture", "")
        for _ in range(2):  # a sampler names a surface, which names the picture
            name = params.get(name, name)
        file = images.get(name, "").strip()
        if name not in images:
            files.left_out.append(f"texture {name!r}, which the file does not define")
        if name not in images or not files.has_picture(file):
            broken.add(f"#{effect.get('id')}")
    faulty = {
        f"#{material.get('id')}"
        for material in root.iter("{*}material")
        for instance in material.iterchildren("{*}instance_effect")
        if instance.get("url") in broken
    }
    for binding in [*root.iter("{*}instance_material")]:
        parent = binding.getparent()
        if binding.get("target") in faulty and parent is not None:
            parent.remove(binding)


def _shown_scenes(root: etree._Element, files: FolderResolver) -> list[etree._Element]:
    shown = {instance.get("url") for instance in root.iter("{*}instance_visual_scene")}
    scenes = [*root.iter("{*}visual_scene")]
    hidden = [scene for scene in scenes if shown and f"#{scene.get('id')}" not in shown]
    files.left_out += ["a scene that is not shown"] * len(hidden)
    return [scene for scene in scenes if scene not in hidden]


def _collada_triangles(root: etree._Element, files: FolderResolver) -> int:
    """Return the number of triangles in the scene, counted as by a reader that copies instances."""
    sizes = {
        f"#{geometry.get('id')}": sum(
            map(_primitive_size, geometry.iter(*_PRIMITIVE_TAGS)), Counter()
        )
        for geometry in root.iter("{*}geometry")
    }
    nodes = {f"#{node.get('id')}": node for node in root.iter("{*}node")}
    lost: Counter[str] = Counter()

    def below(node: etree._Element, depth: int) -> Counter[str]:
        if depth > _MAX_DEPTH:
            raise ValueError(f"its nodes are nested deeper than {_MAX_DEPTH} levels")
        total = Counter(nodes=1)
        for child in node.iterchildren("{*}node", "{*}instance_node", "{*}instance_geometry"):
            url = child.get("url", "")
            if _tag(child) == "node":
                total += below(child, depth + 1)
            elif url in nodes and _tag(child) == "instance_node":
                if url not in sizes:
                    sizes[url] = below(nodes[url], depth + 1)
                total += sizes[url]
            else:
                total += sizes.get(url, Counter())
                lost[url] += url not in sizes
        return total

    total: Counter[str] = Counter()
    for scene in _shown_scenes(root, files):
        for node in scene.iterchildren("{*}node"):
            total += below(node, 0)
    if total["nodes"] > _MAX_NODES:
        raise ValueError(f"its scene has {total['nodes']} nodes; at most {_MAX_NODES} are read")
    require_faces(total["triangles"])
    require_sets(total["sets"])
    files.left_out += [
        f"{count} instances of {url!r}, which the file does not define"
        for url, count in lost.items()
        if count
    ]
    return total["triangles"]


_PRIMITIVE_TAGS = tuple(f"{{*}}{tag}" for tag in _COLLADA_PRIMITIVES)


def _primitive_size(primitive: etree._Element) -> Counter[str]:
    """Return the number of triangles of a primitive, and 1 as the number of their sets."""
    if _tag(primitive) == "polylist":
        corners = parse_numbers(primitive.findtext("{*}vcount") or "", np.int32).astype(np.int64)
        if (corners < 0).any():
            raise ValueError("a polygon with a negative number of corners")
    else:
        offsets = [int(i.get("offset", "0")) for i in primitive.iterchildren("{*}input")]
        texts = (indices.text or "" for indices in primitive.iterchildren("{*}p"))
        counts = [len(parse_numbers(text, np.int32)) for text in texts]
        corners = np.array(counts, np.int64) // (max(offsets, default=0) + 1)
    triangles = corners // 3 if _tag(primitive) == "triangles" else np.maximum(corners - 2, 0)
    return Counter(triangles=int(triangles.sum()), sets=1)


_MAX_TOKENS = 20_000_000  # number of words in the largest OBJ file that is read
_MAX_LINE = 2**16  # length of the longest line of an OBJ file that is read [characters]


def read_mesh_file(path: Path) -> MeshContent:
    """Return the coloured triangles of a mesh file, and what was left out."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        valid = ", ".join(MESH_SUFFIXES)
        raise MeshError(f"{path}: cannot read {path.suffix!r} meshes; valid: {valid}")
    files = FolderResolver(path.parent)
    try:
        data = files.get(path.name)
        _require_mesh(data, suffix)
        parts = _READERS[suffix](data, files)
    except UNREADABLE as error:
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


def _read_stl(data: bytes, files: FolderResolver) -> list[MeshPart]:
    """Read all solids of an STL file, which may have been concatenated from several."""
    if data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:1024]:
        corners = _ascii_stl(data)
    else:
        corners = _binary_stl(data, files)
    if not len(corners):
        raise ValueError("holds no triangle")
    vertices = corners.reshape(-1, 3)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    return scene_parts(trimesh.Scene(trimesh.Trimesh(vertices, faces, process=False)))


def _ascii_stl(data: bytes) -> Array:
    text = data.lower()
    require_faces(text.count(b"endloop"))
    vertices = re.findall(rb"\bvertex((?:\s+[-+.\dein]\S*){3})", text)
    facets, ends = len(re.findall(rb"\bouter\s+loop\b", text)), text.count(b"endloop")
    rest = text[text.rfind(b"endloop") :].replace(b"endfacet", b"")
    is_cut = b"facet" in rest and b"endsolid" not in rest
    if is_cut or facets != ends or len(vertices) != 3 * ends:
        raise ValueError(
            f"{len(vertices)} vertices in {facets} facets, {ends} of which end; expected 3 each: "
            "it is truncated or malformed"
        )
    return parse_numbers(b" ".join(vertices)).reshape(-1, 3, 3)


def _binary_stl(data: bytes, files: FolderResolver) -> Array:
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
        require_faces(sum(map(len, solids)) + count)
        solids.append(np.frombuffer(data, _STL_ROW, count, start + 84)["corners"])
        start = end
    if not solids:
        raise ValueError(f"{len(data)} bytes; a binary STL file has at least 84: it is truncated")
    if start < len(data):
        files.left_out.append(f"{len(data) - start} bytes after the last triangle")
    return np.concatenate(solids)


def _read_obj(data: bytes, files: FolderResolver) -> list[MeshPart]:
    """Read an OBJ file by trimesh, rewritten where trimesh misreads it."""
    if data.count(b" ") + data.count(b"\t") > _MAX_TOKENS:
        raise ValueError(f"more than {_MAX_TOKENS} words")
    text = data.decode("utf-8", "replace").replace("\r\n", "\n").replace("\\\n", " ")
    _require_short_lines(text)  # first: lines are split below
    faces = re.finditer(r"^[ \t]*f[ \t]([^#\n]*)", text, re.M)
    triangles = sum(max(len(face[1].split()) - 2, 0) for face in faces)
    require_faces(triangles)
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
    if len(materials) > MAX_SETS or len(materials) * vertices > _MAX_WORK:
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
    parts = scene_parts(scene)
    note_missing(files, triangles, parts)
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


def _materials(libraries: list[str], used: set[str], files: FolderResolver) -> str:
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


_READERS: dict[str, Callable[[bytes, FolderResolver], list[MeshPart]]] = {
    ".dae": read_dae,
    ".obj": _read_obj,
    ".stl": _read_stl,
}

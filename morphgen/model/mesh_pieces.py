"""Triangles with a colour, the files that they come from, and the bounds of both."""

from __future__ import annotations

import io
import logging
import math
import stat
import struct
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import collada
import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from trimesh.visual import TextureVisuals

from morphgen.model.geometry import Rgba
from morphgen.typing import Array

MAX_FILE_SIZE = 64 * 2**20
"""Size of the largest mesh, texture or material file that is read, and of all such files that one
mesh names [bytes]. An STL of ``MAX_FACES`` triangles has 48 MiB."""
MAX_FACES = 1_000_000
"""Number of triangles of the largest mesh that is read, every instance counted. Reading as many
from an STL takes 0.5 GiB and 1 s of CPU (``python benchmarks/mesh_counts.py FILE``); text takes
longer, an ASCII PLY of the largest size 8 s."""
MAX_PIXELS = 2**25
"""Number of pixels of all textures that are read for one mesh, each use counted."""
MAX_COORDINATE = 1e9
"""Coordinate above which a mesh file counts as broken [m]."""
MAX_SETS = 5_000
"""Number of triangle sets in the largest scene that is read, every instance counted."""
_PICTURE_FORMATS = ("BMP", "DDS", "GIF", "JPEG", "PNG", "TGA", "TIFF", "WEBP")
"""Formats of pictures. Pillow knows others, some of which it reads by starting a program."""

UNREADABLE = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    Image.DecompressionBombError,
    LookupError,
    MemoryError,
    NameError,
    OSError,
    RuntimeError,
    SyntaxError,
    TypeError,
    ValueError,
    collada.DaeError,
    struct.error,
)
"""Exceptions that the readers raise on malformed files."""

# Without a handler, trimesh's warnings about a file would be printed on the terminal.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

Piece = tuple[Rgba | None, tuple[Array, NDArray[np.int64]]]
"""A colour, vertices (n, 3) [m] and faces (m, 3)."""


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
    except (
        *(OSError, SyntaxError, LookupError, ArithmeticError, RuntimeError, TypeError, MemoryError),
        *(struct.error, Image.DecompressionBombError),
    ) as error:
        raise ValueError(f"a broken picture: {error}") from error


class FolderResolver(trimesh.resolvers.Resolver):
    """Resolves the file names in a mesh file, within the mesh's own folder only.

    It also collects what a reader leaves out of the file.
    """

    def __init__(self, folder: Path) -> None:
        """Restrict access to a folder and the folders below it."""
        self._folder = folder.resolve()
        self._bytes_left = 2 * MAX_FILE_SIZE
        self._pixels_left = MAX_PIXELS
        self.written: dict[str, bytes] = {}
        """Content of files that exist only here, by name."""
        self.left_out: list[str] = []
        """Content that was not read, each a phrase."""

    def get(self, name: str) -> bytes:
        """Return the content of a file."""
        if name in self.written:
            return self.written[name]
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

    def has_picture(self, name: str, read: Callable[[], bytes] | None = None) -> bool:
        """Return whether a texture can be read; if not, note it as left out."""
        try:
            if self._pixels_left >= 0:  # otherwise not even decoded
                width, height = read_picture(read() if read else self.get(name)).size
                self._pixels_left -= width * height
            if self._pixels_left < 0:
                raise ValueError(f"the textures have more than {MAX_PIXELS} pixels")
        except FileNotFoundError:
            self.left_out.append(f"texture {name!r}: no such file")
        except (OSError, LookupError, TypeError, ValueError) as error:
            self.left_out.append(f"texture {name!r}: {error}")
        else:
            return True
        return False

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


def scene_pieces(scene: trimesh.Scene) -> list[Piece]:
    """Return the colour and the triangles of every geometry of a scene, in the scene frame."""
    return [
        (_colour(geometry), _in_scene(geometry, T_scene_node))
        for T_scene_node, name in (scene.graph[node] for node in scene.graph.nodes_geometry)
        if isinstance(geometry := scene.geometry[name], trimesh.Trimesh)
    ]


def count_triangles(pieces: list[Piece]) -> int:
    """Return the number of triangles of all pieces."""
    return sum(len(faces) for _, (_, faces) in pieces)


def note_missing(files: FolderResolver, expected: int, pieces: list[Piece]) -> None:
    """Note how many of the triangles that a file holds were not read."""
    if (missing := expected - count_triangles(pieces)) > 0:
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

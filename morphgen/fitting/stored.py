"""Fitted primitives on disk: beside every real part's manifest, by the content of its meshes.

Primitives grow with the shapes that they stand for, so they are kept for shapes at unit scale, and
serve links that are scaled as a whole.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from morphgen.errors import FormatError
from morphgen.formats.data_files import read_json
from morphgen.formats.resolve import file_stamp
from morphgen.formats.urdf_text import number
from morphgen.model.geometry import Box, Capsule, Cylinder, Geometry, Mesh, Pose, Shape, Sphere
from morphgen.model.scaling import scaled_shape

SUFFIX = ".primitives.json"
VERSION = 2
"""Rises when the fitter gives other primitives for the same meshes."""


@dataclass(frozen=True)
class StoredFit:
    """What is kept of a link's fit: of its shapes at unit scale."""

    link: str
    token: Shape
    """The one primitive that overlaps most."""
    collision: tuple[Shape, ...]
    """A few, for physics."""
    token_iou: float
    collision_iou: float

    def scaled(self, factor: float) -> StoredFit:
        """The fit of the shapes, larger or smaller."""
        return replace(
            self,
            token=scaled_shape(self.token, factor),
            collision=tuple(scaled_shape(shape, factor) for shape in self.collision),
        )


Stored = Mapping[str, StoredFit]
"""Fits by ``shapes_key``."""


def stored_fit(shapes: Sequence[Shape], stored: Stored) -> StoredFit | None:
    """What is stored for shapes, or for the same ones at another scale.

    Raises:
        FormatError: If a mesh file cannot be read.
    """
    fit = stored.get(shapes_key(shapes))
    return fit and fit.scaled(shapes_scale(shapes))


def shapes_scale(shapes: Sequence[Shape]) -> float:
    """The scale of the first mesh; 1 if it is not the same in all directions, or there is none."""
    for shape in shapes:
        if isinstance(shape.geometry, Mesh):
            x, y, z = shape.geometry.scale
            return x if x == y == z and x > 0 else 1.0
    return 1.0


def shapes_key(shapes: Sequence[Shape]) -> str:
    """A hash of shapes by their content: the same meshes at the same places, the same hash.

    Shapes that are scaled as a whole have the hash of those at unit scale.

    Raises:
        FormatError: If a mesh file cannot be read.
    """
    factor = 1 / shapes_scale(shapes)
    text = "\n".join(sorted(_shape_text(scaled_shape(shape, factor)) for shape in shapes))
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def read_stored(folders: Iterable[Path]) -> dict[str, StoredFit]:
    """All fits in folders of parts, but for those of another version of the fitter.

    Raises:
        FormatError: If a file is malformed.
    """
    found: dict[str, StoredFit] = {}
    for folder in folders:
        for path in sorted(folder.rglob(f"*{SUFFIX}")):
            found |= _read(path.absolute(), file_stamp(path))
    return found


def stored_text(fits: Mapping[str, StoredFit]) -> str:
    """The file of a part."""
    links = [
        {
            "link": fit.link,
            "shapes": key,
            "token": shape_data(fit.token),
            "token_iou": round(fit.token_iou, 4),
            "collision": [shape_data(shape) for shape in fit.collision],
            "collision_iou": round(fit.collision_iou, 4),
        }
        for key, fit in fits.items()
    ]
    lines = ",\n  ".join(json.dumps(link) for link in links)
    return f'{{"fitter": {VERSION}, "links": [\n  {lines}\n]}}\n'


def shape_data(shape: Shape) -> dict[str, object]:
    """A box, cylinder or sphere as plain data: metres, (x, y, z) and (w, x, y, z)."""
    size: dict[str, object]
    match shape.geometry:
        case Box(edges):
            size = {"box": list(edges)}
        case Cylinder(radius, length):
            size = {"cylinder": [radius, length]}
        case Sphere(radius):
            size = {"sphere": [radius]}
        case other:
            raise ValueError(f"{type(other).__name__} is no box, cylinder or sphere")
    pose = shape.T_link_shape
    return size | {"xyz": list(pose.position), "quaternion": list(pose.quaternion)}


def shape_of(data: dict[str, Any]) -> Shape:
    """The shape of plain data, see ``shape_data``.

    Raises:
        KeyError, TypeError, ValueError: If it is none.
    """
    geometry: Geometry
    (kind,) = {"box", "cylinder", "sphere"} & {*data}
    size = [float(value) for value in data[kind]]
    x, y, z = (float(value) for value in data["xyz"])
    w, a, b, c = (float(value) for value in data["quaternion"])
    finite = all(math.isfinite(value) for value in (*size, x, y, z, w, a, b, c))
    if not finite or min(size) <= 0 or not math.isclose(math.hypot(w, a, b, c), 1, rel_tol=1e-6):
        raise ValueError(f"a size or pose is out of range: {data}")
    if kind == "box":
        length, width, height = size
        geometry = Box((length, width, height))
    elif kind == "cylinder":
        geometry = Cylinder(*size)
    else:
        geometry = Sphere(*size)
    return Shape(geometry, Pose((x, y, z), (w, a, b, c)))


@lru_cache(maxsize=256)
def _read(path: Path, stamp: tuple[int, int]) -> dict[str, StoredFit]:
    """The fits of a file as it is at its stamp."""
    del stamp
    try:
        data = read_json(path)
        if data["fitter"] != VERSION:
            return {}
        return {
            link["shapes"]: StoredFit(
                link["link"],
                shape_of(link["token"]),
                tuple(shape_of(shape) for shape in link["collision"]),
                link["token_iou"],
                link["collision_iou"],
            )
            for link in data["links"]
        }
    except (KeyError, TypeError, ValueError) as error:
        raise FormatError(f"{path}: no file of fitted primitives: {error!r}") from error


def _shape_text(shape: Shape) -> str:
    pose = shape.T_link_shape
    placed = [number(value) for value in (*pose.position, *pose.quaternion)]
    return " ".join([_geometry_text(shape.geometry), *placed])


def _geometry_text(geometry: Geometry) -> str:
    match geometry:
        case Mesh(path, scale, part):
            return " ".join(["mesh", _digest(path), *(number(s) for s in scale), str(part)])
        case Box(edges):
            return " ".join(["box", *(number(edge) for edge in edges)])
        case Sphere(radius):
            return f"sphere {number(radius)}"
        case Cylinder(radius, length):
            return f"cylinder {number(radius)} {number(length)}"
        case Capsule(radius, length):
            return f"capsule {number(radius)} {number(length)}"


def _digest(path: Path) -> str:
    try:
        return _digest_of(path.absolute(), file_stamp(path))
    except OSError as error:
        raise FormatError(f"cannot read {path}: {error.strerror}") from error


@lru_cache(maxsize=1024)
def _digest_of(path: Path, stamp: tuple[int, int]) -> str:
    del stamp
    return hashlib.sha256(path.read_bytes()).hexdigest()

"""Files of fitted primitives: beside every real part's manifest, and in every bundle with meshes.

The key of a fit is a hash of the content of the fitted shapes, so that an edited mesh never gets
the fit of its predecessor. Shapes are hashed at unit scale and the primitives scaled with them, so
that one entry serves a link at any uniform scale.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from morphgen.files import cached_until_changed, content_sha256
from morphgen.formats.data_files import read_bytes, read_json
from morphgen.formats.records import FiniteNumber, PositiveNumber, Record, read_record
from morphgen.formats.rounding import format_number
from morphgen.model.geometry import (
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Pose,
    Shape,
    Sphere,
    StoredFit,
    StoredFits,
    dimensions,
    scale_shape,
)
from morphgen.model.robot import Robot

SUFFIX = ".primitives.json"  # suffix of the file of fits beside a part's manifest
FITS = "primitives.json"  # name of the file of fits in a bundle
MAX_PRIMITIVES = 32  # largest number of primitives in a link's fit
FITTER_VERSION = 2
"""Version of the fitter; it rises when stored fits of earlier ones should be made again."""

_Iou = Annotated[float, Meta(ge=0, le=1)]
"""Intersection over union of the fitted and the original volume."""


_KINDS = {Box: "box", Cylinder: "cylinder", Sphere: "sphere", Capsule: "capsule"}
"""Keys of primitives in files, with their ``dimensions`` as values."""


class ShapeRecord(Record, frozen=True):
    """A primitive as a file holds it; exactly one of the four sizes is given."""

    xyz: tuple[FiniteNumber, FiniteNumber, FiniteNumber]  # position in the link frame [m]
    quaternion: tuple[FiniteNumber, FiniteNumber, FiniteNumber, FiniteNumber]
    """Orientation in the link frame (w, x, y, z)."""
    box: tuple[PositiveNumber, PositiveNumber, PositiveNumber] | None = None  # edge lengths [m]
    cylinder: tuple[PositiveNumber, PositiveNumber] | None = None  # radius and length [m]
    sphere: tuple[PositiveNumber] | None = None  # radius [m]
    capsule: tuple[PositiveNumber, PositiveNumber] | None = None
    """Radius, and length without the caps [m]."""

    def __post_init__(self) -> None:
        if sum(getattr(self, kind) is not None for kind in _KINDS.values()) != 1:
            raise ValueError("expected one of box, cylinder, sphere and capsule")
        if not math.isclose(math.hypot(*self.quaternion), 1, rel_tol=1e-6):
            raise ValueError(f"quaternion {list(self.quaternion)} is not of unit length")

    @property
    def shape(self) -> Shape:
        """The shape that the record describes."""
        geometry: Geometry
        kind, size = next((k, size) for k, key in _KINDS.items() if (size := getattr(self, key)))
        geometry = Box(size) if kind is Box else kind(*size)
        return Shape(geometry, Pose(self.xyz, self.quaternion))


class _LinkRecord(Record, frozen=True):
    """The fit of one link in a file of fits."""

    link: str  # name of the link that was fitted
    shapes: str  # the `shapes_key` of the fitted shapes
    token: ShapeRecord  # the single primitive for the link's token
    token_iou: _Iou
    collision: Annotated[tuple[ShapeRecord, ...], Meta(min_length=1, max_length=MAX_PRIMITIVES)]
    collision_iou: _Iou

    @property
    def fit(self) -> StoredFit:
        collision = tuple(record.shape for record in self.collision)
        return StoredFit(self.link, self.token.shape, collision, self.token_iou, self.collision_iou)


class _FileRecord(Record, frozen=True):
    fitter: int  # the `FITTER_VERSION` that wrote the file
    links: list[_LinkRecord]


def stored_fit(shapes: Sequence[Shape], stored: StoredFits) -> StoredFit | None:
    """Return the stored fit of shapes, scaled to them; None if there is none."""
    fit = stored.get(shapes_key(shapes))
    return fit and fit.scaled(shapes_scale(shapes))


def find_fit(shapes: Sequence[Shape], robot: Robot, stored: StoredFits) -> StoredFit | None:
    """Return the fit of a link's collision shapes: the robot's own, or else a stored one."""
    if not shapes:
        return None
    fit = stored_fit(shapes, robot.fits)
    return stored_fit(shapes, stored) if fit is None and has_meshes(shapes) else fit


def fits_of_copies(robot: Robot, copy: Robot, stored: StoredFits) -> dict[str, StoredFit]:
    """Return the known fits of a robot's links under the keys of other meshes of the same links."""
    fits = {}
    for link in robot.links:
        if fit := find_fit(link.collisions, robot, stored):
            shapes = copy.link(link.name).collisions
            fits[shapes_key(shapes)] = replace(fit, link=link.name).scaled(1 / shapes_scale(shapes))
    return fits


def shapes_scale(shapes: Sequence[Shape]) -> float:
    """Return the scale of the first mesh; 1 if it is not uniform or there is no mesh."""
    for shape in shapes:
        if isinstance(shape.geometry, Mesh):
            x, y, z = shape.geometry.scale
            return x if x == y == z and x > 0 else 1.0
    return 1.0


def shapes_key(shapes: Sequence[Shape]) -> str:
    """Return a hash of the content and poses of shapes at unit scale."""
    factor = 1 / shapes_scale(shapes)  # links at any uniform scale share the fit
    lines = []
    for shape in (scale_shape(shape, factor) for shape in shapes):
        pose = shape.T_link_shape
        numbers = map(format_number, (*pose.position, *pose.quaternion))
        lines.append(" ".join([_geometry_text(shape.geometry), *numbers]))
    text = "\n".join(sorted(lines))  # the order of shapes does not matter
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def has_meshes(shapes: Iterable[Shape]) -> bool:
    """Return whether any shape is a mesh."""
    return any(isinstance(shape.geometry, Mesh) for shape in shapes)


def are_primitives(shapes: Iterable[Shape]) -> bool:
    """Return whether all shapes are boxes, cylinders and spheres."""
    return all(isinstance(shape.geometry, Box | Cylinder | Sphere) for shape in shapes)


def read_stored_fits(folders: Iterable[Path]) -> dict[str, StoredFit]:
    """Return all fits in folders of parts, except those of another version of the fitter."""
    return {key: record.fit for key, record in _records(folders).items()}


def _records(folders: Iterable[Path]) -> dict[str, _LinkRecord]:
    paths = (path for folder in folders for path in sorted(folder.rglob(f"*{SUFFIX}")))
    return {key: record for path in paths for key, record in _read(path).items()}


def with_stored_fits(robot: Robot, folders: Iterable[Path]) -> Robot:
    """Return the robot with the fits of its collision meshes that folders of parts contain."""
    meshed = [link.collisions for link in robot.links if has_meshes(link.collisions)]
    if not meshed:
        return robot
    stored = _records(folders)
    keys = map(shapes_key, meshed)
    return replace(robot, fits={key: stored[key].fit for key in keys if key in stored})


def read_fits(path: Path) -> dict[str, StoredFit]:
    """Return the fits of one file; none if another version of the fitter wrote it."""
    return {key: record.fit for key, record in _read(path).items()}


def fits_text(fits: Mapping[str, StoredFit]) -> str:
    """Return the text of a file of fits."""
    links = [
        {
            "link": fit.link,
            "shapes": key,
            "token": shape_to_data(fit.token),
            "token_iou": round(fit.token_iou, 4),
            "collision": [shape_to_data(shape) for shape in fit.collision],
            "collision_iou": round(fit.collision_iou, 4),
        }
        for key, fit in fits.items()
    ]
    lines = ",\n  ".join(json.dumps(link) for link in links)
    return f'{{"fitter": {FITTER_VERSION}, "links": [\n  {lines}\n]}}\n'


def shape_to_data(shape: Shape) -> dict[str, object]:
    """Return the data of a ``ShapeRecord`` for a primitive."""
    geometry, pose = shape.geometry, shape.T_link_shape
    if isinstance(geometry, Mesh):
        raise ValueError(f"mesh {geometry.path} is not a primitive")
    return {
        _KINDS[type(geometry)]: list(dimensions(geometry)),
        "xyz": list(pose.position),
        "quaternion": list(pose.quaternion),
    }


@cached_until_changed
def _read(path: Path) -> dict[str, _LinkRecord]:
    try:
        record = msgspec.json.decode(read_bytes(path), type=_FileRecord)
    except msgspec.MsgspecError:  # ten times as slow, it says what is wrong and where
        data = read_json(path)
        if isinstance(data, dict) and data.get("fitter", FITTER_VERSION) != FITTER_VERSION:
            return {}
        record = read_record(data, _FileRecord, str(path))
    is_current = record.fitter == FITTER_VERSION
    return {link.shapes: link for link in record.links} if is_current else {}


def _geometry_text(geometry: Geometry) -> str:
    if isinstance(geometry, Mesh):
        scale = map(format_number, geometry.scale)
        return " ".join(["mesh", content_sha256(geometry.path), *scale, str(geometry.part)])
    return " ".join([_KINDS[type(geometry)], *map(format_number, dimensions(geometry))])

"""The single primitive that represents each link in its token."""

from __future__ import annotations

import itertools
import json
import logging
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from platformdirs import user_cache_path

from morphgen.errors import FitError, FormatError
from morphgen.files import keep_file
from morphgen.fitting.canonical import KINDS, Kind, canonical, rounded
from morphgen.formats import fits
from morphgen.formats.data_files import read_json
from morphgen.formats.records import read_record
from morphgen.formats.rounding import rounded_shapes
from morphgen.formats.urdf.write import urdf_pieces
from morphgen.model.geometry import (
    Box,
    Cylinder,
    Pose,
    Primitive,
    Shape,
    Sphere,
    half_extents,
    map_dimensions,
    scale_shape,
    volume,
)
from morphgen.model.inertia import union_volume
from morphgen.model.robot import Robot
from morphgen.progress import report
from morphgen.typing import Array

Parameters = tuple[float, ...]
"""Parameters of a primitive in a frame [m]. Box: lower and upper side along x, then y, then z.
Cylinder along z: centre x, y, radius, lower and upper end. Sphere: centre x, y, z, radius."""

_FEW = 6  # number of primitives up to which each pair of them gives an initial candidate, too
_LOG2_POINTS, _LOG2_POINTS_OF_MANY = 11, 8
"""log2 of the number of points drawn per primitive, for links of few and of many primitives."""
_GRID = 48
"""Number of intervals of the link's extent, whose ends are tried besides faces and centres."""
_NUM_REFINED = 16  # number of initial candidates that are improved
_MAX_SWEEPS = 10  # largest number of coordinate descent sweeps over the parameters of a candidate
_NUM_UPRIGHT_FRAMES = 3  # number of frames of a link whose primitives are all along its axes
_TILTS = (20.0, 10.0, 5.0, 2.5)
"""Tilts [deg] tried on a candidate if the axes of the link's primitives differ."""
_MIN_GAIN = 0.005  # gain in IoU for which a tilted candidate is taken
_TOTAL_WEIGHT = 2**40  # the link's volume as an integer
_DECIMALS = 9  # decimals of axes and of positions of sides [m] that are compared
_LENGTH_DECIMALS = 6  # decimals of lengths in the result [m]


@dataclass(frozen=True, eq=False)
class _Link:
    """The union of a link's primitives as sample points."""

    primitives: Sequence[Shape]
    points: Array  # points inside of the union, in the link frame [m], shape (3, n)
    weights: NDArray[np.int64]
    """Volume that each point represents; the sum is ``_TOTAL_WEIGHT``, shape (n,)."""
    volume: float  # volume of the union [m^3]


@dataclass(frozen=True, eq=False)
class _Frame:
    """A link in a rotated frame with the same origin."""

    link: _Link
    R_link_frame: Array  # rotation, shape (3, 3)
    points: Array  # the link's points in this frame [m], shape (3, n)
    extents: Array
    """Lower and upper end along each axis of every primitive, of each pair if they are few, and of
    the whole link [m], shape (k, 3, 2)."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A primitive along the axes of a frame."""

    iou: float
    frame: _Frame
    kind: Kind
    parameters: Parameters


def fit_composite(shapes: Sequence[Shape]) -> Shape | None:
    """Return the box, cylinder or sphere of largest IoU with a union of boxes, cylinders, spheres.

    Its axes are those of the link or of one of the primitives. If the axes of the primitives
    differ, tilted axes are tried, too. Its pose is canonical, its lengths are rounded to 1 um. None
    if there is no volume.
    """
    primitives = [shape for shape in shapes if volume(_primitive(shape)) > 0]
    if not primitives:
        return None
    link = _sample(primitives)
    frames = [_frame(link, R) for R in _rotations(primitives)]
    starts = [
        _Candidate(_iou(frame, kind, parameters), frame, kind, parameters)
        for frame in frames
        for kind in KINDS
        for parameters in _starts(frame, kind)
    ]
    starts = sorted(starts, key=lambda start: -start.iou)[:_NUM_REFINED]
    best: dict[Kind, _Candidate] = {}
    for start in starts:
        improved = _improve(start.frame, start.kind, start.parameters)
        if improved.kind not in best or improved.iou > best[improved.kind].iou:
            best[improved.kind] = improved
    if len(frames) > _NUM_UPRIGHT_FRAMES:
        best = {kind: _tilt(candidate) for kind, candidate in best.items()}
    shape = canonical(_shape(max(best.values(), key=lambda candidate: candidate.iou)))
    pose = shape.T_link_shape
    return replace(shape, T_link_shape=replace(pose, quaternion=rounded(pose.quaternion)))


def _rotations(primitives: Sequence[Shape]) -> list[Array]:
    """Return the axes of the link and of its primitives, each axis once as z, shapes (3, 3)."""
    unique: dict[tuple[float, ...], Array] = {}
    rotations = [np.eye(3), *(shape.T_link_shape.matrix[:3, :3] for shape in primitives)]
    for R, order in itertools.product(rotations, ((0, 1, 2), (1, 2, 0), (2, 0, 1))):
        key = tuple(np.abs(R[:, order]).round(_DECIMALS).ravel().tolist())
        unique.setdefault(key, R[:, order])
    return list(unique.values())


def _frame(link: _Link, R_link_frame: Array) -> _Frame:
    extents = [_extent(shape, R_link_frame) for shape in link.primitives]
    pairs = itertools.combinations(extents, 2) if len(extents) <= _FEW else ()
    groups = [*itertools.combinations(extents, 1), *pairs, extents]
    unions = [
        np.stack([np.min(group, axis=0)[:, 0], np.max(group, axis=0)[:, 1]], axis=1)
        for group in groups
    ]
    return _Frame(link, R_link_frame, _rotate(R_link_frame.T, link.points), np.stack(unions))


def _tilt(best: _Candidate) -> _Candidate:
    """Return a clearly better candidate along tilted axes, or the same."""
    for degrees, axis, sign in itertools.product(_TILTS, range(3), (1, -1)):
        angle = sign * math.radians(degrees)
        tilt = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        # math's functions, not scipy's rotations: the same bits on every machine.
        tilt[i, i] = tilt[j, j] = math.cos(angle)
        tilt[j, i], tilt[i, j] = math.sin(angle), -math.sin(angle)
        R = _rotate(best.frame.R_link_frame, tilt)
        _, centre = _geometry(best.kind, best.parameters)
        link_centre = _rotate(best.frame.R_link_frame, np.array(centre)[:, None])
        x, y, z = (_rotate(R.T, link_centre)[:, 0] - centre).tolist()
        shift = {"box": (x, x, y, y, z, z), "cylinder": (x, y, 0, z, z), "sphere": (x, y, z, 0)}
        shifted = tuple(map(sum, zip(best.parameters, shift[best.kind], strict=True)))
        tilted = _improve(_frame(best.frame.link, R), best.kind, shifted)
        if tilted.iou > best.iou + _MIN_GAIN:
            best = tilted
    return best


def _sample(primitives: Sequence[Shape]) -> _Link:
    """Draw points in each primitive; a point inside of several primitives weighs less."""
    from scipy.stats import qmc  # takes a second to load, and most links have stored fits

    m = _LOG2_POINTS if len(primitives) <= _FEW else _LOG2_POINTS_OF_MANY
    # The sequence begins at a corner of its cells; half a cell more centres it.
    cube = 2 * qmc.Sobol(3, scramble=False).random_base2(m).T - 1 + 0.5**m
    samples, volumes = [], []
    for shape in primitives:
        geometry, T = _primitive(shape), shape.T_link_shape.matrix
        half = np.array(half_extents(geometry))[:, None]
        inside = cube[:, _inside(geometry, cube * half)] * half
        samples.append(_rotate(T[:3, :3], inside) + T[:3, 3:])
        volumes.append(np.full(inside.shape[1], volume(geometry) / inside.shape[1]))
    points = np.concatenate(samples, axis=1)
    multiplicity = np.zeros(points.shape[1])
    for shape in primitives:
        T = shape.T_link_shape.matrix
        multiplicity += _inside(_primitive(shape), _rotate(T[:3, :3].T, points - T[:3, 3:]))
    share = np.concatenate(volumes) / np.maximum(multiplicity, 1)
    weights = np.round(share / share.sum() * _TOTAL_WEIGHT).astype(np.int64)
    return _Link(primitives, points, weights, float(share.sum()))


def _starts(frame: _Frame, kind: Kind) -> Iterator[Parameters]:
    """Yield candidates around, or in, each extent of the frame."""
    for extent in frame.extents:
        (x, y, z), half = extent.mean(axis=1).tolist(), (np.ptp(extent, axis=1) / 2).tolist()
        if kind == "box":
            yield tuple(extent.ravel().tolist())
        elif kind == "cylinder":
            for radius in sorted(set(half[:2])):
                yield x, y, radius, *extent[2].tolist()
        else:
            for radius in sorted(set(half)):
                yield x, y, z, radius


def _improve(frame: _Frame, kind: Kind, parameters: Parameters) -> _Candidate:
    """Give one parameter after another its best value, until the IoU stops rising."""
    best, previous = _iou(frame, kind, parameters), -1.0
    values_of_parameters = _values(frame, kind)
    for _ in range(_MAX_SWEEPS):
        if best == previous:
            break
        previous = best
        for i, values in enumerate(values_of_parameters):
            for value in values:
                changed = (*parameters[:i], value, *parameters[i + 1 :])
                if (iou := _iou(frame, kind, changed)) > best:
                    best, parameters = iou, changed
    return _Candidate(best, frame, kind, parameters)


def _values(frame: _Frame, kind: Kind) -> list[list[float]]:
    """Return the values that each parameter may take: at faces and centres first, then a grid."""
    fractions = np.arange(1, _GRID) / _GRID
    low, high = frame.extents[-1].T
    grid = low[:, None] + (high - low)[:, None] * fractions
    sides = [_then(frame.extents[:, axis], grid[axis]) for axis in range(3)]
    if kind == "box":
        return [sides[axis] for axis in (0, 0, 1, 1, 2, 2)]
    centres = [_then(frame.extents[:, axis].mean(axis=1), grid[axis]) for axis in range(3)]
    halves = np.ptp(frame.extents, axis=2) / 2
    radii = _then(halves, halves[-1].max() * fractions)
    if kind == "cylinder":
        return [centres[0], centres[1], radii, sides[2], sides[2]]
    return [*centres, radii]


def _then(values: Array, grid: Array) -> list[float]:
    """Return each of some values once, in order, and then those of a grid."""
    return [*sorted({*values.ravel().tolist()}), *grid.tolist()]


def _iou(frame: _Frame, kind: Kind, parameters: Parameters) -> float:
    """Return the intersection over union with the link; 0 for a primitive without volume."""
    geometry, centre = _geometry(kind, parameters)
    if min(half_extents(geometry)) <= 0:
        return 0.0
    link, inside = frame.link, _inside(geometry, frame.points - np.array(centre)[:, None])
    intersection = float(link.weights[inside].sum()) / _TOTAL_WEIGHT * link.volume
    return intersection / (volume(geometry) + link.volume - intersection)


def _geometry(kind: Kind, parameters: Parameters) -> tuple[Primitive, tuple[float, ...]]:
    """Return a primitive and its centre in its frame."""
    if kind == "box":
        x, x2, y, y2, z, z2 = parameters
        return Box((x2 - x, y2 - y, z2 - z)), ((x + x2) / 2, (y + y2) / 2, (z + z2) / 2)
    if kind == "cylinder":
        x, y, radius, low, high = parameters
        return Cylinder(radius, high - low), (x, y, (low + high) / 2)
    return Sphere(parameters[3]), parameters[:3]


def _shape(candidate: _Candidate) -> Shape:
    """Return a candidate in the link frame, lengths rounded."""
    geometry, centre = _geometry(candidate.kind, candidate.parameters)
    R_link_frame = candidate.frame.R_link_frame
    T = np.eye(4)
    T[:3, :3] = R_link_frame
    position = _rotate(R_link_frame, np.array(centre)[:, None])[:, 0]
    T[:3, 3] = position.round(_LENGTH_DECIMALS) + 0.0
    rounded_geometry = map_dimensions(lambda length: round(length, _LENGTH_DECIMALS), geometry)
    return Shape(rounded_geometry, Pose.from_matrix(T))


def _primitive(shape: Shape) -> Box | Cylinder | Sphere:
    if not isinstance(shape.geometry, Box | Cylinder | Sphere):
        raise TypeError(f"{shape.geometry!r} is not a box, cylinder or sphere")
    return shape.geometry


def _inside(geometry: Primitive, points: Array) -> NDArray[np.bool_]:
    """Return which points (3, n) in the frame of a primitive are inside of it, shape (n,)."""
    x, y, z = points
    match geometry:
        case Box((a, b, c)):
            inside = (abs(x) <= a / 2) & (abs(y) <= b / 2) & (abs(z) <= c / 2)
        case Sphere(radius):
            inside = x * x + y * y + z * z <= radius * radius
        case _:
            inside = (x * x + y * y <= geometry.radius**2) & (abs(z) <= geometry.length / 2)
    return np.asarray(inside)


def _extent(shape: Shape, R_link_frame: Array) -> Array:
    """Return the lower and upper end of a primitive along the axes of a frame, shape (3, 2)."""
    T, geometry = shape.T_link_shape.matrix, _primitive(shape)
    centre = _rotate(R_link_frame.T, T[:3, 3:])[:, 0]
    cosines = np.abs(_rotate(R_link_frame.T, T[:3, :3]))  # of frame axes and primitive axes
    match geometry:
        case Box(size):
            half = _rotate(cosines, np.array(size)[:, None] / 2)[:, 0]
        case Sphere(radius):
            half = np.full(3, radius)
        case Cylinder(radius, length):
            cosine = np.minimum(cosines[:, 2], 1.0)
            half = radius * np.sqrt(1 - cosine * cosine) + length / 2 * cosine
    return np.stack([centre - half, centre + half], axis=1).round(_DECIMALS)


def _rotate(R: Array, vectors: Array) -> Array:
    """Return ``R @ vectors``, shape (3, n), in an order of operations that never changes."""
    x, y, z = vectors
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in R])


_LOGGER = logging.getLogger(__name__)
_CACHE_DIR = "tokens-5"
"""Folder in the user's cache; the number rises when the same shapes get another primitive."""
DOMINANT_SHARE = 0.95
"""Share of a link's volume from which its largest primitive represents it. The primitive lies in
the union, so this is also their intersection over union."""


def token_shapes(robot: Robot, folders: Sequence[Path] = ()) -> dict[str, Shape]:
    """Return the box, cylinder or sphere that overlaps the collision shapes of each link most.

    It comes from the first source that has one: the fits that the robot carries or the folders
    store; a primitive of the link that has most of its volume (``DOMINANT_SHARE``); the user's
    cache; a new fit, which is then cached. A fit to meshes depends on the last bits of numbers, so
    it may differ between machines. Links without collision shapes or volume have none.
    """
    stored = fits.read_stored_fits(folders)
    primitives: dict[str, Shape | None] = {}
    missing: list[tuple[str, tuple[Shape, ...], Path]] = []
    for link in robot.links:
        if not link.collisions:
            continue
        pieces = (piece for shape in link.collisions for piece in urdf_pieces(shape))
        shapes = rounded_shapes(tuple(pieces))
        if fit := fits.find_fit(link.collisions, robot, stored):
            primitives[link.name] = fit.token
        elif dominant := _dominant_primitive(shapes):
            primitives[link.name] = dominant
        else:
            path = user_cache_path("morphgen") / _CACHE_DIR / f"{fits.shapes_key(shapes)}.json"
            if path.is_file():
                primitives[link.name] = _read_cached(path, fits.shapes_scale(shapes))
            else:
                primitives[link.name] = None  # keeps the order of the links
                missing.append((link.name, shapes, path))
    if num_meshes := sum(not fits.are_primitives(shapes) for _, shapes, _ in missing):
        _LOGGER.warning(
            "fitting the primitives of tokens to %d links of robot %r; they are kept",
            num_meshes,
            robot.name,
        )
    for done, (name, shapes, path) in enumerate(missing):
        report(done, len(missing))
        primitives[name] = shape = fit_primitive(shapes)
        unit_shape = shape and scale_shape(shape, 1 / fits.shapes_scale(shapes))
        keep_file(path, json.dumps(unit_shape and fits.shape_to_data(unit_shape)), "fits")
    if missing:
        report(len(missing), len(missing))
    return {name: shape for name, shape in primitives.items() if shape}


def token_of_primitives(shapes: Sequence[Shape]) -> Shape | None:
    """Return the token's primitive of a link with primitives; None if they have no volume."""
    shapes = rounded_shapes(tuple(shapes))
    return _dominant_primitive(shapes) or fit_composite(shapes)


def fit_primitive(shapes: Sequence[Shape]) -> Shape | None:
    """Fit one primitive to shapes that are fixed to each other; None if they have no volume."""
    if fits.are_primitives(shapes):
        return fit_composite(shapes)
    # The search needs packages of the extra fit.
    from morphgen.fitting.link_fit import FitOptions, fit_shapes

    try:
        return fit_shapes(shapes, FitOptions()).primitives[0]
    except FitError:
        return None


def _dominant_primitive(shapes: Sequence[Shape]) -> Shape | None:
    """Return the canonical primitive to which a link's others add next to no volume."""
    if not fits.are_primitives(shapes):
        return None
    largest = max(shapes, key=lambda shape: union_volume([shape]))
    share = union_volume([largest]) / union_volume(shapes)
    return canonical(replace(largest, rgba=None)) if share >= DOMINANT_SHARE else None


def _read_cached(path: Path, scale: float) -> Shape | None:
    """Read a cached fit, which has the scale 1."""
    try:
        data = read_json(path)
        record = None if data is None else read_record(data, fits.ShapeRecord, str(path))
    except FormatError as error:
        raise FormatError(f"{error}; delete the file") from error
    return None if record is None else scale_shape(record.shape, scale)

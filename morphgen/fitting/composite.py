"""The one primitive for a link of several: found without chance, so the same on every machine.

Meshes are fitted by a search whose last bits depend on the processor; on links that no primitive
resembles, such as two rails, these bits decide which of many poor fits is found. What stands for
boxes, cylinders and spheres is to depend on these alone, so each number of a candidate takes its
values from a short list. The faces of the link's own primitives are among them: between two faces
the overlap of boxes along the same axes is a quotient of linear functions of where a side is, so
that it is largest at a face. Volumes are sums of whole numbers.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

from morphgen.fitting.canonical import KINDS, Kind, canonical, rounded
from morphgen.model.geometry import Box, Cylinder, Pose, Primitive, Shape, Sphere, volume
from morphgen.typing import Array

Numbers = tuple[float, ...]
"""Of a box: where its sides are, lower and upper along x, then y, then z. Of a cylinder along z:
centre x, y, radius, lower and upper end. Of a sphere: centre x, y, z, radius. Metres."""

_FEW = 6
"""Primitives, up to which any two of them are a candidate's start, too."""
_POINTS, _FEWER_POINTS = 11, 8
"""Logarithm to base 2 of the points that are drawn for each primitive, if these are few or not."""
_GRID = 48
"""Parts of a range, between which numbers are tried besides faces and centres."""
_REFINED = 16
"""How many candidates are improved."""
_SWEEPS = 10
"""Times that all numbers of a candidate are improved, at most."""
_UPRIGHT = 3
"""Frames of a link whose primitives are all along its axes."""
_TURNS = (20.0, 10.0, 5.0, 2.5)
"""By which others are turned to see whether a primitive between them is better, degrees."""
_CLEAR = 0.005
"""Overlap that it takes to be."""
_WHOLE = 2**40
"""The link's volume as a whole number."""
_SAME = 9
"""Decimals of axes, and of where sides are, that are compared."""
_MICRO = 6
"""Decimals of lengths."""


@dataclass(frozen=True, eq=False)
class _Link:
    """A union of primitives as points."""

    solid: Sequence[Shape]
    """The primitives."""
    points: Array
    """Inside, link frame, shape (3, n)."""
    weights: NDArray[np.int64]
    """Of points, together ``_WHOLE``, shape (n,)."""
    volume: float


@dataclass(frozen=True, eq=False)
class _Frame:
    """The link as it is seen along three axes."""

    link: _Link
    R_link_frame: Array
    """Shape (3, 3)."""
    points: Array
    """Along these axes, shape (3, n)."""
    spans: Array
    """Lower and upper end of every primitive, of any two if they are few, and of all, shape
    (k, 3, 2)."""


@dataclass(frozen=True, eq=False)
class _Found:
    """A primitive along the axes of a frame."""

    overlap: float
    """Intersection over union."""
    frame: _Frame
    kind: Kind
    numbers: Numbers

    @property
    def middle(self) -> Numbers:
        """Its centre along the axes."""
        return _body(self.kind, self.numbers)[1]


def composite(shapes: Sequence[Shape]) -> Shape | None:
    """The box, cylinder or sphere that overlaps the union of primitives most.

    Its axes are those of the link or of one of the primitives; where these differ they may be
    between.

    Args:
        shapes: Boxes, cylinders and spheres in the link frame.

    Returns:
        The primitive in its canonical pose, lengths to the micrometre; None if nothing has volume.
    """
    solid = [shape for shape in shapes if volume(_plain(shape)) > 0]
    if not solid:
        return None
    link = _filled(solid)
    frames = [_frame(link, R) for R in _rotations(solid)]
    starts = [
        (_overlap(frame, kind, numbers), frame, kind, numbers)
        for frame in frames
        for kind in KINDS
        for numbers in _starts(frame, kind)
    ]
    starts = sorted(starts, key=lambda start: -start[0])[:_REFINED]
    found: dict[Kind, _Found] = {}
    for start in starts:
        improved = _improved(*start[1:])
        if improved.kind not in found or improved.overlap > found[improved.kind].overlap:
            found[improved.kind] = improved
    if len(frames) > _UPRIGHT:
        found = {kind: _tilted(each) for kind, each in found.items()}
    shape = canonical(_shape(max(found.values(), key=lambda each: each.overlap)))
    pose = shape.T_link_shape
    return replace(shape, T_link_shape=replace(pose, quaternion=rounded(pose.quaternion)))


def _rotations(solid: Sequence[Shape]) -> list[Array]:
    """The axes of the link and of its primitives, each with x, y and z as z, shapes (3, 3)."""
    found: dict[tuple[float, ...], Array] = {}
    rotations = [np.eye(3), *(shape.T_link_shape.matrix[:3, :3] for shape in solid)]
    for R, order in itertools.product(rotations, ((0, 1, 2), (1, 2, 0), (2, 0, 1))):
        key = tuple(np.abs(R[:, order]).round(_SAME).ravel().tolist())
        found.setdefault(key, R[:, order])
    return list(found.values())


def _frame(link: _Link, R_link_frame: Array) -> _Frame:
    each = [_span(shape, R_link_frame) for shape in link.solid]
    pairs = itertools.combinations(each, 2) if len(each) <= _FEW else ()
    some = [*itertools.combinations(each, 1), *pairs, each]
    spans = [np.stack([np.min(of, axis=0)[:, 0], np.max(of, axis=0)[:, 1]], axis=1) for of in some]
    return _Frame(link, R_link_frame, _turned(R_link_frame.T, link.points), np.stack(spans))


def _tilted(best: _Found) -> _Found:
    """The same, or what overlaps clearly more along axes that are none of the primitives'."""
    for degrees, axis, sign in itertools.product(_TURNS, range(3), (1, -1)):
        angle = sign * math.radians(degrees)
        turn = np.eye(3)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        turn[i, i] = turn[j, j] = math.cos(angle)
        turn[j, i], turn[i, j] = math.sin(angle), -math.sin(angle)
        R = _turned(best.frame.R_link_frame, turn)
        frame = _frame(best.frame.link, R)
        middle = _turned(best.frame.R_link_frame, np.array(best.middle)[:, None])
        moved = _turned(R.T, middle)[:, 0] - best.middle
        found = _improved(frame, best.kind, _shifted(best.kind, best.numbers, moved.tolist()))
        if found.overlap > best.overlap + _CLEAR:
            best = found
    return best


def _filled(solid: Sequence[Shape]) -> _Link:
    m = _POINTS if len(solid) <= _FEW else _FEWER_POINTS
    cube = 2 * qmc.Sobol(3, scramble=False).random_base2(m).T - 1 + 0.5**m
    drawn, shares = [], []
    for shape in solid:
        body = _plain(shape)
        inside = cube[:, _inside(body, cube * _half(body)[:, None])] * _half(body)[:, None]
        T = shape.T_link_shape.matrix
        drawn.append(_turned(T[:3, :3], inside) + T[:3, 3:])
        shares.append(np.full(inside.shape[1], volume(body) / inside.shape[1]))
    points = np.concatenate(drawn, axis=1)
    times = np.zeros(points.shape[1])
    for shape in solid:
        T = shape.T_link_shape.matrix
        times += _inside(_plain(shape), _turned(T[:3, :3].T, points - T[:3, 3:]))
    share = np.concatenate(shares) / np.maximum(times, 1)  # each place counts once
    weights = np.round(share / share.sum() * _WHOLE).astype(np.int64)
    return _Link(solid, points, weights, float(share.sum()))


def _starts(frame: _Frame, kind: Kind) -> Iterator[Numbers]:
    """Around, or in, every primitive and all together."""
    for span in frame.spans:
        (x, y, z), half = span.mean(axis=1).tolist(), (np.ptp(span, axis=1) / 2).tolist()
        if kind == "box":
            yield tuple(span.ravel().tolist())
        elif kind == "cylinder":
            for radius in sorted(set(half[:2])):
                yield x, y, radius, *span[2].tolist()
        else:
            for radius in sorted(set(half)):
                yield x, y, z, radius


def _improved(frame: _Frame, kind: Kind, numbers: Numbers) -> _Found:
    """Give one number after another its best value, till none gains."""
    best, before = _overlap(frame, kind, numbers), -1.0
    values = _values(frame, kind)
    for _ in range(_SWEEPS):
        if best == before:
            break
        before = best
        for i, some in enumerate(values):
            for value in some:
                tried = (*numbers[:i], value, *numbers[i + 1 :])
                if (overlap := _overlap(frame, kind, tried)) > best:
                    best, numbers = overlap, tried
    return _Found(best, frame, kind, numbers)


def _values(frame: _Frame, kind: Kind) -> list[list[float]]:
    """What each number of a candidate may be: at faces and centres first, then between."""
    between = np.arange(1, _GRID) / _GRID
    low, high = frame.spans[-1].T
    grid = low[:, None] + (high - low)[:, None] * between
    sides = [
        [*sorted({*frame.spans[:, axis].ravel().tolist()}), *grid[axis].tolist()]
        for axis in range(3)
    ]
    if kind == "box":
        return [sides[axis] for axis in (0, 0, 1, 1, 2, 2)]
    centres = [
        [*sorted({*frame.spans[:, axis].mean(axis=1).tolist()}), *grid[axis].tolist()]
        for axis in range(3)
    ]
    halves = np.ptp(frame.spans, axis=2) / 2
    radii = [*sorted({*halves.ravel().tolist()}), *(halves[-1].max() * between).tolist()]
    if kind == "cylinder":
        return [centres[0], centres[1], radii, sides[2], sides[2]]
    return [*centres, radii]


def _overlap(frame: _Frame, kind: Kind, numbers: Numbers) -> float:
    """Intersection over union; 0 for what is no primitive."""
    body, middle = _body(kind, numbers)
    if min(_half(body)) <= 0:
        return 0.0
    link, inside = frame.link, _inside(body, frame.points - np.array(middle)[:, None])
    common = float(link.weights[inside].sum()) / _WHOLE * link.volume
    return common / (volume(body) + link.volume - common)


def _body(kind: Kind, numbers: Numbers) -> tuple[Primitive, Numbers]:
    """A primitive and its centre."""
    if kind == "box":
        lower, upper = numbers[::2], numbers[1::2]
        x, y, z = (high - low for low, high in zip(lower, upper, strict=True))
        return Box((x, y, z)), tuple((a + b) / 2 for a, b in zip(lower, upper, strict=True))
    if kind == "cylinder":
        x, y, radius, low, high = numbers
        return Cylinder(radius, high - low), (x, y, (low + high) / 2)
    return Sphere(numbers[3]), numbers[:3]


def _shifted(kind: Kind, numbers: Numbers, by: Sequence[float]) -> Numbers:
    x, y, z = by
    moves = {"box": (x, x, y, y, z, z), "cylinder": (x, y, 0, z, z), "sphere": (x, y, z, 0)}[kind]
    return tuple(number + move for number, move in zip(numbers, moves, strict=True))


def _shape(found: _Found) -> Shape:
    body, middle = _body(found.kind, found.numbers)
    R_link_frame = found.frame.R_link_frame
    match body:
        case Box((x, y, z)):
            body = Box((round(x, _MICRO), round(y, _MICRO), round(z, _MICRO)))
        case Cylinder(radius, length):
            body = Cylinder(round(radius, _MICRO), round(length, _MICRO))
        case Sphere(radius):
            body = Sphere(round(radius, _MICRO))
    T = np.eye(4)
    T[:3, :3] = R_link_frame
    T[:3, 3] = _turned(R_link_frame, np.array(middle)[:, None])[:, 0].round(_MICRO) + 0.0
    return Shape(body, Pose.from_matrix(T))


def _plain(shape: Shape) -> Box | Cylinder | Sphere:
    if not isinstance(shape.geometry, Box | Cylinder | Sphere):
        raise TypeError(f"{shape.geometry!r} is no box, cylinder or sphere")
    return shape.geometry


def _half(body: Primitive) -> Array:
    """Half the edges of the box around a primitive along its own axes, shape (3,)."""
    match body:
        case Box(size):
            return np.array(size) / 2
        case Sphere(radius):
            return np.full(3, radius)
        case _:
            return np.array([body.radius, body.radius, body.length / 2])


def _inside(body: Primitive, points: Array) -> NDArray[np.bool_]:
    """Which points (3, n) in its own frame a primitive holds, shape (n,)."""
    x, y, z = points
    match body:
        case Box((a, b, c)):
            held = (abs(x) <= a / 2) & (abs(y) <= b / 2) & (abs(z) <= c / 2)
        case Sphere(radius):
            held = x * x + y * y + z * z <= radius * radius
        case _:
            held = (x * x + y * y <= body.radius**2) & (abs(z) <= body.length / 2)
    return np.asarray(held)


def _span(shape: Shape, R_link_frame: Array) -> Array:
    """Lower and upper end of a primitive along the axes of a frame, shape (3, 2)."""
    T, body = shape.T_link_shape.matrix, _plain(shape)
    middle = _turned(R_link_frame.T, T[:3, 3:])[:, 0]
    along = np.abs(_turned(R_link_frame.T, T[:3, :3]))  # cosines of frame and body axes
    match body:
        case Box(size):
            half = _turned(along, np.array(size)[:, None] / 2)[:, 0]
        case Sphere(radius):
            half = np.full(3, radius)
        case Cylinder(radius, length):
            cosine = np.minimum(along[:, 2], 1.0)
            half = radius * np.sqrt(1 - cosine * cosine) + length / 2 * cosine
    return np.stack([middle - half, middle + half], axis=1).round(_SAME)


def _turned(R: Array, vectors: Array) -> Array:
    """``R @ vectors``, shape (3, n), in one order of operations everywhere."""
    x, y, z = vectors
    return np.stack([row[0] * x + row[1] * y + row[2] * z for row in R])

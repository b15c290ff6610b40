"""Fit one or several primitives to the shapes of one link, and measure the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from numbers import Real

import numpy as np
import trimesh
from scipy.stats import qmc

from morphgen.errors import FitError, whole_number
from morphgen.fitting import search
from morphgen.fitting.solid import Solid, solid_of
from morphgen.formats.fits import MAX_PRIMITIVES, are_primitives, shape_to_data
from morphgen.model.geometry import Box, Capsule, Cylinder, Mesh, Shape, Sphere, volume
from morphgen.typing import Array

MAX_COVER = 0.9999
"""Largest share that spheres can be required to cover: more cannot be counted on sample points."""


@dataclass(frozen=True)
class FitOptions:
    """Options of a fit."""

    max_primitives: int = 1  # largest number of primitives per link
    iou: float = 0.9  # intersection over union at which no further primitive is added
    seed: int = 0  # seed of the sample points and of the clusterings
    spheres: int | None = None
    """Number of spheres per link, of a fit with spheres alone; None for a fit with primitives."""
    cover: float | None = None
    """Share of a link's volume that its spheres must cover; None for the largest IoU."""

    def __post_init__(self) -> None:
        """Check the values."""
        whole_number("max_primitives", self.max_primitives, FitError)
        whole_number("seed", self.seed, FitError)
        _require_number("iou", self.iou)
        if self.spheres is not None:
            whole_number("spheres", self.spheres, FitError)
            if not 1 <= self.spheres <= MAX_PRIMITIVES:
                raise FitError(f"{self.spheres} spheres: expected 1 to {MAX_PRIMITIVES} per link")
            if self.max_primitives != 1:
                raise FitError("a fit of spheres takes no max_primitives")
        if self.cover is not None:
            _require_number("cover", self.cover)
            if self.spheres is None:
                raise FitError(f"cover {self.cover:g}: expected a number of spheres, too")
            if not 0 < self.cover <= MAX_COVER:
                raise FitError(f"cover {self.cover:g}: expected more than 0, at most {MAX_COVER}")
        if not 1 <= self.max_primitives <= MAX_PRIMITIVES:
            raise FitError(f"{self.max_primitives} primitives: expected 1 to {MAX_PRIMITIVES}")
        if not 0 < self.iou <= 1:
            raise FitError(f"IoU {self.iou}: expected more than 0, at most 1")
        if self.seed < 0:
            raise FitError(f"seed {self.seed}: expected 0 or more")


def _require_number(name: str, value: object) -> None:
    if not isinstance(value, Real):
        raise FitError(f"{name} {value!r}: expected a number")


@dataclass(frozen=True)
class LinkFit:
    """Primitives that replace the shapes of a link, with their measured quality."""

    primitives: tuple[Shape, ...]  # boxes, cylinders and spheres in the link frame
    single: Shape | None  # the single primitive of largest overlap; None if it was not searched for
    solid: str  # how the solid was made, see `solid.Method`; `primitives` if the shapes were kept
    quality: Quality
    decimated_from: int | None = None
    """Number of triangles before decimation; None if the mesh was not decimated."""

    def as_dict(self) -> dict[str, object]:
        """Return plain data for JSON: metres, (x, y, z) and (w, x, y, z)."""
        return {
            "primitives": [shape_to_data(shape) for shape in self.primitives],
            "solid": self.solid,
            "decimated_from": self.decimated_from,
            "quality": {name: float(f"{v:.6g}") for name, v in asdict(self.quality).items()},
        }


def fit_shapes(
    shapes: Sequence[Shape], options: FitOptions, *, solid: Solid | None = None
) -> LinkFit:
    """Fit the shapes of one link in its frame, or keep few primitives of the wanted kinds."""
    solid = solid or solid_of(shapes)
    is_kept = are_primitives(shapes) and len(shapes) <= options.max_primitives
    if options.spheres is not None:
        is_kept = all(isinstance(shape.geometry, Sphere) for shape in shapes)
    if is_kept:
        kept = tuple(replace(shape, rgba=None) for shape in shapes)
        single = kept[0] if len(kept) == 1 else None
        return replace(_measure(kept, single, solid), solid="primitives")
    return fit_solid(solid, options)


def fit_solid(solid: Solid, options: FitOptions) -> LinkFit:
    """Fit a solid; see ``fit_shapes``."""
    target = search.sample_solid(solid, options.seed)
    if options.spheres is not None:
        found = search.best_spheres(target, options.spheres, options.cover, options.seed)
        return _measure(found.shapes, None, solid)
    best = latest = search.best_single(target)
    (single,) = best.shapes
    for _ in range(1, options.max_primitives):
        if best.iou >= options.iou:
            break
        more = search.best_several(target, latest, options.seed)
        if more is None:
            break
        latest = more
        best = max(best, latest, key=lambda result: result.iou)
    return _measure(best.shapes, single, solid)


def _measure(primitives: tuple[Shape, ...], single: Shape | None, solid: Solid) -> LinkFit:
    measured = quality(solid, primitives)
    return LinkFit(primitives, single, solid.method, measured, solid.decimated_from)


SolidPrimitive = Box | Cylinder | Capsule  # a primitive; a sphere is a capsule of length 0
_ON_SURFACE = 1e-6
"""Distance up to which a point counts as on the surface of the solid, not outside [m]."""
_SEED = 1  # not that of a search, whose sample points a fit may suit too well
_VOLUME_POINTS, _SURFACE_POINTS = 32768, 8192  # numbers of sample points
_SECTIONS = 128  # number of sides of a tessellated circle, within 0.03% of its radius
_SUBDIVISIONS = 4
"""Number of subdivisions of the icosahedron of a tessellated sphere, within 0.1% of its radius; one
more takes four times as long, most of it for the union of spheres."""


@dataclass(frozen=True)
class Quality:
    """Measured agreement of a union of primitives with a solid."""

    iou: float  # volume of the intersection over the volume of the union
    coverage: float  # share of the solid's volume that is inside the primitives
    volume_ratio: float  # volume of the union of the primitives over the volume of the solid
    protrusion_share: float  # share of the primitives' outer surface that is outside of the solid
    protrusion_mean: float
    """Mean distance of the primitives' outer surface from the solid, 0 where inside [m]."""
    protrusion_p95: float  # 95th percentile of that distance over the surface [m]
    gap_mean: float  # mean distance of the solid's surface from the primitives, 0 where inside [m]
    gap_p95: float  # 95th percentile of that distance over the surface [m]
    hausdorff: float  # largest distance of a point of either surface to the other surface [m]


def quality(solid: Solid, primitives: Sequence[Shape]) -> Quality:
    """Measure how well primitives, at least one, approximate a solid in the link frame.

    The surface of a solid with holes consists of the triangles that exist. Triangles inside of the
    solid count only for distances from points inside of it.
    """
    vertices = np.asarray(solid.mesh.vertices)[solid.mesh.referenced_vertices]
    at_vertices = signed_distance(primitives, vertices)
    rng = np.random.default_rng(_SEED)
    R, low, high = _bounding_box(primitives, vertices)
    # In the smallest box, most points are near a surface and tell the volumes apart.
    points = (low + (high - low) * _sobol(_VOLUME_POINTS, rng)) @ R.T
    in_primitives, in_solid = signed_distance(primitives, points) <= 0, solid.contains(points)
    if not in_solid.any():
        raise FitError(f"none of {len(points)} sample points lies in the solid")
    intersection = np.count_nonzero(in_primitives & in_solid)

    union = _union(primitives)
    outer = _surface_points(union, _SURFACE_POINTS, rng)
    to_solid = solid.distance(outer)
    protrusion = np.where(solid.contains(outer), 0.0, to_solid)

    surface = solid.surface(_SURFACE_POINTS, rng)
    signed = signed_distance(primitives, surface)
    gap = np.maximum(signed, 0.0)
    # Distances of triangles to convex primitives are largest at vertices. Vertices inside of the
    # solid do no harm: a surface point near them is at least as far from all primitives.
    depth = -signed[signed < 0]  # exact for one primitive
    if len(primitives) > 1:
        depth = Solid(union, "watertight").distance(surface[signed < 0])
    hausdorff = np.concatenate(
        [to_solid, solid.distance(np.asarray(union.vertices)), gap, at_vertices, depth]
    ).max()
    return Quality(
        iou=float(intersection / np.count_nonzero(in_primitives | in_solid)),
        coverage=float(intersection / np.count_nonzero(in_solid)),
        volume_ratio=float(np.count_nonzero(in_primitives) / np.count_nonzero(in_solid)),
        protrusion_share=float((protrusion > _ON_SURFACE).mean()),
        protrusion_mean=float(protrusion.mean()),
        protrusion_p95=float(np.percentile(protrusion, 95)),
        gap_mean=float(gap.mean()),
        gap_p95=float(np.percentile(gap, 95)),
        hausdorff=float(hausdorff),
    )


def signed_distance(primitives: Sequence[Shape], points: Array) -> Array:
    """Return the signed distances (n,) of points (n, 3) to a union of primitives [m].

    They are negative inside, and exact outside and inside of one primitive; inside of several
    overlapping primitives the surface may be farther away.
    """
    return np.asarray(np.min([_distance(shape, points) for shape in primitives], axis=0))


def _solid_primitive(shape: Shape) -> SolidPrimitive:
    """Return the geometry of a shape, a sphere as a capsule of length 0."""
    geometry = shape.geometry
    if isinstance(geometry, Mesh) or not volume(geometry) > 0:
        raise ValueError(f"{geometry} is not a primitive with a volume")
    return Capsule(geometry.radius, 0.0) if isinstance(geometry, Sphere) else geometry


def _distance(shape: Shape, points: Array) -> Array:
    T = shape.T_link_shape.matrix
    x, y, z = T[:3, :3].T @ (points - T[:3, 3]).T
    match _solid_primitive(shape):
        case Box((a, b, c)):
            return _rounded(abs(x) - a / 2, abs(y) - b / 2, abs(z) - c / 2)
        case Cylinder(radius, length):
            return _rounded(np.hypot(x, y) - radius, abs(z) - length / 2)
        case Capsule(radius, length):
            z = z - np.clip(z, -length / 2, length / 2)
            return np.asarray(np.sqrt(x * x + y * y + z * z) - radius)


def _rounded(*beyond: Array) -> Array:
    """Return signed distances from the distances beyond each pair of orthogonal faces."""
    squared = sum(np.maximum(part, 0.0) ** 2 for part in beyond)
    return np.asarray(np.sqrt(squared) + np.minimum(np.max(beyond, axis=0), 0.0))


def _bounding_box(primitives: Sequence[Shape], points: Array) -> tuple[Array, Array, Array]:
    """Return axes and bounds of the smallest box around all along the axes of one."""
    boxes = []
    for R in (np.eye(3), *(shape.T_link_shape.matrix[:3, :3] for shape in primitives)):
        centres = np.array([shape.T_link_shape.position for shape in primitives]) @ R
        halves = np.array([_half_extents(shape, R) for shape in primitives])
        ends = np.concatenate([points @ R, centres - halves, centres + halves])
        boxes.append((R, ends.min(axis=0), ends.max(axis=0)))
    return min(boxes, key=lambda box: float(np.prod(box[2] - box[1])))


def _half_extents(shape: Shape, R: Array) -> Array:
    """Return the half extents of a primitive along the columns of a rotation, shape (3,)."""
    axes = abs(R.T @ shape.T_link_shape.matrix[:3, :3])  # cosines
    match _solid_primitive(shape):
        case Box(size):
            return np.asarray(axes @ size / 2)
        case Cylinder(radius, length):
            across = np.sqrt(np.maximum(1 - axes[:, 2] ** 2, 0.0))
            return np.asarray(radius * across + axes[:, 2] * length / 2)
        case Capsule(radius, length):
            return np.asarray(radius + axes[:, 2] * length / 2)


def _sobol(n: int, rng: np.random.Generator) -> Array:
    """Return ``n`` scrambled Sobol points in the unit cube, a power of two."""
    sampler = qmc.Sobol(3, scramble=True, seed=rng)  # errors of two volumes cancel on one sample
    return np.asarray(sampler.random(n))


def _union(primitives: Sequence[Shape]) -> trimesh.Trimesh:
    """Return the triangles of the outer surface of primitives in the link frame."""
    meshes = [_tessellated(shape) for shape in primitives]
    # Manifold rounds to single precision, which one primitive does not need.
    return meshes[0] if len(meshes) == 1 else trimesh.boolean.union(meshes, check_volume=False)


def _tessellated(shape: Shape) -> trimesh.Trimesh:
    """Return the triangles of a primitive in the link frame."""
    mesh: trimesh.Trimesh
    # Meshes are made in unit size: trimesh welds vertices that are less than 1e-8 apart.
    match _solid_primitive(shape):
        case Box(size):
            mesh = trimesh.creation.box().apply_scale(size)
        case Cylinder(radius, length):
            mesh = trimesh.creation.cylinder(1.0, 1.0, _SECTIONS)
            mesh.apply_scale((radius, radius, length))
        case Capsule(radius, 0.0):
            mesh = trimesh.creation.icosphere(_SUBDIVISIONS).apply_scale(radius)
        case Capsule(radius, length):
            mesh = trimesh.creation.capsule(length / radius, 1.0, (_SECTIONS, _SECTIONS))
            # trimesh has one end of the axis at the origin.
            mesh.apply_translation(-mesh.bounds.mean(axis=0))
            mesh.apply_scale(radius)
    return mesh.apply_transform(shape.T_link_shape.matrix)


def _surface_points(mesh: trimesh.Trimesh, n: int, rng: np.random.Generator) -> Array:
    """Sample a surface evenly: a Sobol point selects a triangle by its area and a point in it."""
    area, along, across = _sobol(n, rng).T
    ends = np.cumsum(mesh.area_faces)
    faces = np.searchsorted(ends[:-1] / ends[-1], area, side="right")
    # The square root makes the density even, as the triangle widens from its first corner.
    along = np.sqrt(along)
    weights = np.stack([1 - along, along * (1 - across), along * across], axis=1)
    return np.asarray((weights[:, :, None] * mesh.triangles[faces]).sum(axis=1))

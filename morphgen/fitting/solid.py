"""The solid of a link: which points are inside of meshes that may be open, nested or inside out.

A point is inside if the generalised winding number of the triangles is above one half (Jacobson,
Kavan and Sorkine-Hornung, "Robust inside-outside segmentation using generalized winding numbers",
2013; evaluated by libigl). That of closed triangles is a whole number: the signed count of
triangles that a ray crosses, which takes a tenth of the time. The normals of every connected
component are turned outwards first, so a component within another one counts as filled: nothing
enters the cavities of a link. The meshes of covers are shells: thin walls around a cavity that is
open where the next link begins. A point of such a cavity is inside, too, if few directions lead out
of it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal, cast

import fast_simplification
import igl
import numpy as np
import trimesh
from numpy.typing import NDArray
from trimesh.ray.ray_pyembree import RayMeshIntersector

from morphgen.errors import FitError
from morphgen.model.geometry import Shape
from morphgen.model.inertia import link_frame_mesh
from morphgen.model.mesh import FLATNESS_TOLERANCE, is_flat
from morphgen.typing import Array

Method = Literal["watertight", "repaired", "winding", "filled", "hull"]
"""How a solid was made of triangles, from best to worst: unchanged; repaired (normals turned
outwards, vertices welded, small holes filled); open, so that the winding number decides; a hollow
shell whose cavity was filled; the convex hull of a mesh that encloses next to nothing."""
METHODS: tuple[Method, ...] = ("watertight", "repaired", "winding", "filled", "hull")

MAX_FACES = 200_000  # number of triangles above which a mesh is decimated
DECIMATED_FACES = 100_000  # number of triangles after decimation
MIN_ENCLOSED_SHARE = 0.02
"""Share of the convex hull's volume below which an open mesh encloses nothing."""
MAX_OPENNESS = 0.3
"""Openness below which a point is in the cavity of a shell. Half-way down a cup that is as wide as
deep the openness is 0.15."""
MIN_CAVITY = 0.1  # volume of a cavity, relative to that of the walls, from which a shell is filled
NUM_RAYS = 64  # number of rays from a point that its openness is measured with
_SLOPES = np.array([0.0271828, 0.0141421])  # of rays that decide what is inside, along x and y
_NUM_COLUMNS = (16, 256)  # smallest and largest number of columns of a grid along x and y
_MAX_RAYS = 2**13  # number of points that are decided together; bounds memory
_WELD_DISTANCE = 1e-5  # distance below which vertices are welded, relative to the size of the mesh
_NUM_PROBES = 4096  # number of sample points that measure enclosed volumes and cavities


@dataclass(frozen=True, eq=False)
class Solid:
    """The inside of a link's shapes, in the link frame [m]."""

    mesh: trimesh.Trimesh  # triangles with outward normals, perhaps open or overlapping
    method: Method  # the worst method that any of the shapes needed
    decimated_from: int | None = None
    """Number of triangles before decimation; None if the mesh was not decimated."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Return which points, shape (n, 3), are inside."""
        low, high = self.mesh.bounds
        near = np.all((points >= low) & (points <= high), axis=1)
        inside = np.zeros(len(points), dtype=bool)
        if near.any():
            inside[near] = self._winding(points[near]) > 0.5
        if self.method == "filled":
            unsure = near & ~inside
            # Outside of the hull at least half of the directions lead out.
            unsure[unsure] = self._hull_columns.winding(points[unsure]) > 0
            inside[unsure] = _openness(self._rays, points[unsure]) < MAX_OPENNESS
        return inside

    def distance(self, points: Array) -> Array:
        """Return the distances of points, shape (n, 3), to the triangles [m]."""
        squared, _, _ = self._tree.squared_distance(self._vertices, self._faces, points)
        return np.asarray(np.sqrt(squared))

    def surface(self, n: int, rng: np.random.Generator) -> Array:
        """Sample about ``n`` points of the outer surface, without triangles inside of the solid."""
        points, faces = trimesh.sample.sample_surface(self.mesh, n, seed=rng)
        points = np.asarray(points)
        step = 1e-4 * self.size * self.mesh.face_normals[faces]  # past rounding, within thin walls
        outer = ~self.contains(points + step)
        return points[outer] if outer.any() else points

    @cached_property
    def hull(self) -> trimesh.Trimesh:
        """Convex hull of the triangles."""
        hull: trimesh.Trimesh = trimesh.convex.convex_hull(self.mesh)
        return hull

    @property
    def size(self) -> float:
        """Diagonal of the bounding box [m]."""
        return float(np.linalg.norm(self.mesh.extents))

    @cached_property
    def _winding(self) -> Callable[[Array], Array]:
        if self.mesh.is_watertight and self.mesh.is_winding_consistent:
            return _Columns(self.mesh).winding
        hierarchy = igl.FastWindingNumberBVH()
        hierarchy.init(self._vertices, self._faces)
        return cast(Callable[[Array], Array], hierarchy.winding_number)

    @cached_property
    def _hull_columns(self) -> _Columns:
        return _Columns(self.hull)

    @cached_property
    def _tree(self) -> igl.AABB:
        tree = igl.AABB()
        tree.init(self._vertices, self._faces)
        return tree

    @cached_property
    def _rays(self) -> RayMeshIntersector:
        return RayMeshIntersector(self.mesh)

    @cached_property
    def _vertices(self) -> Array:
        return np.ascontiguousarray(self.mesh.vertices, dtype=np.float64)

    @cached_property
    def _faces(self) -> NDArray[np.int64]:
        return np.ascontiguousarray(self.mesh.faces, dtype=np.int64)


class _Columns:
    """Closed triangles, sorted into the columns of a grid that rays from points run along."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        """Sort the triangles."""
        corners, faces = _projected(np.asarray(mesh.triangles)), np.asarray(mesh.faces)
        a, b = corners, np.roll(corners, -1, axis=1)
        # Both triangles at an edge see it in the same direction, so that no ray passes between.
        backward = faces > np.roll(faces, -1, axis=1)
        a, b = (np.where(backward[..., None], *pair) for pair in ((b, a), (a, b)))
        along = b - a
        away = a[..., 0] * b[..., 1] - b[..., 0] * a[..., 1]
        self._edges = np.stack([-along[..., 1].T, along[..., 0].T, away.T])
        self._backward = np.ascontiguousarray(backward.T)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        upright = normal[:, 2] == 0
        slopes = -normal[:, :2] / np.where(upright, 1.0, normal[:, 2])[:, None]
        first = corners[:, 0]
        height = first[:, 2] - (slopes * first[:, :2]).sum(axis=1)
        self._planes = np.stack([*slopes.T, height])
        num_cells = int(np.clip(2 * np.sqrt(len(faces)), *_NUM_COLUMNS))
        flat = corners[:, :, :2]
        self._low, high = flat.min(axis=(0, 1)), flat.max(axis=(0, 1))
        self._cells = num_cells / (high - self._low)
        self._last = num_cells - 1
        first_cell, last_cell = self._cell(flat.min(axis=1)), self._cell(flat.max(axis=1))
        width, depth = (last_cell - first_cell + 1).T
        face, offset = _ragged(width * depth)
        x = first_cell[face, 0] + offset % width[face]
        column = x * num_cells + first_cell[face, 1] + offset // width[face]
        self._faces = face[np.argsort(column, kind="stable")]
        self._counts = np.bincount(column, minlength=num_cells**2)
        self._starts = np.cumsum(self._counts) - self._counts

    def _cell(self, flat: Array) -> NDArray[np.intp]:
        cell = ((flat - self._low) * self._cells).astype(np.intp)
        return np.asarray(np.clip(cell, 0, self._last))

    def winding(self, points: Array) -> Array:
        """Return the winding numbers of points (n, 3): of triangles above, how many face up."""
        starts = range(0, len(points), _MAX_RAYS)
        some = (self._winding(_projected(points[i : i + _MAX_RAYS])) for i in starts)
        return np.concatenate([np.zeros(0), *some])

    def _winding(self, points: Array) -> Array:
        x, y = self._cell(points[:, :2]).T
        column = x * (self._last + 1) + y
        point, offset = _ragged(self._counts[column])
        face = self._faces[self._starts[column[point]] + offset]
        xyz = np.ascontiguousarray(points.T)
        x, y = xyz[:2].take(point, axis=1)
        a, b, c = self._edges.take(face, axis=2)
        left = (a * x + b * y + c >= 0) ^ self._backward.take(face, axis=1)
        hit = np.flatnonzero((left[0] == left[1]) & (left[1] == left[2]))
        point, (x, y, z) = point[hit], xyz.take(point[hit], axis=1)
        along_x, along_y, height = self._planes.take(face[hit], axis=1)
        above = along_x * x + along_y * y + height > z
        sign = np.where(left[0, hit[above]], 1.0, -1.0)
        return np.asarray(np.bincount(point[above], sign, minlength=len(points)), np.float64)


def _projected(points: Array) -> Array:
    """Shear points along z, by slopes that no edge of a mesh has: a ray along z meets no edge."""
    return np.concatenate([points[..., :2] + points[..., 2:] * _SLOPES, points[..., 2:]], axis=-1)


def _ragged(counts: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return each index i ``counts[i]`` times, and the numbers from 0 to ``counts[i]`` - 1."""
    index = np.repeat(np.arange(len(counts)), counts)
    return index, np.arange(len(index)) - (np.cumsum(counts) - counts)[index]


def solid_of(shapes: Sequence[Shape]) -> Solid:
    """Return the solid of at least one shape, fixed to each other."""
    meshes = map(link_frame_mesh, shapes)
    solids = [solid for mesh in meshes if (solid := solid_of_mesh(mesh)) is not None]
    if not solids:
        raise FitError("the shapes are flat: they have no volume")
    if len(solids) == 1:
        return _fill_cavity(solids[0])
    counts = [solid.decimated_from or len(solid.mesh.faces) for solid in solids]
    union = Solid(
        cast(trimesh.Trimesh, trimesh.util.concatenate([solid.mesh for solid in solids])),
        max((solid.method for solid in solids), key=METHODS.index),
        sum(counts) if any(solid.decimated_from for solid in solids) else None,
    )
    return _fill_cavity(union)


def solid_of_mesh(mesh: trimesh.Trimesh) -> Solid | None:
    """Return the solid of triangles in metres; None if they are flat."""
    if is_flat(np.asarray(mesh.vertices)):
        return None
    before = len(mesh.faces)
    if before > MAX_FACES:
        vertices, faces = fast_simplification.simplify(
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.int32),
            target_count=DECIMATED_FACES,
        )
        mesh = trimesh.Trimesh(vertices, faces)
    oriented, changed = _orient_outwards(mesh)
    method: Method = "repaired" if changed else "watertight"
    if not oriented.is_watertight:
        oriented = _close(oriented)
        method = "repaired" if oriented.is_watertight else "winding"
    solid = Solid(oriented, method, before if before > MAX_FACES else None)
    if method == "winding":
        low, high = oriented.bounds
        enclosed = float(solid.contains(_probes(solid)).mean() * np.prod(high - low))
        if enclosed < MIN_ENCLOSED_SHARE * float(solid.hull.volume):
            return Solid(solid.hull, "hull", solid.decimated_from)
    return solid


def _orient_outwards(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, bool]:
    """Turn the normals of every connected component outwards; return also if anything changed."""
    oriented = _without_duplicates(mesh)
    if not oriented.is_winding_consistent:
        oriented = oriented.copy()
        trimesh.repair.fix_winding(oriented)
    corners = oriented.triangles
    label = trimesh.graph.connected_component_labels(
        oriented.face_adjacency, node_count=len(oriented.faces)
    )
    size = np.bincount(label)
    centre = np.stack(
        [np.bincount(label, corners[:, :, i].mean(axis=1)) / size for i in range(3)], axis=1
    )
    # The signed volume of a component is the sum of the tetrahedra of its triangles and its centre.
    local = corners - centre[label][:, None]
    volumes = np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])) / 6
    # A flat component has no inside.
    least = FLATNESS_TOLERANCE * np.bincount(label, oriented.area_faces) ** 1.5
    inverted = (np.bincount(label, volumes) < -least)[label]
    if not inverted.any():
        return oriented, oriented is not mesh
    faces = np.where(inverted[:, None], oriented.faces[:, ::-1], oriented.faces)
    return trimesh.Trimesh(oriented.vertices, faces, process=False), True


def _without_duplicates(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Keep one of several triangles with the same corners, and none of two that face each other.

    Two triangles that face each other are a wall within a solid, unless the whole mesh is doubled.
    """
    corners = np.sort(mesh.faces, axis=1)
    _, first, group = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(corners):
        return mesh
    # Triangles face each other if they go round their sorted corners in opposite directions.
    after_least = mesh.faces[np.arange(len(corners)), (np.argmin(mesh.faces, axis=1) + 1) % 3]
    facing = np.bincount(group, np.where(after_least == corners[:, 1], 1, -1))
    kept = first[facing != 0] if facing.any() else first
    return trimesh.Trimesh(mesh.vertices, mesh.faces[np.sort(kept)], process=False)


def _close(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Weld close vertices and fill small holes; return the same mesh if that does not close it."""
    welded = mesh.copy()
    digits = -int(np.floor(np.log10(_WELD_DISTANCE * np.linalg.norm(mesh.extents))))
    welded.merge_vertices(digits_vertex=digits)
    welded.update_faces(welded.nondegenerate_faces())
    trimesh.repair.fill_holes(welded)
    return _orient_outwards(welded)[0] if welded.is_watertight else mesh


def _fill_cavity(solid: Solid) -> Solid:
    """Return the solid with its cavity filled, if it is a shell."""
    if solid.method == "hull":
        return solid
    filled = replace(solid, method="filled")
    points = _probes(solid)
    num_in_walls, num_in_filled = solid.contains(points).sum(), filled.contains(points).sum()
    return filled if num_in_filled > (1 + MIN_CAVITY) * num_in_walls else solid


def _probes(solid: Solid) -> Array:
    """Return random points in the bounding box of a solid, shape (_NUM_PROBES, 3)."""
    low, high = solid.mesh.bounds
    return np.random.default_rng(0).uniform(low, high, (_NUM_PROBES, 3))


def _openness(rays: RayMeshIntersector, points: Array) -> Array:
    """Return the shares of directions in which rays from points (n, 3) hit no triangle, shape (n,).

    It is at least one half for a point outside of the convex hull.
    """
    if not len(points):
        return np.zeros(0)
    directions = _directions()
    hits = rays.intersects_any(
        np.repeat(points, NUM_RAYS, axis=0), np.tile(directions, (len(points), 1))
    )
    return np.asarray(1 - hits.reshape(len(points), NUM_RAYS).mean(axis=1))


def _directions() -> Array:
    """Return the directions of rays, (NUM_RAYS, 3): a Fibonacci lattice on the sphere.

    Equal steps along z cut zones of equal area; the golden angle spreads them around z.
    """
    steps = np.arange(NUM_RAYS) + 0.5
    z = 1 - 2 * steps / NUM_RAYS
    turn = np.pi * (1 + np.sqrt(5)) * steps  # multiples of the golden angle
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)

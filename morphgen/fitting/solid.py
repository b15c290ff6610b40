"""The solid of a link: which points lie inside of meshes that are open, nested or inside out.

A point is inside where the generalised winding number of the triangles is above one half (Jacobson,
Kavan and Sorkine-Hornung, "Robust inside-outside segmentation using generalized winding numbers",
2013; here libigl's fast evaluation of it). Every connected piece is first turned outwards, so a
piece within another counts as filled: a link is a body, and nothing enters its cavities. Meshes of
covers are shells, thin walls around a room that opens where the next link begins; this room counts
as filled, too, where few directions lead out of it.
"""

from __future__ import annotations

from collections.abc import Sequence
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
from morphgen.model.geometry import Mesh, Shape
from morphgen.model.inertia import solid_mesh
from morphgen.model.mesh import FLATNESS_TOLERANCE, is_flat, load_mesh
from morphgen.typing import Array

Method = Literal["watertight", "repaired", "winding", "filled", "hull"]
"""What made a solid of the triangles, from best to worst: nothing was needed; pieces were turned
outwards, welded or their small holes filled; it is open, and the winding number decides; it is a
hollow shell, and the room within was filled; it encloses next to nothing, and its convex hull is
taken."""
METHODS: tuple[Method, ...] = ("watertight", "repaired", "winding", "filled", "hull")

MAX_FACES = 200_000
"""Triangles above which a mesh is decimated."""
DECIMATED = 100_000
"""Triangles that are left then."""
HOLLOW = 0.02
"""Share of the convex hull's volume below which an open mesh encloses nothing."""
ENCLOSED = 0.3
"""Openness below which a point lies within a shell. Half-way down a cup as wide as deep: 0.15."""
SHELL = 0.1
"""Volume within a shell, relative to that of its walls, from which on it is filled."""
DIRECTIONS = 64
"""Rays from every point."""
_WELD = 1e-5
"""Distance below which vertices are welded, relative to the size of the mesh."""
_PROBES = 4096
"""Points that tell whether an open mesh encloses anything, and whether there is room in a shell."""


@dataclass(frozen=True, eq=False)
class Solid:
    """What is inside of a link's shapes, in the link frame, metres."""

    mesh: trimesh.Trimesh
    """Triangles turned outwards, perhaps open or overlapping."""
    method: Method
    """The worst that any of its shapes needed."""
    decimated_from: int | None = None
    """Number of triangles before decimation; None if there was none."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Whether points, shape (n, 3), lie inside."""
        low, high = self.mesh.bounds
        near = np.all((points >= low) & (points <= high), axis=1)
        inside = np.zeros(len(points), dtype=bool)
        if near.any():
            winding = igl.fast_winding_number(self._vertices, self._faces, points[near])
            inside[near] = winding > 0.5
        if self.method == "filled":
            unsure = near & ~inside
            inside[unsure] = self._cavities.openness(points[unsure]) < ENCLOSED
        return inside

    def distance(self, points: Array) -> Array:
        """Distance of points, shape (n, 3), to the triangles, metres."""
        squared, _, _ = igl.point_mesh_squared_distance(points, self._vertices, self._faces)
        return np.asarray(np.sqrt(squared))

    def surface(self, n: int, rng: np.random.Generator) -> Array:
        """About ``n`` points of the outer surface: triangles inside of the solid are left out."""
        points, faces = trimesh.sample.sample_surface(self.mesh, n, seed=rng)
        points = np.asarray(points)
        step = 1e-4 * self.size * self.mesh.face_normals[faces]
        outer = self.contains(points - step) != self.contains(points + step)
        return points[outer] if outer.any() else points

    @cached_property
    def hull(self) -> trimesh.Trimesh:
        """The convex hull."""
        hull: trimesh.Trimesh = trimesh.convex.convex_hull(self.mesh)
        return hull

    @property
    def size(self) -> float:
        """Diagonal of the bounding box, metres."""
        return float(np.linalg.norm(self.mesh.extents))

    @cached_property
    def _cavities(self) -> Cavities:
        return Cavities(self.mesh)

    @cached_property
    def _vertices(self) -> Array:
        return np.ascontiguousarray(self.mesh.vertices, dtype=np.float64)

    @cached_property
    def _faces(self) -> NDArray[np.int64]:
        return np.ascontiguousarray(self.mesh.faces, dtype=np.int64)


def solid_of(shapes: Sequence[Shape]) -> Solid:
    """The solid of shapes that are fixed to each other.

    Args:
        shapes: At least one.

    Raises:
        FitError: If there are no shapes, or all are flat.
        MeshError: If a mesh cannot be read.
    """
    if not shapes:
        raise FitError("there are no shapes")
    solids = [_solid_of_shape(shape) for shape in shapes]
    bulky = [solid for solid in solids if solid is not None]
    if not bulky:
        raise FitError("the shapes are flat: they have no volume")
    return _filled(bulky[0] if len(bulky) == 1 else _together(bulky))


def _together(bulky: Sequence[Solid]) -> Solid:
    counts = [solid.decimated_from or len(solid.mesh.faces) for solid in bulky]
    together = trimesh.util.concatenate([solid.mesh for solid in bulky])
    return Solid(
        cast(trimesh.Trimesh, together),
        max((solid.method for solid in bulky), key=METHODS.index),
        sum(counts) if any(solid.decimated_from for solid in bulky) else None,
    )


def solid_of_mesh(mesh: trimesh.Trimesh) -> Solid | None:
    """The solid of triangles in metres; None if they are flat."""
    if is_flat(np.asarray(mesh.vertices)):
        return None
    before = len(mesh.faces)
    if before > MAX_FACES:
        vertices, faces = fast_simplification.simplify(
            np.asarray(mesh.vertices, np.float32),
            np.asarray(mesh.faces, np.int32),
            target_count=DECIMATED,
        )
        mesh = trimesh.Trimesh(vertices, faces)
    turned, was_turned = _turned_outwards(mesh)
    method: Method = "repaired" if was_turned else "watertight"
    if not turned.is_watertight:
        turned = _closed(turned)
        method = "repaired" if turned.is_watertight else "winding"
    solid = Solid(turned, method, before if before > MAX_FACES else None)
    if method == "winding" and _is_hollow(solid):
        return Solid(solid.hull, "hull", solid.decimated_from)
    return solid


def _solid_of_shape(shape: Shape) -> Solid | None:
    geometry = shape.geometry
    mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
    placed = mesh.copy()
    placed.apply_transform(shape.T_link_shape.matrix)
    return solid_of_mesh(placed)


def _turned_outwards(mesh: trimesh.Trimesh) -> tuple[trimesh.Trimesh, bool]:
    """Every connected piece with its normals outwards, and whether anything had to be changed."""
    turned = _without_repeats(mesh)
    if not turned.is_winding_consistent:
        turned = turned.copy()
        trimesh.repair.fix_winding(turned)
    corners = turned.triangles
    piece = trimesh.graph.connected_component_labels(
        turned.face_adjacency, node_count=len(turned.faces)
    )
    size = np.bincount(piece)
    middle = np.stack(
        [np.bincount(piece, corners[:, :, i].mean(axis=1)) / size for i in range(3)], axis=1
    )
    local = corners - middle[piece][:, None]
    volumes = np.einsum("ij,ij->i", local[:, 0], np.cross(local[:, 1], local[:, 2])) / 6
    # A flat piece has no inside to turn away from.
    least = FLATNESS_TOLERANCE * np.bincount(piece, turned.area_faces) ** 1.5
    inverted = (np.bincount(piece, volumes) < -least)[piece]
    if not inverted.any():
        return turned, turned is not mesh
    faces = np.where(inverted[:, None], turned.faces[:, ::-1], turned.faces)
    return trimesh.Trimesh(turned.vertices, faces, process=False), True


def _without_repeats(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Of triangles on the same corners one is left, none of two that face each other.

    Two that face each other are a wall within a body, unless the whole mesh is there twice.
    """
    corners = np.sort(mesh.faces, axis=1)
    _, first, group = np.unique(corners, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(corners):
        return mesh
    after_least = mesh.faces[np.arange(len(corners)), (np.argmin(mesh.faces, axis=1) + 1) % 3]
    facing = np.bincount(group, np.where(after_least == corners[:, 1], 1, -1))
    kept = first[facing != 0] if facing.any() else first
    return trimesh.Trimesh(mesh.vertices, mesh.faces[np.sort(kept)], process=False)


def _closed(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Weld what nearly touches and fill small holes; unchanged if that does not close it."""
    welded = mesh.copy()
    digits = -int(np.floor(np.log10(_WELD * np.linalg.norm(mesh.extents))))
    welded.merge_vertices(digits_vertex=digits)
    welded.update_faces(welded.nondegenerate_faces())
    trimesh.repair.fill_holes(welded)
    return _turned_outwards(welded)[0] if welded.is_watertight else mesh


def _is_hollow(solid: Solid) -> bool:
    low, high = solid.mesh.bounds
    within = float(solid.contains(_probes(solid)).mean() * np.prod(high - low))
    return within < HOLLOW * float(solid.hull.volume)


def _filled(solid: Solid) -> Solid:
    """The solid with the room within filled, if it is a shell."""
    if solid.method == "hull":
        return solid
    filled = replace(solid, method="filled")
    points = _probes(solid)
    walls, body = solid.contains(points).sum(), filled.contains(points).sum()
    return filled if body > (1 + SHELL) * walls else solid


def _probes(solid: Solid) -> Array:
    low, high = solid.mesh.bounds
    return np.random.default_rng(0).uniform(low, high, (_PROBES, 3))


class Cavities:
    """Triangles, and which points around them are mostly surrounded by them."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        self._rays = RayMeshIntersector(mesh)

    def openness(self, points: Array) -> Array:
        """Share of all directions in which no triangle is met.

        It is at least one half outside of the convex hull.

        Args:
            points: Shape (n, 3), in the frame of the mesh.

        Returns:
            Shape (n,), in steps of ``1 / DIRECTIONS``.
        """
        if not len(points):
            return np.zeros(0)
        directions = _directions()
        meets = self._rays.intersects_any(
            np.repeat(points, DIRECTIONS, axis=0), np.tile(directions, (len(points), 1))
        )
        return np.asarray(1 - meets.reshape(len(points), DIRECTIONS).mean(axis=1))


def _directions() -> Array:
    """Directions spread evenly, shape (DIRECTIONS, 3): the Fibonacci lattice on the sphere.

    Equal steps along the axis cut zones of equal area; the golden angle spreads them around it.
    """
    step = np.arange(DIRECTIONS) + 0.5
    z = 1 - 2 * step / DIRECTIONS
    turn = np.pi * (1 + np.sqrt(5)) * step
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)

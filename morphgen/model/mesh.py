"""Triangles of mesh files, in metres: loading, colour groups and convex hulls, all cached.

What is computed of a mesh is kept in the user's cache, too, so that commands start without trimesh
and SciPy, whose import takes longer than composing a robot.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache, wraps
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from morphgen.errors import MeshError
from morphgen.files import content_sha256, file_stamp, keep, read_kept
from morphgen.model.geometry import Mesh, MeshContent, MeshPart, Rgba
from morphgen.typing import Array

if TYPE_CHECKING:
    import trimesh

    from morphgen.model.robot import Robot

T = TypeVar("T")

MAX_STL_FACES = 200_000  # number of triangles of the largest STL file that MuJoCo reads
MAX_ROBOT_BYTES = 96 * 2**20
"""Size of all mesh files of a robot [bytes]. The largest of 1,441 real robots, B1 with an arm, has
61 MiB."""
MAX_ROBOT_FACES = 1_500_000
"""Number of triangles in all mesh files of a robot. The largest, Vega, has 0.94 million."""
MAX_ROBOT_PIXELS = 2**26  # number of pixels in all textures of a robot's mesh files
FLATNESS_TOLERANCE = 1e-7  # ratio of thickness to size below which points count as flat


class Triangles(NamedTuple):
    """Triangles of a mesh; treat them as read-only."""

    vertices: Array  # shape (n, 3) [m]
    faces: NDArray[np.int64]  # shape (m, 3)


def _until_changed(function: Callable[[Mesh], T]) -> Callable[[Mesh], T]:
    """Cache the results of a function of a mesh; a file that changed is read again."""

    @lru_cache(maxsize=512)
    @wraps(function)
    def cached(mesh: Mesh, _stamp: tuple[int, int]) -> T:
        return function(mesh)

    @wraps(cached)
    def call(mesh: Mesh) -> T:
        return cached(replace(mesh, path=mesh.path.absolute()), file_stamp(mesh.path))

    return call


@_until_changed
def load_mesh(mesh: Mesh) -> trimesh.Trimesh:
    """Return the triangles of a mesh as an object of trimesh; see ``mesh_triangles``."""
    import trimesh  # here and below, because commands that change no mesh should start quickly

    return trimesh.Trimesh(*mesh_triangles(mesh), process=False)


@_until_changed
def mesh_triangles(mesh: Mesh) -> Triangles:
    """Return the triangles of a mesh in the frame of its URDF ``<mesh>`` [m], scale applied.

    Coincident vertices are merged, triangles without area are removed, and a mirroring scale keeps
    the normals pointing outwards. The result is cached until the file changes.
    """
    return kept_of_mesh("triangles", mesh, lambda: _make_scaled(mesh), Triangles)


def mesh_parts(path: Path) -> tuple[MeshPart, ...]:
    """Return the colour groups of a mesh file, in the order of their first triangles."""
    return _content(path).parts


def require_bounded_files(paths: Iterable[Path], origin: str) -> None:
    """Require that the mesh files of one robot have at most ``MAX_ROBOT_BYTES``."""
    size = sum(file_stamp(path)[1] for path in {*paths})
    _require_bounded(size, MAX_ROBOT_BYTES, "bytes", origin)


def require_bounded_meshes(robot: Robot) -> None:
    """Require few enough triangles and pixels, read until there are too many."""
    origin, faces, pixels = f"robot {robot.name!r}", 0, 0
    for path in dict.fromkeys(mesh.path for mesh in robot.meshes):
        with suppress(MeshError):
            content = _content(path)
            faces += sum(len(part.faces) for part in content.parts)
            pixels += content.pixels
        _require_bounded(faces, MAX_ROBOT_FACES, "triangles", origin)
        _require_bounded(pixels, MAX_ROBOT_PIXELS, "pixels of textures", origin)


def _require_bounded(count: int, most: int, what: str, origin: str) -> None:
    if count > most:
        raise MeshError(
            f"{origin}: its meshes have {count} {what} or more; at most {most} of one robot are "
            "read; decimate them"
        )


def left_out(path: Path) -> tuple[str, ...]:
    """Return what a mesh file holds beside its triangles and was left out, each as a phrase."""
    return _content(path).left_out


@_until_changed
def convex_hull(mesh: Mesh) -> trimesh.Trimesh:
    """Return the convex hull of a mesh as an object of trimesh; see ``hull_triangles``."""
    import trimesh

    return trimesh.Trimesh(*hull_triangles(mesh), process=False)


@_until_changed
def hull_triangles(mesh: Mesh) -> Triangles:
    """Return the triangles of the convex hull of a mesh [m]; cached until the file changes."""

    def make() -> Triangles:
        import trimesh

        vertices = mesh_triangles(mesh).vertices
        if is_flat(vertices):
            raise MeshError(f"{mesh.path}: is flat, so it has no convex hull")
        hull: trimesh.Trimesh = trimesh.convex.convex_hull(vertices)
        return Triangles(np.array(hull.vertices), np.array(hull.faces))

    return kept_of_mesh("hull", mesh, make, Triangles)


def is_flat(points: Array) -> bool:
    """Return whether points, shape (n, 3), lie in a plane or are fewer than four."""
    if len(points) < 4:
        return True
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(spread[2] <= FLATNESS_TOLERANCE * spread[0])


def kept_of_mesh(kind: str, mesh: Mesh, make: Callable[[], T], *types: type) -> T:
    """Return what is computed of a mesh, from the user's cache if it is there.

    Nothing is kept of a file that names others, which may change. Nor of a mesh with a factor that
    is no power of ten: it may have been drawn, and is hardly ever seen again.
    """
    if (key := mesh_key(mesh)) is None:
        return make()
    found: T | None = read_kept(kind, key, types)
    if found is None:
        found = make()
        if _content(mesh.path).self_contained:
            keep(kind, key, found)
    return found


def mesh_key(mesh: Mesh) -> tuple[object, ...] | None:
    """Return what identifies the content of a mesh; None for one of which nothing is kept."""
    path = mesh.path
    if not all(factor and math.log10(abs(factor)).is_integer() for factor in mesh.scale):
        return None
    if not path.is_file() or path.stat().st_size > MAX_ROBOT_BYTES:  # a pipe may never end
        return None
    return (content_sha256(path), path.suffix.lower(), mesh.scale, mesh.part)


def _make_scaled(mesh: Mesh) -> Triangles:
    path, scale, part = mesh.path, mesh.scale, mesh.part
    if len(scale) != 3 or not all(math.isfinite(s) and s != 0 for s in scale):
        raise MeshError(f"{path}: scale {scale} is not three finite numbers other than zero")
    parts = _content(path).parts
    if part is not None:
        if not 0 <= part < len(parts):
            raise MeshError(f"{path}: no part {part}; valid: 0 to {len(parts) - 1}")
        parts = (parts[part],)
    _, vertices, faces = _joined(None, parts)
    # A mirror turns triangles inside out.
    vertices, faces = _clean(vertices * scale, faces[:, ::-1] if math.prod(scale) < 0 else faces)
    if not len(faces):
        raise MeshError(f"{path}: no triangle has an area at scale {scale}")
    return Triangles(vertices, faces)


def _content(path: Path) -> MeshContent:
    if not path.exists():
        raise MeshError(f"{path}: no such file or directory")
    content = _content_or_fault(str(path.absolute()), file_stamp(path))
    if isinstance(content, str):
        raise MeshError(content)
    return content


@lru_cache(maxsize=128)
def _content_or_fault(path: str, stamp: tuple[int, int]) -> MeshContent | str:
    """Return what a file holds, or why it is refused: a large one is refused only once."""
    key = mesh_key(Mesh(Path(path)))
    if key is not None:
        found: MeshContent | None = read_kept("content", key, (MeshContent, MeshPart))
        if found is not None:
            return found
    from morphgen.model.mesh_files import read_mesh_file

    try:
        content = read_mesh_file(Path(path))
    except MeshError as error:
        return str(error)
    by_colour: dict[Rgba | None, list[MeshPart]] = {}
    for part in content.parts:
        by_colour.setdefault(part.rgba, []).append(part)
    joined = (_joined(rgba, parts) for rgba, parts in by_colour.items())
    cleaned = (MeshPart(part.rgba, *_clean(part.vertices, part.faces)) for part in joined)
    parts = tuple(part for part in cleaned if len(part.faces))
    if not parts:
        count = sum(len(part.faces) for part in content.parts)
        return f"{path}: none of its {count} triangles has an area"
    content = replace(content, parts=parts)
    if key is not None and content.self_contained:
        keep("content", key, content)
    return content


def _joined(rgba: Rgba | None, parts: Sequence[MeshPart]) -> MeshPart:
    starts = np.cumsum([0, *(len(part.vertices) for part in parts[:-1])])
    faces = [part.faces + start for part, start in zip(parts, starts, strict=True)]
    vertices = np.concatenate([part.vertices for part in parts])
    return MeshPart(rgba, vertices, np.concatenate(faces))


def _clean(vertices: Array, faces: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
    """Merge coincident vertices; remove unused ones and triangles without area."""
    import trimesh

    merged = trimesh.Trimesh(vertices, faces, process=False)
    merged.merge_vertices(merge_tex=True, merge_norm=True)
    corners = merged.triangles
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    merged.update_faces(np.linalg.norm(normals, axis=1) > 0)
    merged.remove_unreferenced_vertices()
    return np.array(merged.vertices), np.array(merged.faces)

"""Replace the collision shapes of a robot: by fitted primitives, or by convex pieces.

Simulators collide the convex hull of a mesh, which fills its concave places. CoACD cuts the mesh
where its hull encloses most empty space (Wei, Liu, Ling and Su, "Approximate convex decomposition
for 3D meshes with collision-aware concavity and tree search", 2022).
"""

from __future__ import annotations

import importlib
import json
import logging
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from platformdirs import user_cache_path

from morphgen.checks.self_collision import survey_collisions
from morphgen.errors import FitError, FormatError, one_line
from morphgen.files import keep_file
from morphgen.formats.files import replacing_folder
from morphgen.formats.fits import (
    FITTER_VERSION,
    find_fit,
    fits_of_copies,
    fits_text,
    has_meshes,
    read_fits,
    read_stored_fits,
    shapes_key,
    shapes_scale,
)
from morphgen.formats.rounding import as_written
from morphgen.model.geometry import Mesh, Shape, StoredFit, StoredFits
from morphgen.model.mesh import convex_hull, is_flat, load_mesh
from morphgen.model.robot import Link, Robot
from morphgen.progress import report
from morphgen.typing import Array

if TYPE_CHECKING:
    import trimesh

    from morphgen.fitting.link_fit import FitOptions
    from morphgen.fitting.robot_fit import FitReport

_LOGGER = logging.getLogger(__name__)
_CACHE = "fits-3"
"""Folder in the user's cache; the number rises when the same shapes get other primitives."""
Geometry = Literal["mesh", "primitive", "convex"]
"""Collision shapes of a robot. ``mesh``: those of its parts, with meshes whose hulls simulators
collide. In place of meshes, ``primitive``: fitted boxes, cylinders and spheres; ``convex``: convex
pieces."""
GEOMETRIES: tuple[Geometry, ...] = get_args(Geometry)


def with_geometry(robot: Robot, geometry: str, folders: Sequence[Path]) -> Robot:
    """Return the robot with the collision shapes of a geometry."""
    changes = {"primitive": as_primitives, "convex": as_convex}
    return changes[geometry](robot, folders) if geometry in changes else robot


def as_primitives(robot: Robot, folders: Sequence[Path]) -> Robot:
    """Return the robot as tasks use it: fitted collision primitives, numbers rounded as in a file.

    Fits that the robot carries or that the folders store are used; other meshes are fitted once,
    which is logged and cached. A robot, its bundle and the result of this function give the same.
    """
    fits = _known_fits(robot, read_stored_fits(folders))
    if missing := _meshed_links(robot, fits):
        fits |= _cached_fits(missing)
    if missing := _meshed_links(robot, fits):
        fits |= _fit_and_keep(robot, missing)
    fitted = with_primitives(robot, {link: fit.collision for link, fit in fits.items()})
    provenance = {**fitted.provenance, "primitives": {"fitter": FITTER_VERSION}}
    return replace(with_fits(fitted, fits), provenance=provenance)


def _cached_fits(links: Iterable[Link]) -> dict[str, StoredFit]:
    """Return the fits of links with collision shapes that are in the cache, by link name."""
    fits = {}
    for link in links:
        key = shapes_key(link.collisions)
        path = _path(key)
        if not path.is_file():
            continue
        try:
            fit = read_fits(path).get(key)
        except FormatError as error:
            raise FormatError(f"{error}; delete the file") from error
        if fit is not None:
            fits[link.name] = replace(fit.scaled(shapes_scale(link.collisions)), link=link.name)
    return fits


def _fit_and_keep(robot: Robot, links: Sequence[Link]) -> dict[str, StoredFit]:
    """Fit links with collision shapes, say so, keep the fits in the cache, and return them."""
    from morphgen.fitting.robot_fit import COLLISION_OPTIONS, fit_links, fits_of  # the extra fit

    _LOGGER.warning(
        "fitting primitives to %d links of robot %r; the fits are kept", len(links), robot.name
    )
    report = fit_links(robot, COLLISION_OPTIONS, only=[link.name for link in links])
    for finding in report.findings:
        if finding.severity != "info":
            raise FitError(f"{finding.where}: {finding.why}")
    fits = fits_of(robot, report, {})
    for name, fit in fits.items():
        shapes = robot.link(name).collisions
        key = shapes_key(shapes)
        text = fits_text({key: fit.scaled(1 / shapes_scale(shapes))})
        keep_file(_path(key), text, "fits")
    return fits


def _path(key: str) -> Path:
    return user_cache_path("morphgen") / _CACHE / f"{key}.json"


def _meshed_links(robot: Robot, fits: Mapping[str, StoredFit]) -> list[Link]:
    """Return the links that collide as meshes and have no fit."""
    return [link for link in robot.links if link.name not in fits and has_meshes(link.collisions)]


def with_fits(robot: Robot, fits: Mapping[str, StoredFit]) -> Robot:
    """Return a robot with collision primitives with the fits that they are of, for its tokens."""
    fits_at_scale = (
        replace(fits[link.name], collision=link.collisions)
        for link in robot.links
        if link.name in fits and link.collisions
    )
    return replace(robot, fits={shapes_key(fit.collision): fit for fit in fits_at_scale})


def with_primitives(robot: Robot, primitives: Mapping[str, Sequence[Shape]]) -> Robot:
    """Return the robot with other collision primitives by link, numbers rounded as in a file.

    The pairs whose contacts are ignored are determined again. A link without an entry keeps its
    collision shapes if they are primitives, and loses them if they are meshes.
    """
    links = tuple(
        replace(link, collisions=_collisions(link, primitives.get(link.name)))
        for link in robot.links
    )
    fitted = as_written(replace(robot, links=links, ignore_pairs=()))
    return replace(fitted, ignore_pairs=survey_collisions(fitted).ignore_pairs)


def _collisions(link: Link, shapes: Sequence[Shape] | None) -> tuple[Shape, ...]:
    if shapes is None:
        shapes = () if has_meshes(link.collisions) else link.collisions
    return tuple(shapes) if link.collisions else ()


def _known_fits(robot: Robot, stored: StoredFits) -> dict[str, StoredFit]:
    """Return the fits that the robot carries or that are stored, by link name."""
    fits = {link.name: find_fit(link.collisions, robot, stored) for link in robot.links}
    return {name: fit for name, fit in fits.items() if fit}


@dataclass(frozen=True)
class FittedRobot:
    """A fit of primitives to a robot."""

    source: Robot
    """The robot whose shapes were fitted."""
    report: FitReport
    """The primitives of each link, and their measured quality."""
    folders: tuple[Path, ...] = ()
    """Folders of parts, for their stored fits."""

    @cached_property
    def robot(self) -> Robot:
        """The same robot with the primitives as its collision shapes, made at the first access.

        Its provenance has the report.

        Raises:
            MeshError: If a mesh cannot be read.
            RobotError: If a joint axis is zero.
        """
        from morphgen.fitting.robot_fit import fits_of

        primitives = {row.link: row.fit.primitives for row in self.report.links}
        fits = fits_of(self.source, self.report, read_stored_fits(self.folders))
        fitted = with_fits(with_primitives(self.source, primitives), fits)
        provenance = {**self.source.provenance, "primitives": self.report.as_dict()}
        return replace(fitted, provenance=provenance)


def mesh_robot(path: Path) -> Robot:
    """Return a robot of one link with a mesh file as its shape."""
    return Robot(path.stem, (Link(path.stem, collisions=(Shape(Mesh(path)),)),), ())


def fit_robot(
    robot: Robot, options: FitOptions, folders: tuple[Path, ...] = (), *, jobs: int = 1
) -> FittedRobot:
    """Fit primitives to a robot's links."""
    from morphgen.fitting.robot_fit import fit_links  # needs the extra fit

    if not any(link.solid_shapes for link in robot.links):
        raise FitError(f"robot {robot.name!r}: no link has a shape")
    report = fit_links(robot, options, jobs=jobs)
    if not report.links:
        raise FitError(
            f"robot {robot.name!r}: {report.findings[0].where}: {report.findings[0].why}"
        )
    return FittedRobot(robot, report, folders)


MAX_PIECES = 16  # largest number of convex pieces of one mesh
MAX_SECONDS = 300  # longest time that the decomposition of one mesh may take [s]
MAX_DIRECT_FACES = 5_000
"""Number of triangles above which CoACD cuts a coarser remesh of the surface."""
CONVEX_SHARE = 0.99
"""Share of its hull's volume from which a closed mesh counts as convex and stays as it is."""
MAX_REASON = 120
"""Largest part of an error of CoACD that is shown [characters]; its assertions fill a page."""
MIN_SHARE = 1e-5  # volume of the smallest piece that is kept, relative to the hull of the mesh
SETTINGS = {
    "threshold": 0.05,
    "max_convex_hull": MAX_PIECES,
    "preprocess_resolution": 30,
    "resolution": 1000,
    "mcts_nodes": 10,
    "mcts_iterations": 60,
    "decimate": True,
    "max_ch_vertex": 64,
    "seed": 0,
}
"""Arguments of ``coacd.run_coacd``: its default concavity, and a coarser search than its default,
which takes a fifth of the time on the UR5. A piece has at most 64 vertices."""
_CONVEX_CACHE = "convex-1"
"""Folder in the user's cache; the number rises when the same mesh gets other pieces."""
_PIECE = "piece-{:02d}.stl"


def as_convex(robot: Robot, folders: Sequence[Path] = ()) -> Robot:
    """Return the robot with convex pieces in place of its collision meshes.

    Pieces are kept in the user's cache, so a mesh is decomposed once, in seconds to minutes. A
    convex mesh stays, and so do primitives: the result of this function, and its bundle, give
    themselves. The pairs whose contacts are ignored are determined again.
    """
    meshed = [link for link in robot.links if has_meshes(link.collisions)]
    shapes = [shape for link in meshed for shape in link.collisions]
    meshes = dict.fromkeys(
        replace(shape.geometry, scale=(1.0, 1.0, 1.0))
        for shape in shapes
        if isinstance(shape.geometry, Mesh) and not _is_convex(shape.geometry)
    )
    if not meshes:
        return robot
    importlib.import_module("coacd")
    cache = user_cache_path("morphgen") / _CONVEX_CACHE / version("coacd")
    folder_of = {mesh: cache / shapes_key([Shape(mesh)]) for mesh in meshes}
    missing = [mesh for mesh in meshes if not folder_of[mesh].is_dir()]
    if missing:
        _LOGGER.warning(
            "cutting %d meshes of robot %r into convex pieces, seconds to minutes for each; the "
            "pieces are kept",
            len(missing),
            robot.name,
        )
    for done, mesh in enumerate(missing):
        report(done, len(missing))
        _write_pieces(decompose(mesh), folder_of[mesh])
    report(len(missing), len(missing))
    pieces = {mesh: sorted(folder.iterdir()) for mesh, folder in folder_of.items()}
    collisions = {
        link.name: tuple(piece for shape in link.collisions for piece in _pieces_of(shape, pieces))
        for link in meshed
    }
    convex = with_primitives(
        robot, {link.name: collisions.get(link.name, link.collisions) for link in robot.links}
    )
    return replace(
        convex,
        fits=fits_of_copies(robot, convex, read_stored_fits(folders)),  # so tokens stay the same
        provenance={**convex.provenance, "convex": {"coacd": version("coacd"), **SETTINGS}},
    )


def decompose(mesh: Mesh) -> list[trimesh.Trimesh]:
    """Return 1 to ``MAX_PIECES`` closed convex meshes that cover a mesh approximately.

    The result depends on the mesh, ``SETTINGS`` and the version of CoACD alone: CoACD runs in one
    thread and with a seed.
    """
    import trimesh  # here and below, because commands that cut no mesh should start quickly

    importlib.import_module("coacd")
    triangles, hull = load_mesh(mesh), convex_hull(mesh)
    # CoACD's own test whether a mesh needs a remesh ("auto") aborts on some meshes.
    modes = ("on",) if len(triangles.faces) > MAX_DIRECT_FACES else ("auto", "on")
    for mode in modes:
        points, failure = _run_coacd(mesh, {**SETTINGS, "preprocess_mode": mode})
        if points is not None:
            break
    else:
        raise FitError(
            f"{mesh.path}: CoACD fails on this mesh: {failure}; repair it, or use primitives"
        )
    hulls = [trimesh.convex.convex_hull(vertices) for vertices in points if not is_flat(vertices)]
    pieces = [piece for piece in hulls if piece.volume > MIN_SHARE * hull.volume]
    if not pieces:
        raise FitError(
            f"{mesh.path}: CoACD finds no convex piece with a volume; repair the mesh, or use "
            "primitives"
        )
    return pieces


def _run_coacd(mesh: Mesh, settings: Mapping[str, object]) -> tuple[list[Array] | None, str]:
    """Return the vertices of each piece, or None and why CoACD failed."""
    triangles = load_mesh(mesh)
    with tempfile.TemporaryDirectory() as scratch:
        source, result = Path(scratch) / "mesh.npz", Path(scratch) / "pieces.npz"
        np.savez(source, vertices=triangles.vertices, faces=triangles.faces)
        script = Path(__file__).with_name("coacd_process.py")
        # -P: modules are not looked for in the folder of the script.
        command = [sys.executable, "-P", str(script), str(source), str(result)]
        try:
            done = subprocess.run(
                [*command, json.dumps(settings)],
                timeout=MAX_SECONDS,
                capture_output=True,
                text=True,
                check=False,
                env={**os.environ, "OMP_NUM_THREADS": "1"},  # else the order of sums varies
            )
        except subprocess.TimeoutExpired as error:
            raise FitError(
                f"{mesh.path}: CoACD takes longer than {MAX_SECONDS} s for {len(triangles.faces)} "
                "triangles; simplify the mesh, or use primitives"
            ) from error
        if done.returncode or not result.is_file():
            words = done.stderr.strip().splitlines() or [f"exit code {done.returncode}"]
            return None, one_line(words[-1])[:MAX_REASON]
        with np.load(result, allow_pickle=False) as arrays:
            return [np.asarray(arrays[name]) for name in sorted(arrays)], ""


def _is_convex(mesh: Mesh) -> bool:
    triangles = load_mesh(mesh)
    hull_volume = convex_hull(mesh).volume
    return bool(triangles.is_watertight and triangles.volume >= CONVEX_SHARE * hull_volume)


def _write_pieces(pieces: Sequence[trimesh.Trimesh], folder: Path) -> None:
    from trimesh.exchange.stl import export_stl

    with replacing_folder(folder) as partial:
        for i, piece in enumerate(pieces):
            (partial / _PIECE.format(i)).write_bytes(export_stl(piece))


def _pieces_of(shape: Shape, pieces: dict[Mesh, list[Path]]) -> list[Shape]:
    """Return the pieces of a shape; the shape itself if it was not decomposed."""
    if not isinstance(mesh := shape.geometry, Mesh):
        return [shape]
    files = pieces.get(replace(mesh, scale=(1.0, 1.0, 1.0)))
    if files is None:
        return [shape]
    return [replace(shape, geometry=Mesh(file, mesh.scale)) for file in files]

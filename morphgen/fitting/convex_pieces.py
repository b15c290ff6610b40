"""Replace the collision meshes of a robot by convex pieces (approximate convex decomposition).

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
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
import trimesh
from platformdirs import user_cache_path
from trimesh.exchange.stl import export_stl

from morphgen.errors import FitError, one_line
from morphgen.fitting.replace_collision import with_primitives
from morphgen.formats.files import replacing_folder
from morphgen.formats.fits import find_fit, has_meshes, read_stored_fits, shapes_key, shapes_scale
from morphgen.model.geometry import Mesh, Shape, StoredFit
from morphgen.model.mesh import convex_hull, is_flat, load_mesh
from morphgen.model.robot import Robot
from morphgen.progress import report
from morphgen.typing import Array

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
_LOGGER = logging.getLogger(__name__)
_CACHE_DIR = "convex-1"
"""Folder in the user's cache; the number rises when the same mesh gets other pieces."""
_PIECE = "piece-{:02d}.stl"


def as_convex(robot: Robot, folders: Sequence[Path] = ()) -> Robot:
    """Return the robot with convex pieces in place of its collision meshes.

    Pieces are kept in the user's cache under the content of the mesh file, so a mesh is decomposed
    once, in seconds to minutes. A mesh that is convex stays as it is, and so do primitives: the
    result of this function, and its bundle, give themselves. Masses, inertias and fits of
    primitives stay. The pairs of links whose contacts are ignored are determined again.
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
    cache = user_cache_path("morphgen") / _CACHE_DIR / version("coacd")
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
        fits=_fits_of_pieces(robot, convex, folders),
        provenance={**convex.provenance, "convex": {"coacd": version("coacd"), **SETTINGS}},
    )


def decompose(mesh: Mesh) -> list[trimesh.Trimesh]:
    """Return 1 to ``MAX_PIECES`` closed convex meshes that cover a mesh approximately.

    The result depends on the mesh, ``SETTINGS`` and the version of CoACD alone: CoACD runs in one
    thread and with a seed.
    """
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


def _fits_of_pieces(robot: Robot, convex: Robot, folders: Sequence[Path]) -> dict[str, StoredFit]:
    """Return the fits of primitives under the keys of the pieces, so that tokens stay the same."""
    stored = read_stored_fits(folders)
    fits = {}
    for link in robot.links:
        if fit := find_fit(link.collisions, robot, stored):
            shapes = convex.link(link.name).collisions
            fits[shapes_key(shapes)] = fit.scaled(1 / shapes_scale(shapes))
    return fits

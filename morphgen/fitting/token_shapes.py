"""The single primitive that represents each link in its token."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from platformdirs import user_cache_path

from morphgen.errors import FitError, FormatError
from morphgen.fitting.canonical import canonical
from morphgen.fitting.composite import fit_composite
from morphgen.formats.data_files import read_json
from morphgen.formats.fits import (
    ShapeRecord,
    are_primitives,
    find_fit,
    keep_fit,
    read_stored_fits,
    shape_to_data,
    shapes_key,
    shapes_scale,
)
from morphgen.formats.records import read_record
from morphgen.formats.rounding import rounded_shapes
from morphgen.formats.urdf_capsules import urdf_pieces
from morphgen.model.geometry import Shape, scale_shape
from morphgen.model.inertia import union_integrals
from morphgen.model.robot import Robot
from morphgen.processes import Progress, no_progress

_LOGGER = logging.getLogger(__name__)
_CACHE_DIR = "tokens-4"
"""Folder in the user's cache; the number rises when the same shapes get another primitive."""
DOMINANT_SHARE = 0.95
"""Share of a link's volume from which its largest primitive represents it. The primitive lies in
the union, so this is also their intersection over union."""


def token_shapes(
    robot: Robot, folders: Sequence[Path] = (), *, progress: Progress = no_progress
) -> dict[str, Shape]:
    """Return the box, cylinder or sphere that overlaps the collision shapes of each link most.

    A token describes collision geometry: a link with visuals only, such as a rail or a mast, has
    no primitive. The primitive of a link comes from the first source that has one:

    1. the fits that the robot carries, then those stored in the folders;
    2. a primitive of the link that has most of its volume (``DOMINANT_SHARE``), in its canonical
       pose;
    3. the user's cache;
    4. a new fit, about a second per link, which is then cached. A fit to primitives is the same on
       every machine (``composite``). A fit to meshes depends on the last bits of floating-point
       numbers, so it may differ between machines.

    Args:
        robot: The robot.
        folders: Folders of parts, for their stored fits.
        progress: Receives the number of new fits that are done, and of all that are needed.

    Returns:
        Primitives by link name, without links that have no collision shapes or no volume.

    Raises:
        FormatError: If a stored or cached fit is malformed.
        MeshError: If a mesh cannot be read.
    """
    stored = read_stored_fits(folders)
    primitives: dict[str, Shape | None] = {}
    missing: list[tuple[str, tuple[Shape, ...], Path]] = []
    for link in robot.links:
        if not link.collisions:
            continue
        pieces = (piece for shape in link.collisions for piece in urdf_pieces(shape))
        shapes = rounded_shapes(tuple(pieces))
        if fit := find_fit(link.collisions, robot, stored):
            primitives[link.name] = fit.token
        elif dominant := _dominant_primitive(shapes):
            primitives[link.name] = dominant
        else:
            path = user_cache_path("morphgen") / _CACHE_DIR / f"{shapes_key(shapes)}.json"
            if path.is_file():
                primitives[link.name] = _read_cached(path, shapes_scale(shapes))
            else:
                primitives[link.name] = None  # keeps the order of the links
                missing.append((link.name, shapes, path))
    if num_meshes := sum(not are_primitives(shapes) for _, shapes, _ in missing):
        _LOGGER.warning(
            "fitting the primitives of tokens to %d links of robot %r, a second or more for each; "
            "they are kept",
            num_meshes,
            robot.name,
        )
    for done, (name, shapes, path) in enumerate(missing):
        progress(done, len(missing))
        primitives[name] = fit_primitive(shapes)
        _write_cached(path, primitives[name], shapes_scale(shapes))
    if missing:
        progress(len(missing), len(missing))
    return {name: shape for name, shape in primitives.items() if shape}


def token_of_primitives(shapes: Sequence[Shape]) -> Shape | None:
    """Return the token's primitive of a link with primitives; None if they have no volume."""
    shapes = rounded_shapes(tuple(shapes))
    return _dominant_primitive(shapes) or fit_composite(shapes)


def fit_primitive(shapes: Sequence[Shape]) -> Shape | None:
    """Fit one primitive to shapes that are fixed to each other; None if they have no volume."""
    if are_primitives(shapes):
        return fit_composite(shapes)
    # The search needs torch, which takes seconds to load.
    from morphgen.fitting.link_fit import FitOptions, fit_shapes

    try:
        return fit_shapes(shapes, FitOptions()).primitives[0]
    except FitError:
        return None


def _dominant_primitive(shapes: Sequence[Shape]) -> Shape | None:
    """Return the primitive to which the other primitives of a link add next to no volume.

    It is in its canonical pose.
    """
    if not are_primitives(shapes):
        return None
    largest = max(shapes, key=lambda shape: union_integrals([shape]).volume)
    share = union_integrals([largest]).volume / union_integrals(shapes).volume
    return canonical(replace(largest, rgba=None)) if share >= DOMINANT_SHARE else None


def _read_cached(path: Path, scale: float) -> Shape | None:
    """Read a cached fit, which has the scale 1."""
    try:
        data = read_json(path)
        record = None if data is None else read_record(data, ShapeRecord, str(path))
    except FormatError as error:
        raise FormatError(f"{error}; delete the file") from error
    return None if record is None else scale_shape(record.shape, scale)


def _write_cached(path: Path, shape: Shape | None, scale: float) -> None:
    data = None if shape is None else shape_to_data(scale_shape(shape, 1 / scale))
    keep_fit(path, json.dumps(data))

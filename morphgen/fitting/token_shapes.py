"""The one primitive that stands for each link in its token."""

from __future__ import annotations

import json
import warnings
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from platformdirs import user_cache_path

from morphgen.errors import FitError, FormatError
from morphgen.fitting.canonical import canonical
from morphgen.fitting.composite import composite
from morphgen.formats.data_files import read_json
from morphgen.formats.files import write_cache_file
from morphgen.formats.fits import (
    ShapeRecord,
    are_primitives,
    find_fit,
    read_stored_fits,
    shape_to_data,
    shapes_key,
    shapes_scale,
)
from morphgen.formats.records import read_record
from morphgen.formats.rounding import rounded_shapes
from morphgen.model.geometry import Shape, scale_shape
from morphgen.model.inertia import union_integrals
from morphgen.model.robot import Robot

_KEPT = "tokens-4"
"""Folder in the user's cache; the number rises when the same shapes are given another primitive."""
NEARLY = 0.95
"""Share of a link's volume from which its largest primitive stands for it; this is the IoU, too."""


def token_shapes(robot: Robot, folders: Sequence[Path] = ()) -> dict[str, Shape]:
    """The box, cylinder or sphere that overlaps the collision shapes of each link most.

    A token describes what collides: a link that is only seen, such as a rail or a mast, has no
    primitive. A fit that the robot brings or that is stored in the folders is taken. A link that is
    a primitive, or nearly is (``NEARLY``), keeps it in its canonical pose; others are fitted,
    about a second a link, and kept in the user's cache. What is fitted to primitives is the same on
    every machine (``composite``); of meshes that nothing is stored for the last bits may differ,
    and with them the fit.

    Args:
        robot: The body.
        folders: Folders of parts, for their stored fits.

    Returns:
        By link; links without collision shapes, and those without volume, are not in it.

    Raises:
        FormatError: If a stored fit is malformed.
        MeshError: If a mesh cannot be read.
    """
    stored = read_stored_fits(folders)
    found = {}
    for link in robot.links:
        if not link.collisions:
            continue
        shapes = rounded_shapes(link.collisions)
        if fit := find_fit(link.collisions, robot, stored):
            found[link.name] = fit.token
        elif main := _main_primitive(shapes):
            found[link.name] = canonical(replace(main, rgba=None))
        elif shape := _cached_fit(shapes):
            found[link.name] = shape
    return found


def _main_primitive(shapes: Sequence[Shape]) -> Shape | None:
    """The shape that the others hardly add to, if it is a primitive."""
    if not are_primitives(shapes):
        return None
    largest = max(shapes, key=lambda shape: union_integrals([shape]).volume)
    share = union_integrals([largest]).volume / union_integrals(shapes).volume
    return largest if share >= NEARLY else None


def _cached_fit(shapes: Sequence[Shape]) -> Shape | None:
    """The fit of shapes that nothing is stored for; None if they have no volume."""
    factor = shapes_scale(shapes)
    path = user_cache_path("morphgen") / _KEPT / f"{shapes_key(shapes)}.json"
    if path.is_file():
        try:
            data = read_json(path)
            record = None if data is None else read_record(data, ShapeRecord, str(path))
        except FormatError as error:
            raise FormatError(f"{error}; delete the file") from error
        return None if record is None else scale_shape(record.shape, factor)
    shape = _fitted(shapes)
    data = None if shape is None else shape_to_data(scale_shape(shape, 1 / factor))
    try:
        write_cache_file(path, json.dumps(data))
    except OSError as error:
        warnings.warn(f"cannot keep a fit in {path}: {error.strerror}", stacklevel=3)
    return shape


def _fitted(shapes: Sequence[Shape]) -> Shape | None:
    if are_primitives(shapes):
        return composite(shapes)
    # The search needs torch, which takes seconds to load.
    from morphgen.fitting.link_fit import FitOptions, fit_shapes

    try:
        return fit_shapes(shapes, FitOptions()).primitives[0]
    except FitError:
        return None

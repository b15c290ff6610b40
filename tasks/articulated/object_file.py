"""Articulated objects as text: a URDF without meshes."""

from __future__ import annotations

from pathlib import Path

from morphgen.errors import MorphgenError, SimulationError
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf.read import robot_from_xml
from morphgen.model.robot import Robot


def read_body(text: str) -> Robot:
    """Return the object of a URDF's text, which may come from strangers: it has no files.

    Raises:
        SimulationError: If it is no URDF, or has meshes.
    """
    if "<mesh" in text:
        raise SimulationError("the object has meshes; expected primitives")
    where = Path("object.urdf")
    try:
        return robot_from_xml(text.encode(), where, default_finder(), written_frames=True)
    except MorphgenError as error:
        raise SimulationError(f"the object: {error}") from error

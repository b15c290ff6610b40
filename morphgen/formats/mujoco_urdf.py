"""What MuJoCo must be told to load a URDF as the other loaders do."""

from __future__ import annotations

BOUND_MASS = 1e-12
"""Mass MuJoCo gives to a link without any, kg: it refuses a moving body that weighs nothing."""
BOUND_INERTIA = 1e-14
"""Smallest principal inertia MuJoCo lets a link have, kg m^2."""

MJCF_COMPILER_ATTRIBUTES: dict[str, str] = {
    "angle": "radian",
    "inertiafromgeom": "false",
    "boundmass": f"{BOUND_MASS:g}",
    "boundinertia": f"{BOUND_INERTIA:g}",
}
"""Attributes of ``<compiler/>`` in MJCF: inertias as written, links without mass legal."""

MUJOCO_COMPILER_ATTRIBUTES: dict[str, str] = {
    "strippath": "false",
    "fusestatic": "false",
    "discardvisual": "true",
    "boundmass": f"{BOUND_MASS:g}",
    "boundinertia": f"{BOUND_INERTIA:g}",
}
"""Attributes of ``<mujoco><compiler/></mujoco>`` inside a URDF's ``<robot>``.

Mesh paths are kept relative to the URDF (MuJoCo >= 3.7 respects this), links on fixed joints,
the tool among them, stay bodies with a name, and links without mass stay legal. Visual meshes
are not loaded: a flat one, harmless to every other loader, stops MuJoCo's URDF reader, and the
MJCF beside the URDF is the way to see the robot in MuJoCo.
"""

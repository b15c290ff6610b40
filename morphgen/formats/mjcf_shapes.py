"""Shapes of compiled MuJoCo models."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from morphgen.formats.mjcf_bodies import FLOOR_GEOMS, WORLD, body_label
from morphgen.formats.mjcf_document import GEOM_TYPES, MjcfDocument, listed
from morphgen.formats.mjcf_meshes import ellipsoid_mesh
from morphgen.model import rotation
from morphgen.model.findings import Finding
from morphgen.model.geometry import (
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Pose,
    Rgba,
    Shape,
    Sphere,
)
from morphgen.typing import Array

_GEOM = mujoco.mjtGeom
_LAST_DRAWN_GROUP = 2
"""Last geom group that MuJoCo's viewers show."""
_DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)
"""Colour of a geom that names none."""


@dataclass(frozen=True)
class BodyShapes:
    """Shapes of a body, in the body's frame."""

    visuals: tuple[Shape, ...]
    collisions: tuple[Shape, ...]
    ellipsoids: tuple[str, ...] = ()
    """Labels of the geoms that are ellipsoids, which meshes approximate."""

    def moved(self, T_link_body: Pose) -> BodyShapes:
        """Return the shapes in the frame of a link."""
        if T_link_body.is_identity:
            return self
        visuals, collisions = (
            tuple(replace(s, T_link_shape=T_link_body @ s.T_link_shape) for s in shapes)
            for shapes in (self.visuals, self.collisions)
        )
        return replace(self, visuals=visuals, collisions=collisions)


def body_shapes(
    spec: mujoco.MjSpec, model: mujoco.MjModel, body: int, document: MjcfDocument
) -> BodyShapes:
    """Return the shapes of a body.

    A geom without contacts (``contype`` and ``conaffinity`` are zero) in groups 0 to 2 is a visual
    shape. A geom with contacts, or one of a ``<pair>``, is a collision shape; those of groups 0 to
    2 are drawn, too, if the body has no visual shapes of its own. Planes and height fields of the
    world are its floor and left out, as are geoms that neither touch nor are drawn.

    An ellipsoid becomes a convex mesh of its volume, or a sphere if its radii are equal.

    MuJoCo moves meshes to their centre of mass and principal axes; the shapes are again in the
    coordinates of the mesh files.

    Raises:
        FormatError: If a geom has no counterpart, such as a plane of a body.
    """
    first = model.body_geomadr[body]
    geoms = range(first, first + model.body_geomnum[body])
    paired = {*model.pair_geom1.tolist(), *model.pair_geom2.tolist()}
    visuals: list[Shape] = []
    collisions: list[Shape] = []
    drawn: list[Shape] = []
    refused: dict[str, list[str]] = {}
    ellipsoids: list[str] = []
    for geom in geoms:
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom]) or geom in paired
        rgba = _rgba(model, geom)
        is_drawn = model.geom_group[geom] <= _LAST_DRAWN_GROUP and (rgba is None or rgba[3] > 0)
        kind = _GEOM(model.geom_type[geom])
        is_floor = body == WORLD and kind in FLOOR_GEOMS
        if is_floor or not (touches or is_drawn):
            continue
        geometry, T_body_shape = _geometry(spec, model, geom, document)
        name = model.geom(geom).name or f"(of {body_label(model, body)})"
        if kind == _GEOM.mjGEOM_ELLIPSOID and isinstance(geometry, Mesh):
            ellipsoids.append(name)
        if geometry is None:
            refused.setdefault(kind.name.removeprefix("mjGEOM_").lower(), []).append(name)
            continue
        shape = Shape(geometry, T_body_shape)
        if touches:
            collisions.append(shape)
        if is_drawn:
            (drawn if touches else visuals).append(replace(shape, rgba=rgba))
    for form, names in refused.items():
        raise document.error(f"geom {listed(names)}: type {form}; expected {GEOM_TYPES}")
    return BodyShapes(tuple(visuals or drawn), tuple(collisions), tuple(ellipsoids))


def ellipsoid_findings(geoms: Sequence[str], document: MjcfDocument) -> tuple[Finding, ...]:
    """Return a finding about ellipsoids that became meshes; none without ellipsoids."""
    if not geoms:
        return ()
    return (
        Finding(
            "ellipsoid-mesh",
            "info",
            f"{document.path.name}: geom {listed(geoms)}",
            "a robot has no ellipsoids",
            "use a capsule, if the shape has to be exact",
            "became a convex mesh of the volume of the ellipsoid",
        ),
    )


def _geometry(
    spec: mujoco.MjSpec, model: mujoco.MjModel, geom: int, document: MjcfDocument
) -> tuple[Geometry | None, Pose]:
    """Return a geom's geometry and its pose in the body's frame; None if it has no counterpart."""
    a, b, c = model.geom_size[geom].tolist()
    T_body_geom = pose_of(model.geom_pos[geom], model.geom_quat[geom])
    match _GEOM(model.geom_type[geom]):
        case _GEOM.mjGEOM_BOX:
            return Box((2 * a, 2 * b, 2 * c)), T_body_geom
        case _GEOM.mjGEOM_SPHERE:
            return Sphere(a), T_body_geom
        case _GEOM.mjGEOM_CYLINDER:
            return Cylinder(a, 2 * b), T_body_geom
        case _GEOM.mjGEOM_CAPSULE:
            return Capsule(a, 2 * b), T_body_geom
        case _GEOM.mjGEOM_ELLIPSOID:
            return Sphere(a) if a == b == c else ellipsoid_mesh((a, b, c)), T_body_geom
        case _GEOM.mjGEOM_MESH:
            k = model.geom_dataid[geom]
            name = model.mesh(k).name
            T_mesh_geom = pose_of(model.mesh_pos[k], model.mesh_quat[k])
            mesh, T_mesh_file = _mesh(spec.mesh(name), document)
            return mesh, T_body_geom @ T_mesh_geom.inverse() @ T_mesh_file
        case _:
            return None, T_body_geom


def _mesh(asset: mujoco.MjsMesh, document: MjcfDocument) -> tuple[Mesh, Pose]:
    """Return a mesh asset as its file with a scale, and the pose of that in the asset's frame.

    MuJoCo maps a vertex v of the file to S R^T (v - p), with the position p and rotation R of
    ``refpos`` and ``refquat`` and the scale S.
    """
    x, y, z = (float(value) for value in asset.scale)
    T_ref_file = pose_of(asset.refpos, asset.refquat).inverse()
    if T_ref_file.quaternion != rotation.IDENTITY and not x == y == z:
        raise document.error(
            f"mesh {asset.name!r} is turned by refquat and has the uneven scale {x:g} {y:g} {z:g}; "
            "turn the vertices in its file"
        )
    px, py, pz = T_ref_file.position
    T_asset_file = Pose((x * px, y * py, z * pz), T_ref_file.quaternion)
    return Mesh(document.meshes[asset.name], (x, y, z)), T_asset_file


def _rgba(model: mujoco.MjModel, geom: int) -> Rgba | None:
    """Return the colour of a geom or its material; None if the file names none."""
    values = model.geom_rgba[geom]
    material = model.geom_matid[geom]
    if np.allclose(values, _DEFAULT_RGBA):
        if material < 0:
            return None
        values = model.mat_rgba[material]
    # MuJoCo stores colours with single precision.
    red, green, blue, alpha = (round(min(max(float(v), 0.0), 1.0), 6) for v in values)
    return (red, green, blue, alpha)


def pose_of(position: Array, quaternion: Array) -> Pose:
    """Return a pose from MuJoCo's position (3,) [m] and quaternion (4,), (w, x, y, z)."""
    x, y, z = (float(value) for value in position)
    a, b, c, d = (float(value) for value in quaternion)
    return Pose((x, y, z), rotation.normalize((a, b, c, d)))

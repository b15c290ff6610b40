"""Gaps between links: is the robot that one sees in one piece?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TypeAlias

import fcl
import igl
import numpy as np
from numpy.typing import NDArray

from morphgen.checks.joints import is_axis_valid
from morphgen.checks.solids import is_scale_valid, mesh_fault
from morphgen.model.findings import Finding
from morphgen.model.geometry import (
    Box,
    Capsule,
    Cylinder,
    Geometry,
    Mesh,
    Shape,
    Sphere,
    dimensions,
)
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import forward_kinematics, movable_positions
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Robot
from morphgen.typing import Array

_Triangles: TypeAlias = Array
"""Corners, shape (n, 3, 3), metres."""

MAX_GAP = 5e-3
"""Largest distance between the visual solids of a link and its parent, metres.

Sound models of real arms and grippers have slits of up to 3.6 mm where links turn (SAKE EZ: 3.6,
Fetch: 3, UR5: 3).
"""
_FEW = 500
"""Triangles of a shape with which a contact is looked for first."""
_ROUNDING = 1e-9
"""Error of a distance, metres."""


def check_links_apart(robot: Robot) -> Iterator[Finding]:
    """Find links that nothing visible joins to their parent at home.

    A link without visual shapes passes the question on: what hangs on it is compared with the
    nearest link above that has some. Where one solid is inside the other, they are not apart.
    Shapes that cannot be read are left out, and a robot whose joints cannot be placed at home is
    not tested.
    """
    placeable = all(is_axis_valid(robot.joints[k]) for k in robot.movable_joints)
    if not placeable or not np.isfinite(movable_positions(robot, robot.home)).all():
        return
    T_root_link = forward_kinematics(robot, np.array(robot.home))
    visible = [
        tuple(shape for shape in link.visuals if _is_readable(shape.geometry))
        for link in robot.links
    ]
    for i, link in enumerate(robot.links):
        above = robot.parents[i]
        while above >= 0 and not visible[above]:
            above = robot.parents[above]
        if above < 0 or not visible[i]:
            continue
        T_above_link = np.linalg.inv(T_root_link[above]) @ T_root_link[i]
        gap = _gap(visible[above], visible[i], T_above_link)
        if gap > MAX_GAP:
            yield Finding(
                "links-apart",
                "warning",
                f"links {robot.links[above].name}, {link.name}",
                f"at home {1000 * gap:.3g} mm of air are between what one sees of them",
                "correct the origin of the joint between them or of a mesh, or a mesh's scale",
            )


def _is_readable(geometry: Geometry) -> bool:
    if isinstance(geometry, Mesh):
        return is_scale_valid(geometry) and mesh_fault(geometry) is None
    return all(np.isfinite(size) and size > 0 for size in dimensions(geometry))


def _gap(first: Sequence[Shape], second: Sequence[Shape], T_first_second: Array) -> float:
    """Distance between two solids, metres; if it is at most ``MAX_GAP``, perhaps a bound of it."""
    if _primitives_near(first, second, T_first_second):
        return 0.0
    # Some of the triangles bound the distance from above. Mostly that suffices; if not, the nearest
    # triangles of all are as near as that to the other solid.
    bound = _distance(_triangles(first, _FEW), _moved(_triangles(second, _FEW), T_first_second))
    if bound <= MAX_GAP:
        return bound
    a, b = _triangles(first), _moved(_triangles(second), T_first_second)
    gap = _distance(a[_near(a, b, bound)], b[_near(b, a, bound)])
    return 0.0 if gap > MAX_GAP and (_encloses(a, b) or _encloses(b, a)) else gap


def _primitives_near(
    first: Sequence[Shape], second: Sequence[Shape], T_first_second: Array
) -> bool:
    """Whether two primitives are surely near: FCL overestimates distances of some pairs."""
    placed_a = [(s.geometry, s.T_link_shape.matrix) for s in first]
    placed_b = [(s.geometry, T_first_second @ s.T_link_shape.matrix) for s in second]
    a, b = (
        [
            fcl.CollisionObject(_primitive(geometry), fcl.Transform(T[:3, :3], T[:3, 3]))
            for geometry, T in placed
            if not isinstance(geometry, Mesh)
        ]
        for placed in (placed_a, placed_b)
    )
    return any(
        fcl.distance(one, other, fcl.DistanceRequest(), fcl.DistanceResult()) <= MAX_GAP
        for one in a
        for other in b
    )


def _primitive(geometry: Geometry) -> fcl.CollisionGeometry:
    match geometry:
        case Box(size):
            return fcl.Box(*size)
        case Sphere(radius):
            return fcl.Sphere(radius)
        case Cylinder(radius, length):
            return fcl.Cylinder(radius, length)
        case Capsule(radius, length):
            return fcl.Capsule(radius, length)
    raise TypeError(f"{geometry} is no primitive")


def _triangles(shapes: Sequence[Shape], most: int | None = None) -> _Triangles:
    """Triangles of shapes in their link's frame; of each shape, some that are about ``most``."""
    pieces = []
    for shape in shapes:
        geometry = shape.geometry
        mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
        step = 1 if most is None else -(-len(mesh.faces) // most)
        pieces.append(_moved(mesh.vertices[mesh.faces[::step]], shape.T_link_shape.matrix))
    return np.concatenate(pieces)


def _moved(points: Array, T: Array) -> Array:
    moved: Array = points @ T[:3, :3].T + T[:3, 3]
    return moved


def _near(triangles: _Triangles, others: _Triangles, distance: float) -> NDArray[np.bool_]:
    """Which triangles may be so near to others: those that are, along each axis, to their box."""
    reach = distance + _ROUNDING
    low, high = others.min(axis=(0, 1)) - reach, others.max(axis=(0, 1)) + reach
    above, below = triangles.max(axis=1) >= low, triangles.min(axis=1) <= high
    near: NDArray[np.bool_] = (above & below).all(axis=1)
    return near


def _distance(a: _Triangles, b: _Triangles) -> float:
    """Exact distance between two sets of triangles, metres; 0 if they meet."""
    first, second = fcl.CollisionObject(_hierarchy(a)), fcl.CollisionObject(_hierarchy(b))
    return max(0.0, float(fcl.distance(first, second, fcl.DistanceRequest(), fcl.DistanceResult())))


def _hierarchy(triangles: _Triangles) -> fcl.BVHModel:
    model = fcl.BVHModel()
    model.beginModel(3 * len(triangles), len(triangles))
    model.addSubModel(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    model.endModel()
    return model


def _encloses(solid: _Triangles, others: _Triangles) -> bool:
    """Whether a corner of other triangles is inside of a solid, by its winding number."""
    faces = np.arange(3 * len(solid)).reshape(-1, 3)
    corners = np.unique(others[_near(others, solid, 0.0)].reshape(-1, 3), axis=0)
    if not len(corners):
        return False
    winding = igl.fast_winding_number(solid.reshape(-1, 3), faces, corners)
    return bool((np.abs(winding) > 0.5).any())

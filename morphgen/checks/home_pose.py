"""Checks at the home configuration: visible gaps between links, and self-collision."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
from numpy.typing import NDArray

from morphgen.checks.rules import found, has_hull, is_axis_valid, is_readable
from morphgen.checks.self_collision import SelfCollisionChecker, untested_pairs
from morphgen.model.findings import Finding
from morphgen.model.geometry import Mesh, Shape, dimensions
from morphgen.model.inertia import solid_mesh
from morphgen.model.kinematics import forward_kinematics, movable_positions
from morphgen.model.mesh import load_mesh
from morphgen.model.robot import Link, Pair, Robot
from morphgen.typing import Array

if TYPE_CHECKING:
    import fcl

_Triangles: TypeAlias = Array  # corners of triangles, shape (n, 3, 3) [m]

MAX_GAP = 5e-3
"""Largest distance between the visual shapes of a link and its parent [m].

Correct models of real arms and grippers have slits of up to 3.6 mm at their joints (SAKE EZ 3.6,
Fetch 3, UR5 3).
"""
_COARSE_TRIANGLES = 500  # number of triangles per shape in the first, coarse distance test
_ROUNDING = 1e-9  # upper bound of the rounding error of a distance [m]


def check_links_apart(robot: Robot) -> Iterator[Finding]:
    """Find links that no visible shape connects to their parent at home.

    A link without visual shapes is skipped: its children are compared with the nearest ancestor
    that has some. Where one solid is inside the other, there is no gap. Unreadable shapes are left
    out, and a robot without valid joint axes and positions is not tested.
    """
    if not _has_home_pose(robot):
        return
    T_root_link = forward_kinematics(robot, np.array(robot.home))
    visuals = [
        tuple(shape for shape in link.visuals if is_readable(shape.geometry))
        for link in robot.links
    ]
    for i, link in enumerate(robot.links):
        ancestor = robot.parents[i]
        while ancestor >= 0 and not visuals[ancestor]:
            ancestor = robot.parents[ancestor]
        if ancestor < 0 or not visuals[i]:
            continue
        T_ancestor_link = np.linalg.inv(T_root_link[ancestor]) @ T_root_link[i]
        gap = _gap(visuals[ancestor], visuals[i], T_ancestor_link)
        millimetres = f"{1000 * gap:.3g}"
        if float(millimetres) > 1000 * MAX_GAP:  # as it is printed: 5 mm are not more than 5 mm
            where = f"links {robot.links[ancestor].name}, {link.name}"
            yield found("links-apart", where, millimetres=millimetres)


def check_self_collision(robot: Robot) -> Iterator[Finding]:
    """Find pairs of links that penetrate each other at home."""
    for (a, b), depth in sorted(home_penetrations(robot).items()):
        yield found("self-collision", f"links {a}, {b}", millimetres=1000 * depth)


def home_penetrations(robot: Robot, margin: float = 0.0) -> dict[Pair, float]:
    """Return the pairs of links that penetrate each other at home, with their depth [m].

    Links that are nearer than ``margin`` [m] count, too, with a negative depth. Adjacent links,
    ``robot.ignore_pairs`` and unreadable shapes are left out. A robot without valid joint axes and
    positions is not tested.
    """
    if not _has_home_pose(robot):
        return {}

    def with_valid_collisions(link: Link) -> Link:
        valid = tuple(shape for shape in link.collisions if has_hull(shape.geometry))
        return replace(link, collisions=valid)

    testable = robot.with_links(map(with_valid_collisions, robot.links))
    checker = SelfCollisionChecker(testable, untested_pairs(testable), margin)
    return next(checker.penetrations([robot.home]))


def _has_home_pose(robot: Robot) -> bool:
    """Return whether all joint axes are valid and all home positions finite."""
    axes_valid = all(is_axis_valid(robot.joints[k]) for k in robot.movable_joints)
    return axes_valid and bool(np.isfinite(movable_positions(robot, robot.home)).all())


def _gap(a: Sequence[Shape], b: Sequence[Shape], T_a_b: Array) -> float:
    """Return the distance between two solids [m]; below ``MAX_GAP``, perhaps an upper bound."""
    if _are_primitives_near(a, b, T_a_b):
        return 0.0
    # Some of the triangles give an upper bound of the distance, which usually suffices. If not,
    # only triangles within this bound of the other solid can be nearer, so test those.
    coarse_b = _transform(_triangles(b, _COARSE_TRIANGLES), T_a_b)
    bound = _distance(_triangles(a, _COARSE_TRIANGLES), coarse_b)
    if bound <= MAX_GAP:
        return bound
    all_a, all_b = _triangles(a), _transform(_triangles(b), T_a_b)
    gap = _distance(all_a[_is_near(all_a, all_b, bound)], all_b[_is_near(all_b, all_a, bound)])
    enclosed = gap > MAX_GAP and (_encloses(all_a, all_b) or _encloses(all_b, all_a))
    return 0.0 if enclosed else gap


def _are_primitives_near(a: Sequence[Shape], b: Sequence[Shape], T_a_b: Array) -> bool:
    """Return whether two primitives are within ``MAX_GAP``.

    A negative answer is not certain, because FCL overestimates distances of some pairs.
    """
    import fcl  # here and below, because commands that check no robot should start quickly

    def objects(shapes: Sequence[Shape], T_a_link: Array) -> list[fcl.CollisionObject]:
        found = []
        for shape in shapes:
            if not isinstance(shape.geometry, Mesh):
                T = T_a_link @ shape.T_link_shape.matrix
                # FCL has the same primitives, with the same names and dimensions.
                make = getattr(fcl, type(shape.geometry).__name__)
                geometry, T = make(*dimensions(shape.geometry)), fcl.Transform(T[:3, :3], T[:3, 3])
                found.append(fcl.CollisionObject(geometry, T))
        return found

    objects_b = objects(b, T_a_b)
    return any(
        fcl.distance(object_a, object_b, fcl.DistanceRequest(), fcl.DistanceResult()) <= MAX_GAP
        for object_a in objects(a, np.eye(4))
        for object_b in objects_b
    )


def _triangles(shapes: Sequence[Shape], max_per_shape: int | None = None) -> _Triangles:
    """Return triangles of shapes in their link's frame, at most about ``max_per_shape`` of each."""
    pieces = []
    for shape in shapes:
        geometry = shape.geometry
        mesh = load_mesh(geometry) if isinstance(geometry, Mesh) else solid_mesh(geometry)
        stride = 1 if max_per_shape is None else -(-len(mesh.faces) // max_per_shape)
        corners = mesh.vertices[mesh.faces[::stride]]
        pieces.append(_transform(corners, shape.T_link_shape.matrix))
    return np.concatenate(pieces)


def _transform(points: Array, T: Array) -> Array:
    return np.asarray(points @ T[:3, :3].T + T[:3, 3])


def _is_near(triangles: _Triangles, others: _Triangles, distance: float) -> NDArray[np.bool_]:
    """Return which triangles' bounding boxes are within a distance of the others' box, (n,)."""
    margin = distance + _ROUNDING
    low, high = others.min(axis=(0, 1)) - margin, others.max(axis=(0, 1)) + margin
    above, below = triangles.max(axis=1) >= low, triangles.min(axis=1) <= high
    return np.asarray((above & below).all(axis=1))


def _distance(a: _Triangles, b: _Triangles) -> float:
    """Return the exact distance between two sets of triangles [m]; 0 if they intersect."""
    import fcl

    objects = (
        triangle_collider(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
        for triangles in (a, b)
    )
    return max(0.0, float(fcl.distance(*objects, fcl.DistanceRequest(), fcl.DistanceResult())))


def triangle_collider(vertices: Array, faces: NDArray[np.int64]) -> fcl.CollisionObject:
    """Return the collision object of triangles: vertices (n, 3) [m] and faces (m, 3)."""
    import fcl

    model = fcl.BVHModel()
    model.beginModel(len(vertices), len(faces))
    model.addSubModel(vertices, faces)
    model.endModel()
    return fcl.CollisionObject(model)


def _encloses(solid: _Triangles, others: _Triangles) -> bool:
    """Return whether a corner of other triangles is inside a solid, by its winding number.

    Barill et al., Fast winding numbers for soups and clouds, 2018.
    """
    import igl

    corners = np.unique(others[_is_near(others, solid, 0.0)].reshape(-1, 3), axis=0)
    if not len(corners):
        return False
    faces = np.arange(3 * len(solid)).reshape(-1, 3)
    winding = igl.fast_winding_number(solid.reshape(-1, 3), faces, corners)
    # 1 inside a closed solid and 0 outside; meshes may be inside out.
    return bool((np.abs(winding) > 0.5).any())


CHECKS = (check_links_apart, check_self_collision)

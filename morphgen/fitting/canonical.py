"""The canonical pose of a primitive: of all poses that symmetry makes equal, the least rotated.

Tokens contain poses, so equal primitives must have equal poses.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Literal

import numpy as np
import scipy  # loads its packages at their first use, which take seconds

from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import IDENTITY, Quat, normalize, unit_quaternion, vec3

Kind = Literal["box", "cylinder", "sphere"]  # a kind of primitive that the fitter chooses from
KINDS: tuple[Kind, ...] = ("box", "cylinder", "sphere")

_DECIMALS = 9  # decimals of rotations; fits differ beyond them from machine to machine
_BOX_SYMMETRIES = np.array(
    [
        symmetry
        for order in itertools.permutations(np.eye(3))
        for signs in itertools.product((1, -1), repeat=3)
        if np.linalg.det(symmetry := np.transpose(order) * signs) > 0
    ]
)
"""The rotations that map a box onto itself, up to the order of its edges, shape (24, 3, 3)."""


def canonical(shape: Shape) -> Shape:
    """Return the same primitive in its canonical pose; a mesh is returned unchanged.

    A cylinder's rotation takes z to its axis, pointing above the xy plane; a box's is that of its
    24 rotations nearest to the link's axes.
    """
    geometry, pose = shape.geometry, shape.T_link_shape
    R = pose.matrix[:3, :3]
    match geometry:
        case Sphere():
            quaternion = IDENTITY
        case Cylinder() | Capsule():
            x, y, z = R[:, 2].tolist()
            if tuple(R[::-1, 2].round(_DECIMALS)) < (0.0, 0.0, 0.0):
                x, y, z = -x, -y, -z
            quaternion = normalize((1 + z, -y, x, 0.0))  # the shortest rotation from z to the axis
        case Box(edges):
            rotations = R @ _BOX_SYMMETRIES
            # The trace of a rotation is 1 + 2 cos(angle).
            traces = np.trace(rotations, axis1=1, axis2=2).round(_DECIMALS)
            best = scipy.spatial.transform.Rotation.from_matrix(rotations[np.argmax(traces)])
            quaternion = unit_quaternion(best.as_quat(scalar_first=True).tolist())
            R_canonical_old = Pose(quaternion=quaternion).matrix[:3, :3].T @ R
            geometry = Box(vec3((np.abs(R_canonical_old.round()) @ edges).tolist()))
        case _:
            return shape
    return replace(shape, geometry=geometry, T_link_shape=Pose(pose.position, quaternion))


def rounded(quaternion: Quat) -> Quat:
    """Round a quaternion to nine decimals, beyond which fits differ between machines."""
    return unit_quaternion(round(value, _DECIMALS) for value in normalize(quaternion))

"""One pose for each primitive: symmetry allows for many, and tokens should not differ by it."""

from __future__ import annotations

import itertools
from dataclasses import replace
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from morphgen.model.geometry import Box, Capsule, Cylinder, Pose, Shape, Sphere
from morphgen.model.rotation import IDENTITY, Quat, normalize
from morphgen.typing import Array

Kind = Literal["box", "cylinder", "sphere"]
"""A primitive that the fitter chooses from."""
KINDS: tuple[Kind, ...] = ("box", "cylinder", "sphere")

_DECIMALS = 9
"""Decimals beyond which rotations turn alike far."""
_QUATERNION_DECIMALS = 9
_QUARTER_TURNS = np.array(
    [
        turn
        for order in itertools.permutations(np.eye(3))
        for signs in itertools.product((1, -1), repeat=3)
        if np.linalg.det(turn := np.transpose(order) * signs) > 0
    ]
)
"""The rotations of a box onto itself, shape (24, 3, 3)."""


def canonical(shape: Shape) -> Shape:
    """The same body in the pose that turns least; meshes stay as they are."""
    geometry, pose = shape.geometry, shape.T_link_shape
    R = pose.matrix[:3, :3]
    match geometry:
        case Sphere():
            quaternion = IDENTITY
        case Cylinder() | Capsule():
            quaternion = least_rotation("cylinder", R)
        case Box(edges):
            quaternion = least_rotation("box", R)
            turn = Pose(quaternion=quaternion).matrix[:3, :3].T @ R
            x, y, z = (np.abs(turn.round()) @ edges).tolist()
            geometry = Box((x, y, z))
        case _:
            return shape
    return replace(shape, geometry=geometry, T_link_shape=Pose(pose.position, quaternion))


def least_rotation(kind: Kind, R: Array) -> Quat:
    """The rotation, of all that show a primitive alike, that turns least.

    A sphere is not turned at all; a cylinder goes from z to its axis, of which the end above the xy
    plane counts; a box takes the one of its 24 rotations that is nearest to the axes of the link.

    Args:
        kind: What is turned.
        R: A rotation, shape (3, 3).
    """
    if kind == "sphere":
        return IDENTITY
    if kind == "box":
        alike = R @ _QUARTER_TURNS
        best = alike[np.argmax(np.trace(alike, axis1=1, axis2=2).round(_DECIMALS))]
        w, x, y, z = Rotation.from_matrix(best).as_quat(scalar_first=True).tolist()
        return normalize((w, x, y, z))
    x, y, z = R[:, 2].tolist()
    if tuple(R[::-1, 2].round(_DECIMALS)) < (0.0, 0.0, 0.0):
        x, y, z = -x, -y, -z
    return normalize((1 + z, -y, x, 0.0))


def rounded(quaternion: Quat) -> Quat:
    """The same rotation to nine decimals, beyond which fits differ from machine to machine."""
    w, x, y, z = (round(value, _QUATERNION_DECIMALS) for value in normalize(quaternion))
    return normalize((w, x, y, z))

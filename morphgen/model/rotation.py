"""Rotations: quaternions (w, x, y, z) with w >= 0, matrices, and URDF's roll-pitch-yaw."""

from __future__ import annotations

import math
from collections.abc import Iterable

Vec3 = tuple[float, float, float]
Quat = tuple[float, float, float, float]

IDENTITY: Quat = (1.0, 0.0, 0.0, 0.0)
_GIMBAL, _NEAR_GIMBAL = 1e-12, 1e-3
"""Cosines of the pitch below which yaw is set to zero, and roll is computed from the yaw."""


def vec3(values: Iterable[float]) -> Vec3:
    """Return three numbers, such as those of an array, as a vector."""
    x, y, z = values
    return (float(x), float(y), float(z))


def unit_quaternion(values: Iterable[float]) -> Quat:
    """Return four numbers (w, x, y, z), such as those of an array, as a rotation."""
    w, x, y, z = values
    return normalize((float(w), float(x), float(y), float(z)))


def normalize(q: Quat) -> Quat:
    """Scale to unit length and choose the sign with w >= 0 (first non-zero entry positive)."""
    w, x, y, z = q
    norm = math.sqrt(w * w + x * x + y * y + z * z)
    if not math.isfinite(norm) or norm < 1e-12:
        raise ValueError(f"invalid rotation quaternion: {q}")
    if abs(w) < 1e-15 * norm:
        w = 0.0
    lead = next(value for value in (w, x, y, z) if abs(value) > 1e-15 * norm)
    if lead < 0:
        norm = -norm
    # Adding zero turns -0.0 into 0.0, so that equal rotations have equal texts.
    return (w / norm + 0.0, x / norm + 0.0, y / norm + 0.0, z / norm + 0.0)


def multiply(a: Quat, b: Quat) -> Quat:
    """Hamilton product: the rotation b followed by the rotation a."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return normalize(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        )
    )


def rotate(q: Quat, v: Vec3) -> Vec3:
    """Rotate a vector by a unit quaternion."""
    w, x, y, z = q
    vx, vy, vz = v
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return (
        vx + w * tx + y * tz - z * ty,
        vy + w * ty + z * tx - x * tz,
        vz + w * tz + x * ty - y * tx,
    )


def to_matrix(q: Quat) -> tuple[Vec3, Vec3, Vec3]:
    """Return the rotation matrix of a unit quaternion, as rows."""
    w, x, y, z = q
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


def from_matrix(rows: tuple[Vec3, Vec3, Vec3]) -> Quat:
    """Return the quaternion of a rotation matrix, given as rows (Shepperd, 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = rows
    trace = a + e + i
    pivots = (trace, a, e, i)
    largest = pivots.index(max(pivots))
    if largest == 0:
        return normalize((1 + trace, h - f, c - g, d - b))
    if largest == 1:
        return normalize((h - f, 1 + a - e - i, b + d, c + g))
    if largest == 2:
        return normalize((c - g, b + d, 1 + e - a - i, f + h))
    return normalize((d - b, c + g, f + h, 1 + i - a - e))


def from_rpy(rpy: Vec3) -> Quat:
    """Return the quaternion of fixed-axis roll, pitch, yaw: Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, cp, cy = (math.cos(angle / 2) for angle in rpy)
    sr, sp, sy = (math.sin(angle / 2) for angle in rpy)
    return normalize(
        (
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        )
    )


def to_rpy(q: Quat) -> Vec3:
    """Return roll, pitch and yaw of a unit quaternion [rad]; in gimbal lock yaw is zero."""
    (a, b, c), (d, e, f), (g, h, i) = to_matrix(q)
    cos_pitch = math.hypot(a, d)
    pitch = math.atan2(-g, cos_pitch)
    if cos_pitch > _NEAR_GIMBAL:
        return (math.atan2(h, i), pitch, math.atan2(d, a))
    # Near gimbal lock yaw, h and i are inaccurate: undo this yaw, then read the roll that is left.
    yaw = math.atan2(d, a) if cos_pitch > _GIMBAL else 0.0
    cy, sy = math.cos(yaw), math.sin(yaw)
    return (math.atan2(sy * c - cy * f, cy * e - sy * b), pitch, yaw)


def from_z(axis: Vec3) -> Quat:
    """Return a rotation that maps the z axis to a unit axis."""
    x, y, z = axis
    if z < -0.5:  # near -z the formula below is singular: first turn by pi about x
        return multiply((0.0, 1.0, 0.0, 0.0), from_z((x, -y, -z)))
    # The quaternion (1 + z . axis, z x axis) rotates z to the axis by the shortest way.
    return normalize((1 + z, -y, x, 0.0))

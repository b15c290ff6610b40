"""Contacts of a robot with a block, found by moving the block until they collide."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.tasks.free_space import FreeSpace
from morphgen.typing import Array

# All lengths are in edges of the block.
SHIFTS = np.arange(0.05, 2.0, 0.1)
"""Distances that the block is moved towards the robot to find their contact."""
BISECTIONS = 5
"""Bisections of the interval between two of these shifts."""
OFFSETS = np.linspace(-1.0, 1.0, 9)
"""Offsets of the block along x at which the width of the contact is tested."""
BELOW, ABOVE = -0.5, 0.15
"""Shifts of the block along z: a block lowered by half an edge is touched only below its middle; a
raised one also slightly above it."""
PRESSED = 0.1
"""Distance that the block is pressed against the robot when the width is tested."""


@dataclass(frozen=True, eq=False)
class PreContact:
    """Configurations behind the block that touch it if they move along y; one per row."""

    q: Array
    """Configurations, shape (n, dof) [rad or m]."""
    gap: Array
    """Motion along y until the robot touches the block, shape (n,) [m]."""
    offset: Array
    """Offset of the block along x for which the contact is on its middle, shape (n,) [m]."""
    width: Array
    """Fraction of ``OFFSETS`` at which the block is touched, shape (n,)."""
    overhang: Array
    """Overhang over the block as the function ``overhang`` returns it, shape (n,) [edges]."""


def find_contacts(space: FreeSpace, q: Array, block: Array, edge: float) -> PreContact:
    """Return those configurations that touch the block if they move along y.

    q: Configurations free of the block, shape (n, dof).
    block: Pose of the block, shape (7,).
    edge: Edge length of the block [m].
    """
    gap = _gaps(space, q, np.tile(block, (len(q), 1)), edge, 0.0)
    touching = np.isfinite(gap)
    q, gap = q[touching], gap[touching]
    pressed = (gap + PRESSED * edge)[:, None]
    touched = touches(space, q, block, OFFSETS * edge, -pressed)
    count = np.maximum(touched.sum(axis=1), 1)
    offset = (touched * OFFSETS).sum(axis=1) / count * edge
    blocks = np.tile(block, (len(q), 1))
    blocks[:, 0] += offset
    return PreContact(q, gap, offset, count / len(OFFSETS), overhang(space, q, blocks, edge))


def overhang(space: FreeSpace, q: Array, blocks: Array, edge: float) -> Array:
    """Return the overhang of a robot over the block that it touches if it moves along y.

    The overhang is the lead along y with which the robot touches the block above its middle before
    it touches it below, from 0 to 1 edges. With overhang, a push presses the block to the ground or
    tips it over.

    q: Configurations free of the block, shape (n, dof).
    blocks: Pose of the block for each of them, shape (n, 7).
    edge: Edge length of the block [m].

    Returns:
        Overhangs, shape (n,) [edges].
    """
    below, above = (
        np.minimum(_gaps(space, q, blocks, edge, dz * edge), SHIFTS[-1] * edge)
        for dz in (BELOW, ABOVE)
    )
    return np.asarray(np.clip((below - above) / edge, 0.0, 1.0))


def touches(
    space: FreeSpace, q: Array, block: Array, dx: Array, dy: Array, dz: float = 0.0
) -> NDArray[np.bool_]:
    """Return whether configurations touch the shifted block, shape (n, k).

    q: Configurations, shape (n, dof).
    block: Pose of the block, shape (7,), or one for each configuration, (n, 7).
    dx: Shifts along x, of a shape that broadcasts to (n, k) [m].
    dz: Shift along z [m].
    """
    n, k = len(q), max(dx.shape[-1], dy.shape[-1])
    blocks = np.broadcast_to(block.reshape(-1, 1, 7), (n, k, 7)).copy()
    blocks[..., 0] += dx
    blocks[..., 1] += dy
    blocks[..., 2] += dz
    free = space.free(np.repeat(q, k, axis=0), blocks.reshape(-1, 7))
    return ~free.reshape(n, k)


def _gaps(space: FreeSpace, q: Array, blocks: Array, edge: float, dz: float) -> Array:
    """Return distances along y from blocks (n, 7) to the robot, (n,) [m]; inf without contact.

    The blocks are shifted along z by ``dz`` [m].
    """
    shifts, zero = SHIFTS * edge, np.zeros(1)
    touched = touches(space, q, blocks, zero, -shifts, dz)
    first = touched.argmax(axis=1)
    gaps = np.where(touched.any(axis=1), shifts[first], np.inf)
    rows = np.isfinite(gaps)
    q, blocks, high = q[rows], blocks[rows], gaps[rows]
    low = np.where(first[rows] > 0, shifts[first[rows] - 1], 0.0)
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        hit = touches(space, q, blocks, zero, -middle[:, None], dz)[:, 0]
        low, high = np.where(hit, low, middle), np.where(hit, middle, high)
    gaps[rows] = high
    return gaps

"""Where a robot would touch the block, found by moving the block until it does."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from morphgen.tasks.free_space import FreeSpace

Array = NDArray[np.float64]

NEARER = np.arange(0.05, 2.0, 0.1)
"""How far the block is moved to the robot to see where they touch, in its edges."""
ASIDE = np.array([-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0])
"""How far aside, to see how broadly they do, in its edges."""
HALF = 0.5
"""How far it is lowered and raised to see which of its halves is touched first, in its edges."""
FIRM = 0.1
"""How far it is pressed against the robot for that, in its edges."""


@dataclass(frozen=True, eq=False)
class Poised:
    """Configurations behind the block, a row each."""

    q: Array
    """Shape (n, dof), rad or m."""
    gap: Array
    """How far the robot goes along y until it touches the block, shape (n,), metres."""
    middle: Array
    """How far aside the block has to be for the touch to be on its middle, shape (n,), metres."""
    width: Array
    """Share of the shifts ``ASIDE`` at which the block is still touched, shape (n,)."""
    roof: Array
    """How much earlier the block's upper half is touched than its lower, 0 to 1, in its edges: a
    robot that leans over the block presses it to the ground. Shape (n,)."""

    def taken(self, rows: NDArray[np.intp]) -> Poised:
        """Some of the rows."""
        return Poised(*(getattr(self, each.name)[rows] for each in fields(self)))


def poised(space: FreeSpace, q: Array, block: Array, edge: float) -> Poised:
    """Those configurations that touch the block if they go along y, and how.

    Args:
        space: What is free, with the block.
        q: Configurations free of the block, shape (n, dof).
        block: Pose of the block, shape (7,).
        edge: Of the block, metres.
    """
    gap = _gaps(space, q, block, edge, 0.0)
    some = np.isfinite(gap)
    q, gap = q[some], gap[some]
    farthest = NEARER[-1] * edge
    lower, upper = (
        np.minimum(_gaps(space, q, block, edge, dz * edge), farthest) for dz in (-HALF, HALF)
    )
    nearer = (gap + FIRM * edge)[:, None]
    broad = touches(space, q, block, ASIDE * edge, -nearer)
    count = np.maximum(broad.sum(axis=1), 1)
    return Poised(
        q,
        gap,
        middle=(broad * ASIDE).sum(axis=1) / count * edge,
        width=count / len(ASIDE),
        roof=np.clip((lower - upper) / edge, 0.0, 1.0),
    )


def touches(
    space: FreeSpace, q: Array, block: Array, dx: Array, dy: Array, dz: float = 0.0
) -> NDArray[np.bool_]:
    """Whether configurations touch the block where it is shifted.

    Args:
        space: What is free, with the block.
        q: Shape (n, dof).
        block: Pose of the block, shape (7,).
        dx: Shifts along x, shape (n, k) or one that broadcasts to it, metres.
        dy: Shifts along y, likewise.
        dz: Shift along z.

    Returns:
        Shape (n, k).
    """
    n, k = len(q), max(dx.shape[-1], dy.shape[-1])
    blocks = np.tile(block, (n, k, 1))
    blocks[..., 0] += dx
    blocks[..., 1] += dy
    blocks[..., 2] += dz
    free = space.free(np.repeat(q, k, axis=0), blocks.reshape(-1, 7))
    return ~free.reshape(n, k)


def _gaps(space: FreeSpace, q: Array, block: Array, edge: float, raised: float) -> Array:
    """How far the block comes nearer until it is touched, (n,), metres; infinite if never."""
    shifts = NEARER * edge
    touched = touches(space, q, block, np.zeros(1), -shifts, raised)
    return np.where(touched.any(axis=1), shifts[touched.argmax(axis=1)], np.inf)

"""Where a robot would touch the block, found by moving the block until it does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from morphgen.tasks.free_space import FreeSpace
from morphgen.typing import Array

NEARER = np.arange(0.05, 2.0, 0.1)
"""How far the block is moved to the robot to see where they touch, in its edges."""
HALVINGS = 5
"""Times that what is between two of these is halved."""
ASIDE = np.array([-1.0, -0.75, -0.5, -0.25, 0.0, 0.25, 0.5, 0.75, 1.0])
"""How far aside, to see how broadly they do, in its edges."""
LOWERED, RAISED = -0.5, 0.15
"""Shifts up with which only what is below the block's middle touches it, and with which what is at
its upper edge does too, in its edges."""
FIRM = 0.1
"""How far it is pressed against the robot to see how broadly they touch, in its edges."""


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
    over: Array
    """How much earlier the robot touches what is above the block's middle, or just above the block,
    than what is below, 0 to 1, in its edges. What leans over a block presses it to the ground, or
    tips it over. Shape (n,)."""


def poised(space: FreeSpace, q: Array, block: Array, edge: float) -> Poised:
    """Those configurations that touch the block if they go along y, and how.

    Args:
        space: What is free, with the block.
        q: Configurations free of the block, shape (n, dof).
        block: Pose of the block, shape (7,).
        edge: Of the block, metres.
    """
    gap = _gaps(space, q, np.tile(block, (len(q), 1)), edge, 0.0)
    some = np.isfinite(gap)
    q, gap = q[some], gap[some]
    nearer = (gap + FIRM * edge)[:, None]
    broad = touches(space, q, block, ASIDE * edge, -nearer)
    count = np.maximum(broad.sum(axis=1), 1)
    middle = (broad * ASIDE).sum(axis=1) / count * edge
    blocks = np.tile(block, (len(q), 1))
    blocks[:, 0] += middle
    return Poised(q, gap, middle, count / len(ASIDE), leaning(space, q, blocks, edge))


def leaning(space: FreeSpace, q: Array, blocks: Array, edge: float) -> Array:
    """How far configurations lean over the block that they touch if they go along y.

    Args:
        space: What is free, with the block.
        q: Configurations free of it, shape (n, dof).
        blocks: Its pose, one for each, shape (n, 7).
        edge: Of the block, metres.

    Returns:
        ``Poised.over``, shape (n,).
    """
    below, above = (
        np.minimum(_gaps(space, q, blocks, edge, dz * edge), NEARER[-1] * edge)
        for dz in (LOWERED, RAISED)
    )
    return np.asarray(np.clip((below - above) / edge, 0.0, 1.0))


def touches(
    space: FreeSpace, q: Array, block: Array, dx: Array, dy: Array, dz: float = 0.0
) -> NDArray[np.bool_]:
    """Whether configurations touch the block where it is shifted.

    Args:
        space: What is free, with the block.
        q: Shape (n, dof).
        block: Pose of the block, shape (7,), or one for each, (n, 7).
        dx: Shifts along x, shape (n, k) or one that broadcasts to it, metres.
        dy: Shifts along y, likewise.
        dz: Shift along z.

    Returns:
        Shape (n, k).
    """
    n, k = len(q), max(dx.shape[-1], dy.shape[-1])
    blocks = np.broadcast_to(block.reshape(-1, 1, 7), (n, k, 7)).copy()
    blocks[..., 0] += dx
    blocks[..., 1] += dy
    blocks[..., 2] += dz
    free = space.free(np.repeat(q, k, axis=0), blocks.reshape(-1, 7))
    return ~free.reshape(n, k)


def _gaps(space: FreeSpace, q: Array, blocks: Array, edge: float, raised: float) -> Array:
    """How far blocks (n, 7) come nearer until they are touched, (n,), metres; infinite if never."""
    shifts, none = NEARER * edge, np.zeros(1)
    touched = touches(space, q, blocks, none, -shifts, raised)
    at = touched.argmax(axis=1)
    far = np.where(touched.any(axis=1), shifts[at], np.inf)
    some = np.isfinite(far)
    q, blocks, most = q[some], blocks[some], far[some]
    least = np.where(at[some] > 0, shifts[at[some] - 1], 0.0)
    for _ in range(HALVINGS):
        between = (least + most) / 2
        hit = touches(space, q, blocks, none, -between[:, None], raised)[:, 0]
        least, most = np.where(hit, least, between), np.where(hit, between, most)
    far[some] = most
    return far

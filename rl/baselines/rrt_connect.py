"""Ways in joint space where no straight one is free: RRT-Connect (Kuffner and LaValle 2000)."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from morphgen.typing import Array

FreePart = Callable[[Array, Array], float]
"""Which part of the straight way between two configurations, shape (dof,), is free: 1 if all."""

ROUNDS = 2500
"""Times that a tree grows towards a random configuration, and the other towards it."""
STRETCH = 12.0
"""Longest piece of a tree, in control steps."""
LEAST = 1.0
"""Shortest, likewise."""
SHORTCUTS = 60
"""Random pairs of points on a way between which a straight one is tried."""


class Tree:
    """Configurations, each with the one it was reached from."""

    def __init__(self, roots: Array, step: Array) -> None:
        """Begin.

        Args:
            roots: Those that are reached from nowhere, shape (n, dof).
            step: As of ``connected``.
        """
        self._step = step
        self.nodes = [*roots]
        self.parents = [-1] * len(roots)

    def nearest(self, q: Array) -> int:
        """The configuration from which another, shape (dof,), takes the fewest control steps."""
        apart = np.abs(np.array(self.nodes) - q) / self._step
        return int(apart.max(axis=1).argmin())

    def grow(self, near: int, q: Array, free_part: FreePart) -> int | None:
        """Add a configuration that lies towards another, as far as the way there is free."""
        ahead = q - self.nodes[near]
        far = float((np.abs(ahead) / self._step).max())
        new = q if far <= STRETCH else self.nodes[near] + ahead * (STRETCH / far)
        part = free_part(self.nodes[near], new)
        if part * min(far, STRETCH) < LEAST and part < 1:
            return None
        self.nodes.append(new if part == 1 else self.nodes[near] + part * (new - self.nodes[near]))
        self.parents.append(near)
        return len(self.nodes) - 1

    def back(self, i: int) -> list[Array]:
        """From a configuration to its root."""
        found = []
        while i >= 0:
            found.append(self.nodes[i])
            i = self.parents[i]
        return found


def connected(
    start: Array,
    ends: Array,
    bounds: Array,
    step: Array,
    free_part: FreePart,
    rng: np.random.Generator,
) -> tuple[Array, ...] | None:
    """A free way to one of several ends.

    Args:
        start: Where it begins, shape (dof,).
        ends: Where it may end, shape (n, dof).
        bounds: Of the joints, shape (dof, 2).
        step: Largest change of every joint in a control step, shape (dof,); distances count in
            control steps.
        free_part: What is free.
        rng: Where random configurations come from.

    Returns:
        Configurations to go through in straight lines, from the start to an end; None if none was
        found.
    """
    if not len(ends):
        return None
    here, there = Tree(start[None], step), Tree(ends, step)
    growing, other = here, there
    for _ in range(ROUNDS):
        drawn = rng.uniform(bounds[:, 0], bounds[:, 1])
        new = growing.grow(growing.nearest(drawn), drawn, free_part)
        if new is not None:
            met = _meet(other, growing.nodes[new], free_part)
            if met is not None:
                a, b = growing.back(new), other.back(met)
                way = [*a[::-1], *b[1:]] if growing is here else [*b[::-1], *a[1:]]
                return tuple(shortened(way, free_part, rng))
        growing, other = other, growing
    return None


def explored(
    start: Array,
    bounds: Array,
    step: Array,
    free_part: FreePart,
    rng: np.random.Generator,
    times: int,
) -> Tree:
    """Configurations to which free ways lead from a start.

    Arguments as of ``connected``; the tree grows so many times, or tries to.
    """
    tree = Tree(start[None], step)
    for _ in range(times):
        drawn = rng.uniform(bounds[:, 0], bounds[:, 1])
        tree.grow(tree.nearest(drawn), drawn, free_part)
    return tree


def _meet(tree: Tree, q: Array, free_part: FreePart) -> int | None:
    """Grow a tree until it gets to a configuration, if it does."""
    near: int | None = tree.nearest(q)
    while near is not None and not np.array_equal(tree.nodes[near], q):
        near = tree.grow(near, q, free_part)
    return near


def shortened(way: list[Array], free_part: FreePart, rng: np.random.Generator) -> list[Array]:
    """The same way with straight lines across its corners, as far as they are free."""
    for _ in range(SHORTCUTS):
        if len(way) < 3:
            break
        i, j = sorted(rng.choice(len(way), size=2, replace=False).tolist())
        if j > i + 1 and free_part(way[i], way[j]) == 1:
            way = [*way[: i + 1], *way[j:]]
    return way

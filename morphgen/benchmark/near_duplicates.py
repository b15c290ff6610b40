"""Near duplicates: robots that differ by less than a manufacturing tolerance."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from morphgen.benchmark.similarity import Features, cosine, tree_distance, workspace_overlap

if TYPE_CHECKING:
    from morphgen.benchmark.robot_factory import Candidate


@dataclass(frozen=True)
class NearThresholds:
    """Thresholds of near duplicates.

    Two robots are near if their tree distance is small, and either the cosine of their tokens is
    large or they have one workspace: the same tool positions at the same reach.
    """

    tree: float
    """Tree distance below which two robots are near."""
    cosine: float
    """Cosine of the tokens above which two robots are near."""
    workspace: float = 0.999
    """Overlap of the tool positions above which workspaces are one."""
    reach: float = 0.01
    """Relative difference of the reach below which workspaces are one."""


NEAR_THRESHOLDS = NearThresholds(0.001, 0.99999)
"""Thresholds for sizes that differ by about one per cent, which is a manufacturing tolerance.

Changing the sizes of robots of the shipped grammars by 1 % gives tree distances of 0.0002 to 0.0011
and cosines above 0.999997; by 3 %, distances of 0.0007 to 0.0033 and cosines down to 0.99997. One
measure is not enough: the tree distance ignores where along a link the next one is attached. The
cosine depends little on sizes, because most token entries are flags and unit quaternions, but on
how links are listed: an empty link more, such as a flange, shifts all that follow. The workspace
depends on neither, but its unit is the reach, so the reach is compared beside it.
"""


def is_near(a: Features, b: Features, near: NearThresholds = NEAR_THRESHOLDS) -> bool:
    """Return whether two robots are near duplicates."""
    is_alike = cosine(a, b) > near.cosine or bool(
        is_same_reach(a.workspace.reach, b.workspace.reach, near)
        and workspace_overlap(a, b) > near.workspace
    )
    return is_alike and tree_distance(a, b) < near.tree  # the slowest measure comes last


def is_same_reach(
    a: ArrayLike, b: ArrayLike, near: NearThresholds = NEAR_THRESHOLDS
) -> NDArray[np.bool_]:
    """Return whether distances of the tool from the shoulder are nearly equal, elementwise."""
    return np.abs(np.subtract(a, b)) < near.reach * np.maximum(a, b)


class NearReason:
    """Reject robots that the audit would call nearly the same as a given one."""

    def __init__(self, others: Sequence[Candidate]) -> None:
        self._others = others

    def __call__(self, robot: Candidate) -> str:
        """Return the reason why a robot is rejected; empty if it is accepted."""
        for other in self._others:
            if robot.features is None or other.features is None:
                continue
            if is_near(robot.features, other.features):
                return f"almost the sizes of {other.name}"
        return ""

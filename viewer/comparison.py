"""Comparison of robots: joints with the same role, and similarity."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape
from itertools import combinations
from pathlib import Path

import numpy as np

from morphgen.encoding.similarity import MEASURES, features, similarity_matrix
from morphgen.encoding.tokens import default_max_links
from morphgen.fitting.token_shapes import token_shapes
from morphgen.grammar.library import Library
from morphgen.model.kinematics import driving_joints, joint_limits
from morphgen.model.robot import TOOL, Robot
from morphgen.typing import Array
from morphgen.viewer import markup
from morphgen.viewer.robot_tables import has_tool
from morphgen.viewer.robot_uri import with_library_meshes


def joint_roles(robot: Robot) -> list[str]:
    """Return the role of every independent joint, in the order of q.

    ``joint 1`` is the first joint on the path from the root to the tool, perhaps through a mimic
    joint; ``finger 1`` the first that does not move the tool.
    """
    on_path: tuple[int, ...] = ()
    if has_tool(robot):
        on_path = driving_joints(robot, robot.joint_chain(robot.frame(TOOL).link))
    off_path = [i for i in range(robot.dof) if i not in on_path]
    roles = {i: f"joint {n}" for n, i in enumerate(on_path, 1)}
    roles |= {i: f"finger {n}" for n, i in enumerate(off_path, 1)}
    return [roles[i] for i in range(robot.dof)]


def all_roles(robots: Sequence[Robot]) -> list[str]:
    """Return every role of any of the robots, joints before fingers, by number."""
    roles = {role for robot in robots for role in joint_roles(robot)}
    return sorted(roles, key=lambda role: (role[0] != "j", int(role.split()[1])))


def normalized_positions(robot: Robot, q: Array) -> Array:
    """Map joint positions to -1 at the lower limit and 1 at the upper, shape (dof,)."""
    low, high = joint_limits(robot).T
    half_range = np.where(high > low, (high - low) / 2, 1.0)
    return np.asarray((q - (low + high) / 2) / half_range)


def with_roles(robot: Robot, q: Array, values: Mapping[str, float]) -> Array:
    """Return a configuration (dof,) with the joints of some roles moved, clipped to the limits."""
    low, high = joint_limits(robot).T
    target = np.array(q, dtype=np.float64)
    for i, role in enumerate(joint_roles(robot)):
        if role in values:
            target[i] = (low[i] + high[i]) / 2 + values[role] * (high[i] - low[i]) / 2
    return np.asarray(np.clip(target, low, high))


def compare_robots(robots: Sequence[Robot], folders: Sequence[Path]) -> dict[str, Array]:
    """Return the similarity of every pair by measure, shape (n, n). Runs in a worker."""
    library = Library(folders)
    shapes = [token_shapes(with_library_meshes(robot, library), folders) for robot in robots]
    # Splits fix the number of links; here the largest robot does.
    max_links = default_max_links(len(robot.links) for robot in robots)
    compared = [
        features(robot, shape, max_links=max_links)
        for robot, shape in zip(robots, shapes, strict=True)
    ]
    return {name: similarity_matrix(compared, name) for name in MEASURES}


def similarity_table(names: Sequence[str], similarity: Mapping[str, Array]) -> str:
    """Return a table with a row for each pair of robots and a column for each measure."""
    header = [""]
    for name, measure in MEASURES.items():
        direction = "larger" if measure.larger_is_more_alike else "smaller"
        header.append(f"{name} ({direction} is more similar)")
    rows = [
        (
            f"{escape(names[i])} and {escape(names[j])}",
            *(f"{similarity[name][i, j]:.3f}" for name in MEASURES),
        )
        for i, j in combinations(range(len(names)), 2)
    ]
    return markup.table(header, rows, range(1, len(header)))

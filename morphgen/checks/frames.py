"""Frames: the tool."""

from __future__ import annotations

from collections.abc import Iterator

from morphgen.model.findings import Finding
from morphgen.model.robot import TOOL, Robot

"""Name of the frame that tasks move."""


def check_tool(robot: Robot) -> Iterator[Finding]:
    """Find a robot without a tool, or one whose tool no joint moves."""
    tool = next((frame for frame in robot.frames if frame.name == TOOL), None)
    if tool is None:
        yield Finding(
            "tool-missing",
            "warning",
            f"robot {robot.name}",
            "it has no frame 'tool': tasks and reach need one",
            "name the frame at the working point 'tool'",
        )
        return
    i = robot.link_index[tool.link]
    while i > 0 and not robot.joints[i - 1].is_movable:
        i = robot.parents[i]
    if i == 0 and robot.dof > 0:
        yield Finding(
            "tool-still",
            "warning",
            f"frame {TOOL}",
            f"it is on link {tool.link}, which no joint moves",
            "put the frame on the end-effector",
        )

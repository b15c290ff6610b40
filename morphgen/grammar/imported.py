"""Import: any URDF or xacro to a robot with a tool, a home and its ignore list."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from morphgen.checks import fix, record_repairs
from morphgen.checks.self_collision import survey_collisions
from morphgen.errors import FormatError, nearest
from morphgen.formats.resolve import default_finder
from morphgen.formats.urdf import read_urdf
from morphgen.model.robot import Frame, Robot
from morphgen.model.tree import rename, subtree


def import_robot(
    path: Path,
    args: Mapping[str, str] | None = None,
    *,
    root: Path | None = None,
    root_link: str | None = None,
    tool: str | None = None,
    name: str | None = None,
    repair: bool = True,
) -> Robot:
    """Read a robot description and complete it.

    Args:
        path: A URDF, or a xacro by its suffix.
        args: xacro arguments.
        root: A folder that meshes, includes and YAML may come from, besides the description's own
            folder and package.
        root_link: Link where the robot begins; by default the file's root.
        tool: Link whose frame becomes the frame ``tool``; by default there is none.
        name: Name of the robot; by default the file's own.
        repair: Whether to make the safe repairs of ``morphgen.checks.fix``, without which some
            loaders refuse the robot. Each is named in the provenance, as is what had to be mended
            for the file to be read at all.

    Raises:
        FormatError: If the file cannot be read, or has no such link.
    """
    robot = read_urdf(path, args, default_finder(root=root))
    for option, link in (("root link", root_link), ("tool", tool)):
        if link is not None and link not in robot.link_index:
            raise FormatError(
                f"{path}: no link {link!r} for {option}{nearest(link, robot.link_index)}"
            )
    if root_link is not None:
        robot = subtree(robot, root_link)
    if tool is not None and tool not in robot.link_index:
        raise FormatError(f"{path}: tool {tool!r} is not below the root link {root_link!r}")
    if tool is not None:
        robot = _without_name_clash(robot)
        link = "tool_link" if tool == "tool" else tool
        robot = replace(robot, frames=(Frame("tool", link),))
    robot = replace(
        robot, name=robot.name if name is None else name, provenance={"source": path.name}
    )
    robot = record_repairs(robot, robot.source_findings)
    if repair:
        robot, _ = fix(robot)
    return replace(robot, ignore_pairs=survey_collisions(robot).ignore_pairs)


def _without_name_clash(robot: Robot) -> Robot:
    """A link ``tool`` becomes ``tool_link``: a bundle's URDF has a link for the frame itself."""
    return rename(
        robot,
        {"tool": "tool_link"} if "tool" in robot.link_index else {},
        {"tool_joint": "tool_link_joint"} if "tool_joint" in robot.joint_index else {},
    )

"""Write the manifest that makes an imported robot a part of a library."""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from pathlib import Path

import yaml

from morphgen.errors import CompositionError, FormatError, MorphgenError
from morphgen.formats.files import write_atomic
from morphgen.grammar.library import Library, shipped_folders
from morphgen.grammar.manifest import read_manifest
from morphgen.grammar.part import load_part
from morphgen.model.robot import TOOL, Robot


def _arm_frames(frame: Mapping[str, object]) -> dict[str, object]:
    return {"ports": {"flange": frame}}


def _tool_frames(frame: Mapping[str, object]) -> dict[str, object]:
    return {"tool": frame}


PART_KINDS: dict[str, Callable[[Mapping[str, object]], dict[str, object]]] = {
    "arm": _arm_frames,
    "ee": _tool_frames,
    "body": _tool_frames,
}
"""Kinds of parts that a robot can become, with the keys of a manifest that hold its tool frame."""
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""Names that derivations and grammars can hold."""


def part_manifest(
    robot: Robot, description: Path, kind: str, folder: Path, licence: str
) -> tuple[Path, str]:
    """Return the path of a part's manifest and its text, before anything is written.

    The frame ``tool`` of the robot becomes the port ``flange`` of an arm, and the tool of an
    end-effector or a body. The part has the robot's home.

    Args:
        robot: The robot, as its bundle holds it.
        description: The bundle's URDF.
        kind: A key of ``PART_KINDS``.
        folder: Folder of the library.
        licence: Licence of the robot.

    Raises:
        CompositionError: If the robot has no frame ``tool``.
        FormatError: If derivations cannot hold its name, morphgen has a part of this name,
            ``folder`` is a file, or the manifest exists with other content.
    """
    if not _NAME.fullmatch(robot.name):
        raise FormatError(
            f"name {robot.name!r} of a part: expected letters, digits and underscores, no digit "
            "first; import its file alone, and choose a name by --name"
        )
    if robot.name in Library(shipped_folders()).paths:
        raise FormatError(
            f"name {robot.name!r} of a part: morphgen has a part of this name; import its file "
            "alone, and choose another by --name"
        )
    if all(frame.name != TOOL for frame in robot.frames):
        raise CompositionError(
            f"robot {robot.name!r} has no frame {TOOL!r}, which is the flange or the tool of a "
            "part; name its link by --tool"
        )
    tool = robot.frame(TOOL)
    pose = tool.T_link_frame
    # Adding zero turns -0.0 into 0.0.
    xyz, rpy = ([value + 0.0 for value in values] for values in (pose.position, pose.rpy))
    frame = {"link": tool.link, "xyz": xyz, "rpy": rpy}
    joints = [robot.joints[k].name for k in robot.independent_joints]
    content = {
        "name": robot.name,
        "kind": kind,
        "summary": f"{robot.name}, imported, {robot.dof} DoF",
        "file": Path(os.path.relpath(description, folder)).as_posix(),
        "root": robot.root.name,
        "without": [frame.name for frame in robot.frames],  # links of the URDF, not of the robot
        **PART_KINDS[kind](frame),
        "home": dict(zip(joints, robot.home, strict=True)),
        "licence": licence,
    }
    text = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, default_flow_style=None)
    path = folder / f"{robot.name}.yaml"
    if folder.exists() and not folder.is_dir():
        raise FormatError(f"{folder} is not a folder; choose another --parts")
    if path.exists() and path.read_bytes() != text.encode():
        raise FormatError(f"{path} exists; move it away, or choose another folder by --parts")
    return path, text


def write_part(path: Path, text: str) -> None:
    """Write the manifest of a part whose bundle is written.

    Args:
        path: Path of ``part_manifest``.
        text: Text of ``part_manifest``.

    Raises:
        FormatError: If the manifest cannot be written.
        MorphgenError: If the robot cannot be a part.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomic(path, text)
    try:
        load_part(read_manifest(path))
    except MorphgenError:
        path.unlink()
        raise

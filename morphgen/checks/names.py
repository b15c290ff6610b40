"""Checks of names and frames: unsafe characters, name clashes and the tool frame."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from morphgen.model.findings import Finding
from morphgen.model.robot import TOOL, Robot
from morphgen.model.tree import take_name

_UNSAFE = re.compile(r"[^A-Za-z0-9_.\-]")
_WORLD = "world"
MAX_ROBOT_NAME = 200
"""Longest name of a robot [characters]."""


def check_names(robot: Robot) -> Iterator[Finding]:
    """Find empty names and names with characters that loaders misinterpret."""
    for element, names in all_names(robot).items():
        for name in names:
            if name == safe_robot_name(name) if element == "robot" else is_name_safe(name):
                continue
            characters = " ".join(repr(c) for c in dict.fromkeys(_UNSAFE.findall(name)))
            yield Finding(
                "name-characters",
                "warning",
                f"{element} {name}",
                f"its name contains {characters or 'nothing'}, invalid in paths, scopes and USD"
                if characters or not name
                else "a bundle's folder cannot have its name",
                "use letters, digits, '_', '-' and '.', in a robot's name not first and at most "
                f"{MAX_ROBOT_NAME}; the repair writes '_'",
                repair="its name was rewritten with '_' for what loaders dislike",
            )


def check_reserved(robot: Robot) -> Iterator[Finding]:
    """Find a link other than the root that has MuJoCo's reserved name ``world``."""
    if robot.link_index.get(_WORLD, 0) > 0:
        yield Finding(
            "name-reserved",
            "error",
            f"link {_WORLD}",
            "MuJoCo reserves the name 'world' for the world body, and this link is not the root",
            "rename the link, as the repair does",
            repair="it was renamed: MuJoCo keeps that name for the world",
        )


def check_frame_names(robot: Robot) -> Iterator[Finding]:
    """Find frames whose link and joint in a URDF would clash with existing names."""
    for frame in robot.frames:
        for element, name, taken in (
            ("link", frame.name, robot.link_index),
            ("joint", f"{frame.name}_joint", robot.joint_index),
        ):
            if name in taken:
                yield Finding(
                    "frame-name-taken",
                    "error",
                    f"frame {frame.name}",
                    f"a URDF represents it by a {element} {name!r}, and that name is taken",
                    "rename the frame or the " + element,
                )


def check_tool(robot: Robot) -> Iterator[Finding]:
    """Find a robot without a tool frame, or with one that no joint moves."""
    tool = next((frame for frame in robot.frames if frame.name == TOOL), None)
    if tool is None:
        yield Finding(
            "tool-missing",
            "warning",
            f"robot {robot.name}",
            "it has no frame 'tool': tasks and reach need one",
            "name the frame at the working point 'tool'",
        )
    elif robot.dof > 0 and not any(
        robot.joints[k].is_movable for k in robot.joint_chain(tool.link)
    ):
        yield Finding(
            "tool-still",
            "warning",
            f"frame {TOOL}",
            f"it is on link {tool.link}, which no joint moves",
            "put the frame on the end-effector",
        )


def is_name_safe(name: str) -> bool:
    """Return whether a name has letters, digits, ``_``, ``-`` and ``.`` only, and at least one."""
    return bool(name) and _UNSAFE.search(name) is None


def all_names(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Return all names of a robot by kind of element; they are unique within each kind."""
    return {
        "robot": (robot.name,),
        "link": tuple(link.name for link in robot.links),
        "joint": tuple(joint.name for joint in robot.joints),
        "frame": tuple(frame.name for frame in robot.frames),
    }


def safe_robot_name(name: str) -> str:
    """Return a safe name that a bundle can have: a letter or digit is first."""
    return _UNSAFE.sub("_", name).lstrip("_.-")[:MAX_ROBOT_NAME] or "robot"


def safe_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """Return a safe, unique new name for every name; safe names that are not reserved stay."""
    names, reserved = tuple(names), tuple(reserved)
    kept = {name for name in names if is_name_safe(name) and name not in reserved}
    taken = {*kept, *reserved}
    new_names: dict[str, str] = {}
    for name in names:
        new_names[name] = name if name in kept else take_name(_UNSAFE.sub("_", name) or "_", taken)
    return new_names

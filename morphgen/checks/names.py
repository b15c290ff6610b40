"""Names that loaders take as they are."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from morphgen.model.findings import Finding
from morphgen.model.robot import Robot

_DISLIKED = re.compile(r"[^A-Za-z0-9_.\-]")
_WORLD = "world"


def check_names(robot: Robot) -> Iterator[Finding]:
    """Find empty names and characters that loaders take for something else."""
    for what, names in named(robot).items():
        for name in names:
            if is_name_safe(name):
                continue
            characters = " ".join(repr(c) for c in dict.fromkeys(_DISLIKED.findall(name)))
            yield Finding(
                "name-characters",
                "warning",
                f"{what} {name}",
                f"its name holds {characters or 'nothing'}: paths, scopes and USD break on that",
                "use letters, digits, '_', '-' and '.'; the repair writes '_'",
                repair="its name was rewritten with '_' for what loaders dislike",
            )


def check_reserved(robot: Robot) -> Iterator[Finding]:
    """Find a link that has the name MuJoCo keeps for the world."""
    if robot.link_index.get(_WORLD, 0) > 0:
        yield Finding(
            "name-reserved",
            "error",
            f"link {_WORLD}",
            "MuJoCo keeps the name 'world' for what the root stands on, and this is not the root",
            "rename the link, as the repair does",
            repair="it was renamed: MuJoCo keeps that name for the world",
        )


def check_frame_names(robot: Robot) -> Iterator[Finding]:
    """Find frames that cannot be written as links of a URDF beside the others."""
    for frame in robot.frames:
        for what, name, taken in (
            ("link", frame.name, robot.link_index),
            ("joint", f"{frame.name}_joint", robot.joint_index),
        ):
            if name in taken:
                yield Finding(
                    "frame-name-taken",
                    "error",
                    f"frame {frame.name}",
                    f"in a URDF it is a {what} {name!r}, and there is one of that name",
                    "rename the frame or the " + what,
                )


def is_name_safe(name: str) -> bool:
    """Whether a name holds only letters, digits, ``_``, ``-`` and ``.``."""
    return bool(name) and _DISLIKED.search(name) is None


def named(robot: Robot) -> dict[str, tuple[str, ...]]:
    """All names of a robot by what they name; within each they are unique."""
    return {
        "robot": (robot.name,),
        "link": tuple(link.name for link in robot.links),
        "joint": tuple(joint.name for joint in robot.joints),
        "frame": tuple(frame.name for frame in robot.frames),
    }


def safe_names(names: Iterable[str], reserved: Iterable[str] = ()) -> dict[str, str]:
    """A safe and unique new name for every name; safe names that are not reserved stay."""
    names, reserved = tuple(names), tuple(reserved)
    kept = {name for name in names if is_name_safe(name) and name not in reserved}
    taken = {*kept, *reserved}
    renamed: dict[str, str] = {}
    for name in names:
        stem = new = name if name in kept else _DISLIKED.sub("_", name) or "_"
        k = 1
        while name not in kept and new in taken:
            k += 1
            new = f"{stem}_{k}"
        taken.add(new)
        renamed[name] = new
    return renamed

"""Surgery on kinematic trees."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace

from morphgen.errors import RobotError, nearest
from morphgen.model.robot import Joint, Mimic, Robot


def subtree(robot: Robot, root: str, without: Collection[str] = ()) -> Robot:
    """The part of a robot below a link.

    Args:
        robot: The whole.
        root: Link where the part begins.
        without: Links that are left out with all below them.

    Returns:
        The links below ``root`` and the joints, home, frames and ignore pairs among them.

    Raises:
        RobotError: If a link does not exist, or a kept joint mimics one that is not kept.
    """
    for name in (root, *without):
        robot.link(name)
    kept = {root}
    joints: list[Joint] = []
    for joint in robot.joints:
        if joint.parent in kept and joint.child not in without:
            kept.add(joint.child)
            joints.append(joint)
    names = {joint.name for joint in joints}
    for joint in joints:
        if joint.mimic is not None and joint.mimic.joint not in names:
            raise RobotError(
                f"robot {robot.name!r}: joint {joint.name!r} mimics {joint.mimic.joint!r}, "
                f"which is not in the part below {root!r}" + nearest(joint.mimic.joint, names)
            )
    rest = {robot.joints[k].name: q for k, q in zip(robot.independent, robot.home, strict=True)}
    return replace(
        robot,
        links=tuple(robot.link(name) for name in (root, *(joint.child for joint in joints))),
        joints=tuple(joints),
        home=tuple(rest[joint.name] for joint in joints if joint.is_independent),
        frames=tuple(frame for frame in robot.frames if frame.link in kept),
        ignore_pairs=tuple((a, b) for a, b in robot.ignore_pairs if a in kept and b in kept),
    )


def renamed(
    robot: Robot, links: Mapping[str, str] | None = None, joints: Mapping[str, str] | None = None
) -> Robot:
    """A robot whose links and joints of the given names have new ones."""
    link_names, joint_names = links or {}, joints or {}

    def link(name: str) -> str:
        return link_names.get(name, name)

    def joint(name: str) -> str:
        return joint_names.get(name, name)

    def mimic(old: Mimic | None) -> Mimic | None:
        return None if old is None else replace(old, joint=joint(old.joint))

    return replace(
        robot,
        links=tuple(replace(old, name=link(old.name)) for old in robot.links),
        joints=tuple(
            replace(
                old,
                name=joint(old.name),
                parent=link(old.parent),
                child=link(old.child),
                mimic=mimic(old.mimic),
            )
            for old in robot.joints
        ),
        frames=tuple(replace(old, link=link(old.link)) for old in robot.frames),
        ignore_pairs=tuple(
            sorted((min(p), max(p)) for a, b in robot.ignore_pairs for p in [(link(a), link(b))])
        ),
    )

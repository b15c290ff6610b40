"""Composition: a derivation to one robot, parts joined flange to mount."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import lru_cache

from morphgen.checks.self_collision import ignore_pairs
from morphgen.errors import CompositionError, nearest
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.parameters import MOUNT_YAW
from morphgen.grammar.part import Part, load_part
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import Frame, Joint, Link, Mimic, Pair, Robot, sorted_pair
from morphgen.model.rotation import from_rpy


@dataclass(frozen=True)
class Placed:
    """A part under its scope in the tree."""

    label: str
    part: Part
    mount_yaw: float

    def scoped(self, name: str) -> str:
        """A name of the part in the robot."""
        return f"{self.label}_{name}"


def compose(derivation: Derivation, library: Library, name: str) -> Robot:
    """Build the robot of a derivation, with its self-collision pairs to ignore.

    Args:
        derivation: Parts, parameters and attachments.
        library: Where the parts are.
        name: The robot's name.

    Raises:
        CompositionError: If a part has no such port, or names clash.
        PartError: If a part or parameter is unknown or wrong.
        FormatError: If a part's source cannot be read.
    """
    robot = join(derivation, library, name)
    return replace(robot, ignore_pairs=_ignored(robot, place(derivation, library).values()))


def join(derivation: Derivation, library: Library, name: str) -> Robot:
    """Build the robot of a derivation without looking at collisions."""
    links: list[Link] = []
    joints: list[Joint] = []
    home: list[float] = []
    tools: list[tuple[str, Frame]] = []
    placed = place(derivation, library)

    def add(node: Derivation, parent: str | None, T_parent_port: Pose) -> None:
        here = placed[node.label]
        part = here.part
        root = here.scoped(part.body.root.name)
        T_port_mount = Pose(quaternion=from_rpy((0.0, 0.0, here.mount_yaw)))
        T_parent_root = T_parent_port @ T_port_mount @ part.T_root_mount.inverse()
        if parent is not None:
            joints.append(Joint(here.scoped("mount"), "fixed", parent, root, T_parent_root))
        elif not part.T_root_mount.is_identity:
            raise CompositionError(
                f"{part.manifest.name!r} needs a base: its mount is not its root"
            )
        links.extend(replace(link, name=here.scoped(link.name)) for link in part.body.links)
        joints.extend(_scoped_joint(joint, here) for joint in part.body.joints)
        home.extend(part.body.home)
        for port, child in node.children:
            if port not in part.ports:
                raise CompositionError(
                    f"{part.manifest.name!r} has no port {port!r}{nearest(port, part.ports)}"
                )
            frame = part.ports[port]
            add(child, here.scoped(frame.link), frame.T_link_frame)
        if part.tool is not None and not node.children:
            tools.append((node.label, replace(part.tool, link=here.scoped(part.tool.link))))

    add(derivation, None, IDENTITY)
    return Robot(
        name,
        tuple(links),
        tuple(joints),
        _tool_frames(tools),
        tuple(home),
        provenance={
            "derivation": str(derivation),
            "parts": _provenance(placed.values()),
            "accepted": {
                here.scoped(name): dict(whys)
                for here in placed.values()
                for name, whys in here.part.manifest.accepted.items()
            },
        },
    )


def place(derivation: Derivation, library: Library) -> dict[str, Placed]:
    """Load every part of a derivation; by label, parents first."""
    placed: dict[str, Placed] = {}
    for node in derivation.walk():
        if node.label in placed:
            raise CompositionError(f"two parts are labelled {node.label!r}")
        values = dict(node.parameters)
        yaw = values.pop(MOUNT_YAW.name, 0.0)
        placed[node.label] = Placed(node.label, load_part(library.manifest(node.part), values), yaw)
    return placed


def _scoped_joint(joint: Joint, here: Placed) -> Joint:
    mimic = joint.mimic
    if mimic is not None:
        mimic = Mimic(here.scoped(mimic.joint), mimic.multiplier, mimic.offset)
    return replace(
        joint,
        name=here.scoped(joint.name),
        parent=here.scoped(joint.parent),
        child=here.scoped(joint.child),
        mimic=mimic,
    )


def _tool_frames(tools: list[tuple[str, Frame]]) -> tuple[Frame, ...]:
    """``tool``, and with several limbs ``<limb>_tool`` each; ``tool`` is then the last limb's."""
    if not tools:
        return ()
    if len(tools) == 1:
        return (replace(tools[0][1], name="tool"),)
    named = [replace(frame, name=f"{label.removesuffix('_ee')}_tool") for label, frame in tools]
    return (replace(named[-1], name="tool"), *named)


def _provenance(placed: Iterable[Placed]) -> list[dict[str, object]]:
    return [
        {
            "label": here.label,
            "part": here.part.manifest.name,
            "summary": here.part.manifest.summary,
            "licence": here.part.manifest.licence,
            "citation": here.part.manifest.citation,
            **({"notes": here.part.manifest.notes} if here.part.manifest.notes else {}),
        }
        for here in placed
    ]


def _ignored(robot: Robot, placed: Iterable[Placed]) -> tuple[Pair, ...]:
    """Pairs to ignore: those of each part by itself, and those across parts."""
    owner: dict[str, str] = {}
    known: list[Pair] = []
    for here in placed:
        owner |= {here.scoped(link.name): here.label for link in here.part.body.links}
        known += [sorted_pair(here.scoped(a), here.scoped(b)) for a, b in part_pairs(here.part)]
    return ignore_pairs(robot, known=known, check=lambda a, b: owner[a] != owner[b])


@lru_cache(maxsize=256)
def part_pairs(part: Part) -> tuple[Pair, ...]:
    """Pairs of a part's own links whose contact is no self-collision."""
    return ignore_pairs(part.body)

"""Compose the robot of a derivation: attach the mount of each part to a port of its parent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from morphgen.checks.self_collision import CollisionSurvey, survey_collisions
from morphgen.errors import CompositionError, nearest
from morphgen.files import kept
from morphgen.formats.fits import with_stored_fits
from morphgen.grammar.library import Library
from morphgen.grammar.manifest import MOUNT_YAW, MOUNT_YAW_PARAMETER, require_range
from morphgen.grammar.part import Part, load_part
from morphgen.grammar.syntax import Derivation
from morphgen.model.geometry import IDENTITY, Mesh, Pose
from morphgen.model.mesh import mesh_key
from morphgen.model.robot import Frame, Joint, Link, Mimic, Pair, Robot, sorted_pair
from morphgen.model.rotation import from_rpy

MAX_HOME_OVERLAP = 2e-3
"""Largest penetration at home of links of different parts that counts as touching [m]."""


@dataclass(frozen=True)
class ScopedPart:
    """A part whose names are prefixed with its label in the derivation."""

    label: str
    part: Part
    mount_yaw: float  # rotation about the axis of the parent's port [rad]

    def scoped(self, name: str) -> str:
        """Return the robot's name for a link or joint of the part."""
        return f"{self.label}_{name}"


def compose(derivation: Derivation, library: Library, name: str) -> Robot:
    """Build the robot of a derivation, with its ignored collision pairs and its stored fits."""
    robot = with_stored_fits(join(derivation, library, name), library.folders)
    return replace(robot, ignore_pairs=survey_contacts(robot, derivation, library).ignore_pairs)


def join(derivation: Derivation, library: Library, name: str) -> Robot:
    """Build the robot of a derivation without collision tests.

    A part whose root is an empty link is merged with its parent. The tool is that of the outermost
    part with a tool, or the first port of the last part.
    """
    parts = load_parts(derivation, library)
    assembly = _Assembly(parts)
    assembly.attach(derivation, None, IDENTITY, owns_tool=True)
    return Robot(
        name,
        tuple(assembly.links),
        tuple(assembly.joints),
        _tool_frames(assembly.tools),
        tuple(assembly.home),
        provenance={
            "derivation": str(derivation),
            "parts": [_part_provenance(scoped) for scoped in parts.values()],
            "accepted": {
                scoped.scoped(link): dict(reasons)
                for scoped in parts.values()
                for link, reasons in scoped.part.manifest.accepted.items()
            },
        },
    )


class _Assembly:
    """An unfinished robot; parts are appended after their parents."""

    def __init__(self, parts: Mapping[str, ScopedPart]) -> None:
        self._parts = parts
        self._merged: dict[str, Frame] = {}
        """Frames of roots that were merged with their parents, by the root's name."""
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self.home: list[float] = []
        self.tools: list[tuple[str, Frame]] = []  # tool frames with the labels of their parts

    def attach(
        self, node: Derivation, parent: str | None, T_parent_port: Pose, *, owns_tool: bool
    ) -> None:
        """Attach a part to a port of a link, then the node's children to the part."""
        scoped = self._parts[node.label]
        part = scoped.part
        self._attach_root(scoped, parent, T_parent_port)
        self.links += (
            replace(link, name=scoped.scoped(link.name)) for link in part.fragment.links[1:]
        )
        self.joints += (self._scoped_joint(joint, scoped) for joint in part.fragment.joints)
        self.home += part.fragment.home
        ports = [port for port, _ in node.children]
        for i, (port, child) in enumerate(node.children):
            if port in ports[:i]:
                raise CompositionError(
                    f"port {port!r} of {part.manifest.name!r} is already taken: it cannot hold "
                    f"{child.label!r}, too"
                )
            if port not in part.ports:
                raise CompositionError(
                    f"{part.manifest.name!r} has no port {port!r}{nearest(port, part.ports)}"
                )
            frame = self._scoped_frame(part.ports[port], scoped)
            child_owns_tool = owns_tool and part.tool is None
            self.attach(child, frame.link, frame.T_link_frame, owns_tool=child_owns_tool)
        tool = part.tool or (None if node.children else next(iter(part.ports.values()), None))
        if owns_tool and tool is not None:
            self.tools.append((node.label, self._scoped_frame(tool, scoped)))

    def _attach_root(self, scoped: ScopedPart, parent: str | None, T_parent_port: Pose) -> None:
        part, link = scoped.part, scoped.part.fragment.root
        root = scoped.scoped(link.name)
        if parent is None:
            require_root(part)
            self.links.append(replace(link, name=root))
            return
        T_port_mount = Pose(quaternion=from_rpy((0.0, 0.0, scoped.mount_yaw)))
        T_parent_root = T_parent_port @ T_port_mount @ part.T_root_mount.inverse()
        if link.is_empty:
            self._merged[root] = Frame(root, parent, T_parent_root)
            return
        self.links.append(replace(link, name=root))
        self.joints.append(Joint(scoped.scoped("mount"), "fixed", parent, root, T_parent_root))

    def _scoped_frame(self, frame: Frame, scoped: ScopedPart) -> Frame:
        """Return a part's frame on the robot's link, which is the parent of a merged root."""
        link = scoped.scoped(frame.link)
        if link not in self._merged:
            return replace(frame, link=link)
        root = self._merged[link]
        return Frame(frame.name, root.link, root.T_link_frame @ frame.T_link_frame)

    def _scoped_joint(self, joint: Joint, scoped: ScopedPart) -> Joint:
        mimic = joint.mimic
        if mimic is not None:
            mimic = Mimic(scoped.scoped(mimic.joint), mimic.multiplier, mimic.offset)
        origin = self._scoped_frame(Frame(joint.name, joint.parent, joint.T_parent_joint), scoped)
        return replace(
            joint,
            name=scoped.scoped(joint.name),
            parent=origin.link,
            child=scoped.scoped(joint.child),
            T_parent_joint=origin.T_link_frame,
            mimic=mimic,
        )


def require_root(part: Part) -> None:
    """Require that a part can be the first of a robot."""
    if not part.T_root_mount.is_identity:
        raise CompositionError(f"{part.manifest.name!r} needs a base: its mount is not its root")


def load_parts(derivation: Derivation, library: Library) -> dict[str, ScopedPart]:
    """Return every part of a derivation by its label, parents before their children."""
    parts: dict[str, ScopedPart] = {}
    for node in derivation.walk():
        if node.label in parts:
            raise CompositionError(f"two parts are labelled {node.label!r}")
        part = load_part(library.manifest(node.part), part_values(node))
        values = dict(node.parameters)
        if MOUNT_YAW in values and not parts:
            what = f"{node.label!r} is not attached to a port"
            raise CompositionError(f"{what}: it has no {MOUNT_YAW}")
        yaw = values.get(MOUNT_YAW, 0.0)
        require_range(yaw, MOUNT_YAW_PARAMETER, f"{node.label}.{MOUNT_YAW}")
        parts[node.label] = ScopedPart(node.label, part, yaw)
    return parts


def part_values(node: Derivation) -> dict[str, float]:
    """Return the parameters of a node's part, without that of how it is attached."""
    return {name: value for name, value in node.parameters if name != MOUNT_YAW}


def _tool_frames(tools: list[tuple[str, Frame]]) -> tuple[Frame, ...]:
    """Return ``tool``; for several limbs also ``<limb>_tool`` each, and ``tool`` is the last."""
    if not tools:
        return ()
    if len(tools) == 1:
        return (replace(tools[0][1], name="tool"),)
    named = [replace(frame, name=f"{label.removesuffix('_ee')}_tool") for label, frame in tools]
    return (replace(named[-1], name="tool"), *named)


def _part_provenance(scoped: ScopedPart) -> dict[str, object]:
    manifest = scoped.part.manifest
    return {
        "label": scoped.label,
        "part": manifest.name,
        "summary": manifest.summary,
        "licence": manifest.licence,
        "citation": manifest.citation,
        **({"notes": manifest.notes} if manifest.notes else {}),
    }


def survey_contacts(robot: Robot, derivation: Derivation, library: Library) -> CollisionSurvey:
    """Find the pairs of links of a joined robot whose contacts are ignored.

    Pairs within an unscaled real part are known. Parts that penetrate each other at home by more
    than ``MAX_HOME_OVERLAP`` are not ignored: ``check`` reports such a faulty composition.
    """
    owner: dict[str, str] = {}  # label of the part of each link
    tested: set[str] = set()  # links whose contacts within their own part are not known
    known: list[Pair] = []
    for scoped in load_parts(derivation, library).values():
        manifest = scoped.part.manifest
        names = [scoped.scoped(link.name) for link in scoped.part.fragment.links]
        owner |= dict.fromkeys(names, scoped.label)
        if manifest.is_template or manifest.scaling:
            tested.update(names)
        if not manifest.is_template:
            for a, b in _ignored_in_part(load_part(manifest)):
                pair = sorted_pair(scoped.scoped(a), scoped.scoped(b))
                if robot.link_index.keys() >= set(pair):
                    known.append(pair)
    survey = survey_collisions(
        robot, known_pairs=known, should_test=lambda a, b: owner[a] != owner[b] or a in tested
    )
    depths = survey.home_penetrations
    ignored = (
        (a, b)
        for a, b in survey.ignore_pairs
        if owner[a] == owner[b] or depths.get((a, b), 0.0) <= MAX_HOME_OVERLAP
    )
    return CollisionSurvey(tuple(ignored), depths)


@lru_cache(maxsize=256)
def _ignored_in_part(part: Part) -> tuple[Pair, ...]:
    fragment = part.fragment
    collisions = (shape.geometry for link in fragment.links for shape in link.collisions)
    key = (fragment, *(mesh_key(each) for each in collisions if isinstance(each, Mesh)))

    if None in key:
        return survey_collisions(fragment).ignore_pairs
    return kept("pairs", key, lambda: survey_collisions(fragment).ignore_pairs)

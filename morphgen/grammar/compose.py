"""Composition: a derivation to one robot, parts joined flange to mount."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache

from morphgen.checks.self_collision import CollisionSurvey, survey_collisions
from morphgen.errors import CompositionError, nearest
from morphgen.formats.fits import with_stored_fits
from morphgen.grammar.derivation import Derivation
from morphgen.grammar.library import Library
from morphgen.grammar.parameters import MOUNT_YAW
from morphgen.grammar.part import Part, load_part
from morphgen.model.geometry import IDENTITY, Pose
from morphgen.model.robot import Frame, Joint, Link, Mimic, Pair, Robot, sorted_pair
from morphgen.model.rotation import from_rpy

MAX_HOME_OVERLAP = 2e-3
"""Depth to which links that are not neighbours may touch at home, metres."""


@dataclass(frozen=True)
class ScopedPart:
    """A part under its scope in the tree."""

    label: str
    part: Part
    mount_yaw: float

    def scoped(self, name: str) -> str:
        """A name of the part in the robot."""
        return f"{self.label}_{name}"


def compose(derivation: Derivation, library: Library, name: str) -> Robot:
    """Build the robot of a derivation, with its self-collision pairs to ignore and stored fits.

    Args:
        derivation: Parts, parameters and attachments.
        library: Where the parts are.
        name: The robot's name.

    Raises:
        CompositionError: If a part has no such port, or names clash.
        PartError: If a part or parameter is unknown or wrong.
        FormatError: If a part's source or stored fits cannot be read.
    """
    robot = with_stored_fits(join(derivation, library, name), library.folders)
    return replace(robot, ignore_pairs=survey_contacts(robot, derivation, library).ignore_pairs)


def join(derivation: Derivation, library: Library, name: str) -> Robot:
    """Build the robot of a derivation without looking at collisions.

    A part whose root is a bare frame dissolves it: what hangs on the root hangs on the parent.
    The tool is that of the outermost part which has one, else the first port of the last part.
    """
    placed = load_parts(derivation, library)
    assembly = _Assembly(placed)
    assembly.add(derivation, None, IDENTITY, owns_tool=True)
    return Robot(
        name,
        tuple(assembly.links),
        tuple(assembly.joints),
        _tool_frames(assembly.tools),
        tuple(assembly.home),
        provenance={
            "derivation": str(derivation),
            "parts": _provenance(placed.values()),
            "accepted": {
                here.scoped(link): dict(whys)
                for here in placed.values()
                for link, whys in here.part.manifest.accepted.items()
            },
        },
    )


class _Assembly:
    """A robot being put together, parts appended parents first."""

    def __init__(self, placed: Mapping[str, ScopedPart]) -> None:
        self._placed = placed
        self._dissolved: dict[str, Frame] = {}
        self.links: list[Link] = []
        self.joints: list[Joint] = []
        self.home: list[float] = []
        self.tools: list[tuple[str, Frame]] = []

    def add(
        self, node: Derivation, parent: str | None, T_parent_port: Pose, *, owns_tool: bool
    ) -> None:
        """Attach a part, and then what is attached to it."""
        here = self._placed[node.label]
        part = here.part
        self._add_root(here, parent, T_parent_port)
        self.links.extend(
            replace(link, name=here.scoped(link.name)) for link in part.fragment.links[1:]
        )
        self.joints.extend(self._scoped(joint, here) for joint in part.fragment.joints)
        self.home.extend(part.fragment.home)
        for port, child in node.children:
            if port not in part.ports:
                raise CompositionError(
                    f"{part.manifest.name!r} has no port {port!r}{nearest(port, part.ports)}"
                )
            frame = self._frame(part.ports[port], here)
            self.add(
                child, frame.link, frame.T_link_frame, owns_tool=owns_tool and part.tool is None
            )
        tool = part.tool or (None if node.children else next(iter(part.ports.values()), None))
        if owns_tool and tool is not None:
            self.tools.append((node.label, self._frame(tool, here)))

    def _add_root(self, here: ScopedPart, parent: str | None, T_parent_port: Pose) -> None:
        part = here.part
        root = here.scoped(part.fragment.root.name)
        if parent is None:
            require_root(part)
            self.links.append(replace(part.fragment.root, name=root))
            return
        T_port_mount = Pose(quaternion=from_rpy((0.0, 0.0, here.mount_yaw)))
        T_parent_root = T_parent_port @ T_port_mount @ part.T_root_mount.inverse()
        if part.fragment.root.is_empty:
            self._dissolved[root] = Frame(root, parent, T_parent_root)
            return
        self.links.append(replace(part.fragment.root, name=root))
        self.joints.append(Joint(here.scoped("mount"), "fixed", parent, root, T_parent_root))

    def _frame(self, frame: Frame, here: ScopedPart) -> Frame:
        """A part's frame on a link of the robot."""
        link = here.scoped(frame.link)
        if link not in self._dissolved:
            return replace(frame, link=link)
        parent = self._dissolved[link]
        return Frame(frame.name, parent.link, parent.T_link_frame @ frame.T_link_frame)

    def _scoped(self, joint: Joint, here: ScopedPart) -> Joint:
        mimic = joint.mimic
        if mimic is not None:
            mimic = Mimic(here.scoped(mimic.joint), mimic.multiplier, mimic.offset)
        on = self._frame(Frame(joint.name, joint.parent, joint.T_parent_joint), here)
        return replace(
            joint,
            name=here.scoped(joint.name),
            parent=on.link,
            child=here.scoped(joint.child),
            T_parent_joint=on.T_link_frame,
            mimic=mimic,
        )


def require_root(part: Part) -> None:
    """Require that a part can stand on its own.

    Raises:
        CompositionError: If it hangs from its mount.
    """
    if not part.T_root_mount.is_identity:
        raise CompositionError(f"{part.manifest.name!r} needs a base: its mount is not its root")


def load_parts(derivation: Derivation, library: Library) -> dict[str, ScopedPart]:
    """Load every part of a derivation; by label, parents first."""
    placed: dict[str, ScopedPart] = {}
    for node in derivation.walk():
        if node.label in placed:
            raise CompositionError(f"two parts are labelled {node.label!r}")
        part = load_part(library.manifest(node.part), part_values(node))
        yaw = dict(node.parameters).get(MOUNT_YAW.name, 0.0)
        placed[node.label] = ScopedPart(node.label, part, yaw)
    return placed


def part_values(node: Derivation) -> dict[str, float]:
    """The parameters of a part itself, without those of how it is mounted."""
    return {name: value for name, value in node.parameters if name != MOUNT_YAW.name}


def _tool_frames(tools: list[tuple[str, Frame]]) -> tuple[Frame, ...]:
    """``tool``, and with several limbs ``<limb>_tool`` each; ``tool`` is then the last limb's."""
    if not tools:
        return ()
    if len(tools) == 1:
        return (replace(tools[0][1], name="tool"),)
    named = [replace(frame, name=f"{label.removesuffix('_ee')}_tool") for label, frame in tools]
    return (replace(named[-1], name="tool"), *named)


def _provenance(placed: Iterable[ScopedPart]) -> list[dict[str, object]]:
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


def survey_contacts(robot: Robot, derivation: Derivation, library: Library) -> CollisionSurvey:
    """Which contacts of a joined robot are no self-collision.

    Those of each real part, as it is made, are known from before; all others are tested. Parts
    that overlap at home by more than ``MAX_HOME_OVERLAP`` are not ignored: ``check`` reports such
    a faulty composition.
    """
    owner: dict[str, str] = {}
    tested: set[str] = set()
    known: list[Pair] = []
    for here in load_parts(derivation, library).values():
        manifest = here.part.manifest
        names = [here.scoped(link.name) for link in here.part.fragment.links]
        owner |= dict.fromkeys(names, here.label)
        if manifest.is_template or manifest.scaling:
            tested.update(names)
        if not manifest.is_template:
            pairs = [(here.scoped(a), here.scoped(b)) for a, b in part_pairs(load_part(manifest))]
            known += [sorted_pair(a, b) for a, b in pairs if {a, b} <= robot.link_index.keys()]
    found = survey_collisions(
        robot, known_pairs=known, should_test=lambda a, b: owner[a] != owner[b] or a in tested
    )
    faulty = {
        (a, b)
        for (a, b), depth in found.home_penetrations.items()
        if owner[a] != owner[b] and depth > MAX_HOME_OVERLAP
    }
    return CollisionSurvey(
        tuple(pair for pair in found.ignore_pairs if pair not in faulty), found.home_penetrations
    )


@lru_cache(maxsize=256)
def part_pairs(part: Part) -> tuple[Pair, ...]:
    """Pairs of a part's own links whose contact is no self-collision."""
    return survey_collisions(part.fragment).ignore_pairs

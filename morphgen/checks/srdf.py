"""Read and write SRDF, MoveIt's description beside a URDF: groups, and pairs that need no test.

cuRobo's configuration has the same pairs and spheres.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import yaml
from lxml import etree

from morphgen.checks.self_collision import ALWAYS_SHARE, SelfCollisionChecker, adjacent_pairs
from morphgen.errors import FormatError, nearest, shortened
from morphgen.formats.data_files import read_bytes
from morphgen.formats.xml import parse_xml, read_schema
from morphgen.model.geometry import Sphere
from morphgen.model.kinematics import random_configurations
from morphgen.model.robot import TOOL, Frame, Pair, Robot, sorted_pair
from morphgen.model.rotation import Vec3
from morphgen.model.tree import below

MATRIX_SAMPLES = 10_000  # number of sampled configurations, the default of MoveIt's setup assistant


def collision_matrix(robot: Robot, samples: int = MATRIX_SAMPLES) -> dict[Pair, str]:
    """Return pairs of links whose collisions need no test, with the reasons of docs/bundle.md.

    As in all collision checks, meshes count as their convex hulls. These contain their meshes, so a
    pair that never collides is safe for planners that test the meshes, too.
    """
    loose, columns = _with_loose_joints(robot)
    collidable = [link.name for link in robot.links if link.collisions]
    pairs = sorted({sorted_pair(a, b) for a, b in combinations(collidable, 2)})
    checker = SelfCollisionChecker(loose, ())
    q = np.zeros((samples + 1, loose.dof))  # the first row is home
    q[0, columns] = robot.home
    q[1:, columns] = random_configurations(robot, samples, np.random.default_rng(0))
    penetrations = checker.penetrations(q)
    at_home = next(penetrations)
    collisions = Counter(pair for depths in penetrations for pair in depths)
    adjacent = set(adjacent_pairs(loose))  # as in MoveIt, links on fixed joints are not merged
    reasons: dict[Pair, str] = dict.fromkeys(robot.ignore_pairs, "User")
    for pair in pairs:
        if pair in adjacent:
            reasons[pair] = "Adjacent"
        elif pair in at_home:
            reasons[pair] = "Default"
        elif collisions[pair] >= ALWAYS_SHARE * samples:
            reasons[pair] = "Always"
        elif not collisions[pair]:
            reasons[pair] = "Never"
    return dict(sorted(reasons.items()))


def _with_loose_joints(robot: Robot) -> tuple[Robot, list[int]]:
    """Replace fixed joints by slides, because MuJoCo never tests links on fixed joints.

    Also return the columns of its ``q`` that hold the independent joints; the slides stay at zero.
    """
    joints = tuple(
        joint if joint.is_movable else replace(joint, kind="prismatic", axis=(1, 0, 0), mimic=None)
        for joint in robot.joints
    )
    independent = [k for k, joint in enumerate(joints) if joint.is_independent]
    loose = replace(robot, joints=joints, home=(0.0,) * len(independent))
    return loose, [independent.index(k) for k in robot.independent_joints]


def robot_srdf_text(robot: Robot, samples: int = MATRIX_SAMPLES) -> str:
    """Return the SRDF of a robot as text.

    Every tool has a group ``arm``, the chain from the root, and ``ee`` if it has an end-effector:
    the links of its part, or those around the joints that do not move the tool. The groups of a
    robot with several limbs are named after them, such as ``left_arm``. Links that collide as
    spheres alone have them as a ``link_sphere_approximation``.
    """
    _require_tool(robot)
    reasons = collision_matrix(robot, samples)
    root = etree.Element("robot", name=robot.name)
    _write_limbs(root, robot, [*_limbs(robot)])
    for link, balls in _link_spheres(robot).items():
        element = etree.SubElement(root, "link_sphere_approximation", link=link)
        for center, radius in balls:
            values = {"center": _numbers(*center), "radius": _numbers(radius)}
            etree.SubElement(element, "sphere", values)
    for (a, b), reason in reasons.items():
        etree.SubElement(root, "disable_collisions", link1=a, link2=b, reason=reason)
    etree.indent(root)
    return etree.tostring(root, encoding="unicode") + "\n"


def curobo_text(robot: Robot, urdf: str, samples: int = MATRIX_SAMPLES) -> str:
    """Return a robot's configuration for cuRobo (format version 2.0) as YAML, beside its URDF."""
    _require_tool(robot)
    spheres = _link_spheres(robot)
    if not spheres or any(link.collisions and link.name not in spheres for link in robot.links):
        raise FormatError(
            f"robot {robot.name!r} collides with other shapes than spheres, or not at all; fit "
            "them first (morphgen fit ROBOT --spheres N --out DIR), and export DIR"
        )
    # "tool" of a robot with several limbs is the tool of the last one.
    names = (frame.name for frame in robot.frames)
    tools = [name for name in names if name.endswith(f"_{TOOL}")] or [TOOL]
    joints = [robot.joints[k].name for k in robot.independent_joints]
    ignore = defaultdict(list)
    for a, b in collision_matrix(robot, samples):
        if a in spheres and b in spheres:
            ignore[a].append(b)
    kinematics = {
        "format_version": 2.0,
        "urdf_path": urdf,
        "asset_root_path": "",
        "base_link": robot.root.name,
        "tool_frames": tools,
        "collision_link_names": list(spheres),
        "collision_spheres": {
            link: [{"center": list(center), "radius": radius} for center, radius in balls]
            for link, balls in spheres.items()
        },
        "collision_sphere_buffer": 0.0,
        "self_collision_ignore": dict(ignore),
        "self_collision_buffer": dict.fromkeys(spheres, 0.0),
        "mesh_link_names": [link.name for link in robot.links if link.visuals],
        "cspace": {
            "joint_names": joints,
            "default_joint_position": list(robot.home),
            "null_space_weight": [1.0] * len(joints),
            "cspace_distance_weight": [1.0] * len(joints),
        },
    }
    data = {"robot_cfg": {"kinematics": kinematics}}
    return yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)


def _require_tool(robot: Robot) -> None:
    if robot.tool is None:
        raise FormatError(
            f"robot {robot.name!r} has no frame {TOOL!r}, where its arm ends; import it with a "
            "tool (morphgen import FILE --tool LINK)"
        )


def _link_spheres(robot: Robot) -> dict[str, list[tuple[Vec3, float]]]:
    """Return centres and radii [m] of the links that collide as spheres alone, by link name."""
    return {
        link.name: [
            (shape.T_link_shape.position, shape.geometry.radius)
            for shape in link.collisions
            if isinstance(shape.geometry, Sphere)
        ]
        for link in robot.links
        if link.collisions and all(isinstance(each.geometry, Sphere) for each in link.collisions)
    }


def _write_limbs(root: etree._Element, robot: Robot, limbs: Sequence[_Limb]) -> None:
    """Write the groups of limbs, their home configuration and the end-effectors."""
    joints_of: dict[str, list[str]] = {}
    for limb in limbs:
        group = etree.SubElement(root, "group", name=limb.arm)
        etree.SubElement(group, "chain", base_link=robot.root.name, tip_link=limb.tool)
        chain = robot.joint_chain(robot.frame(limb.tool).link)
        joints_of[limb.arm] = [robot.joints[k].name for k in chain]
        if limb.links:
            group = etree.SubElement(root, "group", name=limb.hand)
            for name in limb.links:
                etree.SubElement(group, "link", name=name)
            joints_of[limb.hand] = [j.name for j in robot.joints if j.child in limb.links]
    names = (robot.joints[k].name for k in robot.independent_joints)
    home = dict(zip(names, robot.home, strict=True))
    for group_name, joints in joints_of.items():
        if movable := [name for name in joints if name in home]:
            state = etree.SubElement(root, "group_state", name="home", group=group_name)
            for name in movable:
                etree.SubElement(state, "joint", name=name, value=_numbers(home[name]))
    for limb in limbs:
        if limb.links:
            carrier = robot.links[robot.parents[robot.link_index[limb.links[0]]]].name
            ends = {"name": limb.hand, "parent_link": carrier, "group": limb.hand}
            etree.SubElement(root, "end_effector", ends | {"parent_group": limb.arm})


def _numbers(*values: float) -> str:
    """Return numbers with all their digits, so that reading them back is exact."""
    return " ".join(repr(float(value)) for value in values)


class _Limb(NamedTuple):
    """An arm and its end-effector."""

    arm: str
    tool: str
    hand: str
    links: list[str]  # links of the end-effector, if there is one


def _limbs(robot: Robot) -> Iterator[_Limb]:
    """Yield the limbs; ``tool`` of a robot with several is the tool of the last and left out."""
    tools = [frame for frame in robot.frames if frame.name.endswith(f"_{TOOL}")]
    for tool in tools or [robot.frame(TOOL)]:
        prefix = tool.name.removesuffix(TOOL).removesuffix("arm_")
        links = _part_links(robot, f"{prefix}ee") or _gripper_links(robot, tool)
        has_parent = bool(links) and links[0] != robot.root.name
        yield _Limb(f"{prefix}arm", tool.name, f"{prefix}ee", links if has_parent else [])


def _part_links(robot: Robot, label: str) -> list[str]:
    """Return the links of a part of a composed robot; none if the robot has no such part."""
    parts = robot.provenance.get("parts")
    if not isinstance(parts, list) or all(part["label"] != label for part in parts):
        return []
    return [link.name for link in robot.links if link.name.startswith(f"{label}_")]


def _gripper_links(robot: Robot, tool: Frame) -> list[str]:
    """Return the links of a gripper, from the hand that carries its joints on; none without one.

    A hand that the last joint before the tool moves is of the arm: MoveIt adds links above joints.
    """
    chain = robot.joint_chain(tool.link)
    moving = [k for k in chain if robot.joints[k].is_movable]
    if not moving:
        return []
    hand = below(robot.parents, moving[-1] + 1)
    gripper = [k for k in robot.movable_joints if k + 1 in hand and k not in chain]
    if not gripper:
        return []
    chains = [(0, *(i + 1 for i in robot.joint_chain(robot.joints[k].parent))) for k in gripper]
    shared = [links[0] for links in zip(*chains, strict=False) if len(set(links)) == 1]
    links = below(robot.parents, shared[-1])
    if links[0] == moving[-1] + 1:
        links = links[1:]
    return [robot.links[i].name for i in links]


MAX_SRDF_BYTES = 16 * 2**20  # size of the largest SRDF that is read [bytes]


def read_srdf(path: Path) -> etree._Element:
    """Return the root of an SRDF file, whose pairs of links are complete."""
    return parse_srdf(read_bytes(path, MAX_SRDF_BYTES), str(path))


def parse_srdf(data: bytes, origin: str) -> etree._Element:
    """Return the root of SRDF text; see ``read_srdf``."""
    root, schema = parse_xml(data, origin), read_schema("srdf")
    if root.tag != "robot":
        raise FormatError(f"{origin}: root element <{shortened(str(root.tag))}>; expected <robot>")
    for element in root:
        tag, attributes = str(element.tag), element.attrib
        where = f"{origin}:{element.sourceline}: <{shortened(tag)}>"
        if tag not in schema.children["robot"]:
            raise FormatError(
                f"{where} is unknown in <robot>{nearest(tag, schema.children['robot'])}"
            )
        rules = {attribute.name: attribute.required for attribute in schema.attributes.get(tag, ())}
        for name in (name for name, is_required in rules.items() if is_required):
            if not attributes.get(name):
                raise FormatError(f"{where}: missing attribute {name!r}")
        for name in map(str, attributes) if rules else ():
            if name not in rules:
                hint = nearest(name, rules)
                raise FormatError(f"{where}: unknown attribute {shortened(name)!r}{hint}")
    return root


def disabled_link_pairs(root: etree._Element, links: Iterable[str]) -> tuple[Pair, ...]:
    """Return the pairs of links whose collisions an SRDF disables, sorted."""

    def pairs_of(tag: str) -> set[Pair]:
        return {sorted_pair(e.get("link1", ""), e.get("link2", "")) for e in root.iterfind(tag)}

    unchecked = [element.get("link", "") for element in root.iterfind("disable_default_collisions")]
    pairs = {sorted_pair(a, b) for a in unchecked for b in links}
    pairs = (pairs - pairs_of("enable_collisions")) | pairs_of("disable_collisions")
    return tuple(sorted((a, b) for a, b in pairs if a != b))


def with_disabled_pairs(robot: Robot, root: etree._Element, origin: str = "SRDF") -> Robot:
    """Return a robot that also ignores contacts of the links that an SRDF disables."""
    frames = {frame.name for frame in robot.frames}
    pairs = disabled_link_pairs(root, robot.link_index)
    for name in dict.fromkeys(link for pair in pairs for link in pair):
        if name not in robot.link_index and name not in frames:
            raise FormatError(
                f"{origin}: robot {robot.name!r} has no link {shortened(name)!r}"
                + nearest(name, robot.link_index)
            )
    known = {pair for pair in pairs if robot.link_index.keys() >= set(pair)}
    return replace(robot, ignore_pairs=tuple(sorted({*robot.ignore_pairs, *known})))

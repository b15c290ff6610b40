"""Read SRDF, the planning description beside a URDF, and write cuRobo's configuration."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import yaml
from lxml import etree

from morphgen.errors import FormatError, nearest, shortened
from morphgen.formats.data_files import read_bytes
from morphgen.formats.xml import parse_xml, read_schema
from morphgen.model.robot import TOOL, Pair, Robot, sorted_pair
from morphgen.model.rotation import Vec3


class LinkSpheres(NamedTuple):
    """Spheres that approximate a link."""

    link: str
    spheres: tuple[tuple[Vec3, float], ...]
    """Centre in the link's frame and radius of each [m]; MoveIt gives a link no collision shape if
    its only sphere has radius zero."""


def require_tool(robot: Robot) -> None:
    """Require that a robot has the frame ``tool``, which an SRDF and planners need."""
    if robot.tool is None:
        raise FormatError(
            f"robot {robot.name!r} has no frame {TOOL!r}, where its arm ends; import it with a "
            "tool (morphgen import FILE --tool LINK)"
        )


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


CUROBO_CONFIG = "robot.yml"  # name of the configuration in an exported folder
_CUROBO_VERSION = 2.0


def curobo_text(
    robot: Robot, spheres: Sequence[LinkSpheres], ignored: Iterable[Pair], urdf: str, comment: str
) -> str:
    """Return a robot's configuration for cuRobo (format version 2.0) as YAML."""
    require_tool(robot)
    # "tool" of a robot with several limbs is the tool of the last one.
    names = (frame.name for frame in robot.frames)
    tools = [name for name in names if name.endswith(f"_{TOOL}")] or [TOOL]
    if not spheres:
        raise FormatError(f"robot {robot.name!r} has no link with spheres")
    links = [link.link for link in spheres]
    joints = [robot.joints[k].name for k in robot.independent_joints]
    ignore = defaultdict(list)
    for a, b in sorted(ignored):
        if a in links and b in links:
            ignore[a].append(b)
    kinematics = {
        "format_version": _CUROBO_VERSION,
        "urdf_path": urdf,
        "asset_root_path": "",
        "base_link": robot.root.name,
        "tool_frames": tools,
        "collision_link_names": links,
        "collision_spheres": {
            link.link: [
                {"center": list(center), "radius": radius} for center, radius in link.spheres
            ]
            for link in spheres
        },
        "collision_sphere_buffer": 0.0,
        "self_collision_ignore": dict(ignore),
        "self_collision_buffer": dict.fromkeys(links, 0.0),
        "mesh_link_names": [link.name for link in robot.links if link.visuals],
        "cspace": {
            "joint_names": joints,
            "default_joint_position": list(robot.home),
            "null_space_weight": [1.0] * len(joints),
            "cspace_distance_weight": [1.0] * len(joints),
        },
    }
    data = {"robot_cfg": {"kinematics": kinematics}}
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=100)
    return f"# {comment}\n{text}"
